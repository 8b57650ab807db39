"""What a hypothesis is: one effect at one place, with parameters, a law and a screening form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np

from ident.hypotheses.yielding import SLIP
from ident.motion import Motion

TOLERANCE = 0.05  # of a factor, natural logarithm, that needs no cause; twice as much does
LOG_SPREAD = 1.5  # of a positive parameter before the data, natural logarithm
UNIT_RANGE = 4.0  # between bounds that are physical ones of a pure number


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        name, unit: as in the catalogue.
        lower, upper: physical bounds.
        log: fitted as a logarithm (positive parameters that span decades).
        nuisance: fitted but no parameter of the catalogue; reported all the same where ``reported`` says so, or where it
            is found to be there.
        step: finite-difference step in fitted coordinates.
        center, spread: a weak prior, external units, the spread in fitted coordinates; none where infinite.
        per_stiffness: ``center`` is in units of the stiffness of the joint's gear.
        null: value at which the parameter is as good as absent, None where there is no such value.
        at_start: whether it says how a motion begins, so that what repeats does not feel it.
    """

    name: str
    unit: str
    lower: float
    upper: float
    log: bool = False
    nuisance: bool = False
    step: float = 1e-4
    center: float = 0.0
    spread: float = np.inf
    per_stiffness: bool = False
    null: float | None = None
    reported: bool = False
    at_start: bool = False

    def prior_center(self, stiffness: float) -> float:
        """Centre of the weak prior in fitted coordinates, 0 where there is none."""
        if not np.isfinite(self.spread):
            return 0.0
        return self.to_internal(self.center * stiffness if self.per_stiffness else self.center)

    def to_internal(self, value: float) -> float:
        """Coordinate of the fit: clipped to the bounds, the logarithm where ``log``."""
        value = float(np.clip(value, self.lower, self.upper))
        return float(np.log(value)) if self.log else value

    def to_external(self, x: float) -> float:
        """Value in SI of a coordinate of the fit, within the bounds."""
        value = float(np.exp(np.clip(x, -700, 700))) if self.log else x
        return float(np.clip(value, self.lower, self.upper))

    @property
    def bounded(self) -> bool:
        """Whether something is said of its spread before the data."""
        return bool(np.isfinite(self.spread) or self._pure)

    @property
    def _pure(self) -> bool:
        """Whether bounds say it. Those of a number with a unit are only there to keep it finite."""
        return self.unit == "1" and self.upper - self.lower <= UNIT_RANGE

    def expected_spread(self, value: float) -> float:
        """Standard deviation before the data that a value is charged for, fitted coordinates: ``spread_allowed``, and of
        a factor that differs little from none, as that of any motor does, no more than that; in between beyond."""
        allowed = self.spread_allowed(value)
        if not self.log or self.null is None or np.isfinite(self.spread):
            return allowed
        off = abs(self.to_internal(value) - self.to_internal(self.null))
        beyond = float(np.clip(off / TOLERANCE - 1.0, 0.0, 1.0))
        return min(off ** (1.0 - beyond) * allowed**beyond, allowed)

    def spread_allowed(self, value: float) -> float:
        """Standard deviation before the data, fitted coordinates: of the size of the value where nothing is said."""
        if np.isfinite(self.spread):
            return self.spread
        if self.log:
            return LOG_SPREAD
        if self._pure:
            return (self.upper - self.lower) / np.sqrt(12.0)
        return max(abs(value), 1e-300)


def sought(parameter: Parameter, asked: bool) -> tuple[tuple[Parameter, ...], tuple[float, ...]]:
    """A parameter that is fitted where it is ``asked`` for, and its value where it is as good as absent; nothing of
    either elsewhere."""
    if not asked:
        return (), ()
    assert parameter.null is not None
    return (parameter,), (parameter.null,)


RIPPLE = "periods_per_rev"  # parameter of effects that repeat with the position
START = Parameter("start", "1", -1.0, 1.0, nuisance=True, step=0.02, center=0.0, spread=0.5, null=0.0, at_start=True)
EXPONENT = Parameter("exponent", "1", 0.5, SLIP, True, nuisance=True, step=0.05, center=1.0, spread=1.5, reported=True)


@dataclass(frozen=True)
class Screen:
    """Unit responses of a hypothesis at one value of its shape parameters.

    Attributes:
        signals: (S, T) torque signals whose weights are sought, or spectra (S, L) where complex.
        start: weights -> parameter vector to start a refit from, or None where the weights are
            not physical.
        shape: value of the shape parameters, for keeping the best across operating points.
        motor: (S, T) torques that act at the motor at the same time, one per signal, or none.
    """

    signals: tuple[np.ndarray, ...]
    start: Callable[[np.ndarray], np.ndarray | None]
    shape: tuple[float, ...] = ()
    motor: tuple[np.ndarray, ...] = ()


def no_law(*_: object) -> NoReturn:
    """In place of the law of an effect that has none: it changes the chain, or is solved in a loop alone."""
    raise TypeError("an effect without a law")


