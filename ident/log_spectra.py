"""Drives to begin with, by the logarithms of the spectra.

From guesses that are off by more than about a half, resonances of a model lie beside those of the arm, and least squares
of torques lead away: a resonance at the wrong place costs more than none, and gears end a hundred times too soft or too
stiff. The logarithm of predicted over measured torque is the same for a pole and a zero (as in LLS: Wernholt and Moberg,
Automatica 47, 2011), and bounded here as of a robust estimator (Geman and McClure 1987), so that lines which the wrong
resonances spoil do not outvote the others. It has one broad valley, which a search along one drive figure after another
finds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ident.graybox import Linearisation, Parameters, equilibrium, impedance, linearise, rotor_inertia
from ident.group import Group
from ident.inverse import torque_record
from ident.model import Effect, Model
from ident.problem import NOT_COMPUTED, Problem
from ident.thinning import thinned
from ident.time_steps import differences
from robot_assets.robot import guessed_drives

MOST_LINES = 40  # looked at of a group
ABOVE_NOISE = 10.0  # amplitude of a line of the torque over its noise, from which it is looked at
SWEEPS = 4  # over all drives, at most, of each step
STEPS = (1.6, 1.15, 1.05)  # factor from one value of a figure to the next
NEAR = 3  # of the finer ones tried on either side
BETTER = 0.01  # share of the cost by which a sweep must lower it for another one
# factor between a drive figure and its starting guess, up to which it may be that of the arm: of one that is known, and
# of one that follows from the bodies that a joint carries, within a factor of about five
KNOWN, GUESSED = 4.0, 20.0
FIELDS = ("stiffness", "inertia", "damping", "viscous")


@dataclass(frozen=True)
class Spectra:
    """Lines of a group that are looked at.

    Attributes:
        group: at its posture, of these lines alone.
        position, torque: (S, K, n) spectra, rad and N m.
        seen: (S, K, n) True where the torque is excited and clear of the noise.
    """

    group: Group
    position: np.ndarray
    torque: np.ndarray
    seen: np.ndarray


def begun_by_logarithms(problem: Problem) -> Parameters:
    """Drives near the nominal ones, at which the logarithms of torques agree best with those of the records; the nominal
    ones where no record is periodic.

    The arm is linear here, and without effects.
    """
    spectra = looked_at(problem)
    return valley(problem, spectra, Model(problem.structure, problem.nominal))[0].par if spectra else problem.nominal


def credible(problem: Problem) -> np.ndarray:
    """(n,) natural logarithm of the factor between a drive figure and its starting guess, up to which it may be that of
    the arm."""
    robot = problem.structure.robot
    return np.log(np.where(np.isin(robot.joint_names, guessed_drives(robot)), GUESSED, KNOWN))


@dataclass(frozen=True)
class Axis:
    """A coordinate of the search.

    Attributes:
        start: where it begins.
        reach: how far from zero it may go.
        unit: of its steps, over those of a logarithm.
        early: whether it shows before resonances are in their places, as no damper does.
    """

    start: float
    reach: float
    unit: float
    early: bool

    def values(self, x: float, step: float, whole: bool) -> np.ndarray:
        """Those to try: the ``whole`` reach, or a few near ``x``."""
        most = int(2.0 * self.reach / (step * self.unit)) if whole else NEAR
        each = x + step * self.unit * np.arange(-most, most + 1)
        return each[np.abs(each) <= self.reach]


def axes_of(problem: Problem, model: Model) -> list[Axis]:
    """Logarithms of drives over the nominal ones, field by field, and offsets of the parameters of a last effect."""
    axes = [
        Axis(float(np.log(start / guess)), float(reach), 1.0, field in FIELDS[:2])
        for field in FIELDS
        for start, guess, reach in zip(
            getattr(model.par, field), getattr(problem.nominal, field), credible(problem), strict=True
        )
    ]
    for q in model.effects[-1].hypothesis.parameters if model.effects else ():
        reach, unit = (np.log(GUESSED), 1.0) if q.log else (2.0 * q.spread, q.spread / (2.0 * np.log(STEPS[0])))
        axes.append(Axis(0.0, float(reach), float(unit), not q.nuisance))
    return axes


def valley(problem: Problem, spectra: Sequence[Spectra], model: Model) -> tuple[Model, float]:
    """A model with drives near the nominal ones, and with a last effect that changes the chain near its own start, if it
    has one, at which logarithms agree best; and what it costs, 0 to 1.

    Along one coordinate after another, that of the effect first: over all that may be, then in finer steps.
    """
    axes = axes_of(problem, model)
    x = np.array([axis.start for axis in axes])
    cost_at = costs_near(problem, spectra, model)
    cost = mean_cost(problem, spectra, model)
    for step in np.log(STEPS):
        whole = step == np.log(STEPS[0])
        for _ in range(SWEEPS):
            before = cost
            for k, axis in reversed(list(enumerate(axes))):
                for value in axis.values(x[k], step, whole) if axis.early or not whole else ():
                    other = np.where(np.arange(len(x)) == k, value, x)
                    if (found := cost_at(other)) < cost:
                        cost, x = found, other
            if cost > (1.0 - BETTER) * before:
                break
    return _made(model, problem.nominal, x), cost


def costs_near(problem: Problem, spectra: Sequence[Spectra], model: Model) -> Callable[[np.ndarray], float]:
    """``mean_cost`` of the models ``_made`` at offsets.

    Where offsets differ from those before by motors alone the links are still the same, and by dampers alone the
    posture.
    """
    n, records = problem.structure.n, _records(problem, spectra, model)
    _, inertia, damping, viscous = (slice(i * n, (i + 1) * n) for i in range(len(FIELDS)))

    def without(x: np.ndarray, *parts: slice) -> tuple[float, ...]:
        left = np.array(x)
        for part in parts:
            left[part] = 0.0
        return tuple(left)

    @lru_cache(maxsize=1)
    def postures(x: tuple[float, ...]) -> list[Linearisation]:
        return _postures(spectra, _made(model, problem.nominal, np.array(x)))

    @lru_cache(maxsize=1)
    def links(x: tuple[float, ...]) -> list[np.ndarray]:
        return _links(spectra, _made(model, problem.nominal, np.array(x)), postures(without(np.array(x), damping)))

    def cost(x: np.ndarray) -> float:
        try:
            Z = links(without(x, inertia, viscous))
        except NOT_COMPUTED:
            return np.inf
        return _cost(spectra, records, Z, _made(model, problem.nominal, x).par)

    return cost


def _made(model: Model, nominal: Parameters, x: np.ndarray) -> Model:
    """A model at offsets: logarithms of drives over the nominal ones, and of the last effect those of its parameters."""
    n = len(nominal.stiffness)
    par = replace(
        model.par, **{field: getattr(nominal, field) * np.exp(x[i * n : (i + 1) * n]) for i, field in enumerate(FIELDS)}
    )
    if not model.effects:
        return replace(model, par=par)
    *others, effect = model.effects
    h = effect.hypothesis
    moved = [
        np.clip(v * np.exp(o) if q.log else v + o, q.lower, q.upper)
        for q, v, o in zip(h.parameters, effect.p, x[len(FIELDS) * n :], strict=True)
    ]
    return replace(model, par=par, effects=(*others, Effect(h, np.array(moved))))


def looked_at(problem: Problem) -> list[Spectra]:
    """Lines of periodic groups, of some records, where these tell any."""
    return [x for g in thinned(problem).groups if g.window is None and np.any((x := spectra_of(g)).seen)]


def spectra_of(group: Group) -> Spectra:
    """At most ``MOST_LINES`` of the lines of a periodic group that some record excites, spread over the band."""
    lines = np.arange(1, group.n_compared)
    if np.any(group.excited):
        lines = lines[np.any(group.excited, axis=0)[lines]]
    lines = lines[np.unique(np.linspace(0, len(lines) - 1, MOST_LINES).astype(int))] if len(lines) else lines
    torque = group.U[:, lines]
    noise = np.sqrt(group.white_torque_noise / np.maximum(group.periods, 1)[:, None])
    seen = np.abs(torque) > ABOVE_NOISE * noise[:, None]
    return Spectra(replace(group, omega=group.omega[lines]), group.Q[:, lines], torque, seen)


def mean_cost(problem: Problem, spectra: Sequence[Spectra], model: Model) -> float:
    """Mean of the bounded squares of logarithms over what is looked at, of a model that is linear but for its chain."""
    try:
        Z = _links(spectra, model, _postures(spectra, model))
    except NOT_COMPUTED:
        return np.inf
    return _cost(spectra, _records(problem, spectra, model), Z, model.par)


def _records(problem: Problem, spectra: Sequence[Spectra], model: Model) -> list[np.ndarray]:
    """Recorded torque per continuous torque (K,) of each group."""
    return [torque_record(model.par, x.group, problem.sampling) for x in spectra]


def _postures(spectra: Sequence[Spectra], model: Model) -> list[Linearisation]:
    """Of each group, the arm at its equilibrium."""
    structure, par = model.built
    return [linearise(structure, equilibrium(structure, par, x.group.posture)) for x in spectra]


def _links(spectra: Sequence[Spectra], model: Model, postures: Sequence[Linearisation]) -> list[np.ndarray]:
    """Of each group, the impedance (K, n, n) behind motors without inertia and friction."""
    structure, par = model.built
    bare = replace(par, inertia=np.zeros_like(par.inertia), viscous=np.zeros_like(par.viscous))
    return [
        impedance(structure, bare, lin, 1j * x.group.omega, x.group.steps)[0]
        for x, lin in zip(spectra, postures, strict=True)
    ]


def _cost(
    spectra: Sequence[Spectra], records: Sequence[np.ndarray], links: Sequence[np.ndarray], par: Parameters
) -> float:
    """``mean_cost`` with what ``_links`` says, and the motors of ``par``."""
    total, count = 0.0, 0
    for x, record, Z in zip(spectra, records, links, strict=True):
        rate, square = (d[:, None] for d in differences(1j * x.group.omega, x.group.steps))
        alone = replace(par, damping=np.zeros_like(par.damping))  # gears are among the links
        motors = square * rotor_inertia(alone, x.group.steps) + rate * par.viscous
        torque = record[:, None] * (np.matmul(Z, x.position[..., None])[..., 0] + motors * x.position)
        with np.errstate(divide="ignore", invalid="ignore"):
            left = np.abs(np.log(torque / x.torque)[x.seen]) ** 2
        total, count = total + float(np.sum(left / (1.0 + left))), count + len(left)
    return total / count