@dataclass(frozen=True)
class Hypothesis:
    """An effect of the catalogue (or a decoy outside it) at one place.

    Attributes:
        effect: catalogue name; decoys start with "unknown:".
        place: joint, link, "flange" or "base".
        joint: index of the driven joint, -1 where there is none.
        channel: what the law returns and where it acts:
            "motor" (S, T) torque at the motor; "spring" (S, T) torque in parallel with the gear;
            "link" (S, T) torque on the link coordinate; "position" (S, L) spectrum to add to the
            motor position; "drive" (S, L) recorded torque spectrum from the predicted one;
            "model": the chain itself is changed (see structure.py).
        parameters: in the order of the vector ``p`` of the law.
        law: (p, motion, joint, stiffness) -> array as the channel says. A drive is given its torque spectrum too; in
            parallel with the gear it is (p, None, stiffness) -> ``kernels.Law``, or of a kinematic error (p, motion,
            joint, stiffness) -> error and torque at the motor. ``no_law`` where there is none.
        screen: motion, joint, stiffness, scale -> unit responses.
        sentence: evidence with {joint} and the parameters as fields.
        options: what single hypotheses need beyond that. ``size(scale)`` gives parameters of a strong effect
            to start from where no linear step leads there. ``absorbs`` names an effect that this one
            holds as a special case, ``absorb(p, weights, old)`` gives its start where it takes the
            place of one with parameters ``old`` at the same joint, ``widens(old, scale)`` starts to try of other
            shapes. ``holds`` names one that it holds and is asked for beside alone (``wider_forms``), from ``widens`` too,
            and ``narrow(p)`` gives parameters of the law of its own name that it holds.
            ``called(p, swing, stiffness)``: name, and names of parameters, of the special case that it is as good as at a
            joint that swings so far beside a gear of that stiffness; None where it is not. ``apart``: the parameter that
            sets it apart from that special case, and ``special(p)`` the parameters of the special case that it is where
            the data do not show this one, or where ``give(p)``, rad, is less than the noise of the position.
            ``essential`` names the parameters without any of which nothing is left of the effect,
            ``trivial(p, stiffness)`` says so of all parameters together, beside a gear of that stiffness. ``bends``: the
            arm may have several steady motions with it; ``bends(p, factor, stiffness)`` gives parameters of another size
            that do about the same. ``dry``: a friction that at rest balances what is asked of it; ``sees_load``: of a
            size that the torque of the gear says.
            ``usual(p)``: values by name of the parameter that need no data to be expected, next to those that it has.
            ``nats(p)``: log odds before the data, where there is a reason for any. ``of_size(p)``: factor of the spreads
            that are expected of its parameters. ``body``: the link whose inertia it
            changes.
            ``winds(plane, solution)``: (S, joints, m) constant torques in the gears, per unit of its parameters, by which
            one of the chain moves the arm to another posture.
            ``said(numbers)``: the sentence, where values of its parameters by name say which of several it is.
            ``shown`` names the parameter that the data must show for it to be this effect: what never yields is a
            spring.
            ``exceeds``: two positive parameters, of which the first must be larger beyond chance.
            ``filter(p, s)``: recorded torque per delivered one, or true position per measured one, of one that is
                linear, (L,).
            ``slope(p, q)``: of one that is not, true position per measured one at true positions; of a spring to the
                link, N m/rad at positions of that.
            ``rest(p)``: angle about which a law at the link is asked. ``turns``: of an encoder in a turn of its joint.
                ``linear``: at a linear joint. ``yields``: its friction turns over with the path.
            ``nearer(p)``: the hypothesis of the same hinge sought from another axis, and its parameters, where its own
                is nearer to that.
            ``of_record``: of a decoy that lies in how the record was made, and so leaves no cause unknown.
            ``baseline``: of an effect that is no cause of the catalogue but part of the baseline, the name of its value
                there.
    """

    effect: str
    place: str
    joint: int
    channel: str
    parameters: tuple[Parameter, ...]
    law: Callable[..., Any]
    shapes: Callable[[SignalScale], Sequence[tuple[float, ...]]]
    screen: Callable[[Motion, int, float, tuple[float, ...]], Screen] | None
    sentence: str
    variable: str = "v"
    options: dict = field(default_factory=dict)

    @property
    def decoy(self) -> bool:
        """Whether it stands for what the catalogue lacks."""
        return self.effect.startswith("unknown:")

    @property
    def on_chain(self) -> bool:
        """Whether it changes the chain, and shows at every joint."""
        return self.joint < 0 or self.channel == "model"

    @property
    def bears_load(self) -> bool:
        """Whether it changes the body at the flange, of which an unknown load is a part to the data."""
        return self.effect == "payload" or bool(self.options.get("carries_load"))

    @property
    def key(self) -> tuple[str, str]:
        """Effect and place."""
        return self.effect, self.place

    def coordinate(self, parameter: str) -> str:
        """Name of one of its parameters among all coordinates of a fit."""
        return f"{self.effect}@{self.place}:{parameter}"

    @property
    def repeats(self) -> bool:
        """Whether it is a ripple, with a wave number of its own."""
        return any(q.name == RIPPLE for q in self.parameters)

    @property
    def gear_law(self) -> bool:
        """Whether it is a law of the gear's torque on its deflection, as an error of its transmission is not."""
        return self.channel == "spring" and not self.options.get("kinematic")


@dataclass(frozen=True)
class SignalScale:
    """Sizes of the signals of a joint over all records, for shape grids.

    Attributes:
        v: rms velocity, rad/s; q: rms excursion, rad; delta: quantiles of |deflection| at
        10, 50, 90, 99.5 %; delta_rms: rad; torque: rms dynamic torque, N m;
        peak_torque: N m; exceeded_torque: for a fifth of the time in motions, N m, without bounds where they repeat;
        stiffness: N m/rad; wave_numbers: candidate periodicities in motor angle, 1/rad;
        highest_line: that is compared, Hz.
    """

    v: float
    q: float
    delta: np.ndarray
    delta_rms: float
    torque: float
    stiffness: float
    peak_torque: float
    exceeded_torque: float
    duration: float
    highest_line: float
    wave_numbers: tuple[float, ...]
