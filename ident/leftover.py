"""What no effect explains: at which joint, in which band, how it grows with the level, and on what it depends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.extended import Prediction
from ident.group import Group
from ident.motion import Motion
from ident.output_noise import noise_covariance
from ident.problem import NOT_COMPUTED, Problem, predictions, residual
from ident.rounds import Round
from ident.torque_fit import Fit
from ident.units import text_at
from ident.verdict import EvidencePlot
from robot_assets.robot import linear_joints

KNOTS = 11  # between which a law of a variable is linear
BAND = (0.1, 0.9)  # shares of the residual below and above the band that is told
CLOSE = 0.5  # share of what is left that a law without a name explains, for the drives found with it to be shown
CHANCE = 4.0  # standard deviations of noise by which power must exceed it
RANK = 1e-3  # of the largest singular value, below which a law is not determined
SHOWN_WEIGHT = 0.99  # of the window of a motion, from which it is shown
SHOWN = 1500  # samples in a picture
VARIABLES: dict[str, Callable[[Motion, int], np.ndarray]] = {
    "v": Motion.v,
    "q": Motion.q,
    "delta": Motion.delta,
    "torque": Motion.torque,
}
LABELS = {
    "v": "motor velocity, rad/s",
    "q": "motor position, rad",
    "swing": "motor position about its mean in the record, rad",
    "delta": "gear deflection, rad",
    "time": "time, s",
    "torque": "recorded torque, N m",
    "posture": "measured torque beyond gravity and baseline, N m",
    "frequency": "frequency, Hz",
}


@dataclass(frozen=True)
class Leftover:
    """Residual torque of the joint that leaves most beyond noise: in words, and against the variable that explains most
    of it."""

    text: str
    plot: EvidencePlot


@dataclass(frozen=True)
class Excess:
    """Residual torque of one joint in one group beside its noise.

    Attributes:
        noise: (K,) N m, its standard deviation at the lines that are compared.
        lines: (S, K) complex: these lines of the residual over that.
    """

    group: Group
    noise: np.ndarray
    lines: np.ndarray

    @property
    def frequency(self) -> np.ndarray:
        """(K,) of the compared lines, Hz."""
        return self.group.omega[: self.group.n_compared] / (2.0 * np.pi)

    @property
    def power(self) -> np.ndarray:
        """(S, K) of the compared lines beyond noise, in units of that; negative where there happens to be less."""
        return np.abs(self.lines) ** 2 - 1.0

    @property
    def share(self) -> np.ndarray:
        """(K,) of the power of lines that is no noise; 0 where it is not clearly above that."""
        power = self.power.mean(axis=0)
        return np.where(power > CHANCE / np.sqrt(len(self.power)), power / (1.0 + np.abs(power)), 0.0)

    @property
    def count(self) -> int:
        """Real numbers that the residual shows clearly."""
        return 2 * len(self.power) * int(np.count_nonzero(self.share))

    @property
    def seen(self) -> slice | np.ndarray:
        """Samples that are compared: a motion is closed by a return that nobody recorded."""
        return slice(None) if self.group.window is None else self.group.window > SHOWN_WEIGHT

    def course(self, lines: np.ndarray) -> np.ndarray:
        """What compared lines (S, K) in units of the noise are over time, N m, as far as the residual is beyond noise;
        (S, N)."""
        whole = np.zeros((len(lines), len(self.group.omega), 1), complex)
        whole[:, : lines.shape[1], 0] = lines * self.noise * self.share
        return self.group.to_time(whole)[..., 0]


@dataclass(frozen=True)
class Law:
    """A law of a variable fitted to the residual of a group.

    Attributes:
        x: (M,) the variable at the samples that are compared.
        y: (M,) N m, the law there.
        error: (M,) N m by which it misses the residual, of the lines beyond noise.
        explained: power beyond noise that the law explains, in units of that.
    """

    x: np.ndarray
    y: np.ndarray
    error: np.ndarray
    explained: float


def find_leftover(problem: Problem, final: Fit, nameless: Round | None) -> Leftover | None:
    """Where the residual of a model sits, and what it depends on; None where the model cannot be computed.

    Args:
        nameless: a law without a name that explains what ``final`` leaves. Drives that were fitted without it have taken
            up a part of it, and turn the rest into something else: its residual is then that beside the drives found
            with it.
    """
    j, fit = int(np.argmax(final.costs - final.counts)), final
    if nameless is not None and nameless.explained > CLOSE:
        fit = nameless.candidates[0].fit
        fit = replace(fit, model=replace(fit.model, effects=fit.model.effects[:-1]))
    try:
        preds = predictions(problem, fit.model, fit.remainders)
    except NOT_COMPUTED:
        return None
    found = [excess_at(problem, group, pred, j) for group, pred in zip(problem.groups, preds, strict=True)]
    motions = [pred.motion() for pred in preds]
    laws = {name: [law_of(e, x(m, j)) for e, m in zip(found, motions, strict=True)] for name, x in VARIABLES.items()}
    whole = max(sum(float(np.sum(e.power)) for e in found), 1e-300)
    shares = {name: min(sum(law.explained for law in each) / whole, 1.0) for name, each in laws.items()}
    best = max(shares, key=lambda name: shares[name])
    joint, linear = problem.structure.robot.joint_names[j], linear_joints(problem.structure.robot)[j]
    low, high = band_of(found)
    growth = growth_of(problem.groups, found)
    law = "" if growth is None else f", growing with level to the power {growth:.1f}"
    band = f"between {low:.3g} and {high:.3g} Hz" if high > 0.0 else "while nothing moves"
    text = (
        f"The residual torque sits mostly at {joint}, {band}{law};"
        f" {LABELS[best].split(',')[0]} explains {shares[best]:.0%} of it."
    )
    x, y, error = (np.concatenate([getattr(law, k) for law in laws[best]]) for k in ("x", "y", "error"))
    step = max(1, x.size // SHOWN)
    x, y, error = x[::step], y[::step], error[::step]
    order = np.argsort(x)
    shown = text_at(f"residual torque of {joint} beyond noise, N m", linear)
    title = f"What no effect explains at {joint}"
    return Leftover(
        text, EvidencePlot(None, title, text_at(LABELS[best], linear), shown, x, y + error, x[order], y[order])
    )


def excess_at(problem: Problem, group: Group, prediction: Prediction, joint: int) -> Excess:
    """Residual torque of a joint in a group, beside its noise."""
    variance = noise_covariance(problem, group, prediction)[:, joint, joint].real
    noise = np.sqrt(np.maximum(variance, 1e-300))
    return Excess(group, noise, residual(group, prediction)[..., joint] / noise)


def law_of(excess: Excess, x: np.ndarray) -> Law:
    """The law of a variable (S, N), linear between ``KNOTS`` of its values, that explains most of a residual.

    Only what it gives at the compared lines counts, each by its noise: at others the residual shows nothing of it.
    """
    group, seen = excess.group, excess.seen
    knots = np.linspace(np.min(x), np.max(x), KNOTS)
    at = (x - knots[0]) / max(knots[1] - knots[0], 1e-300)
    hats = np.clip(1.0 - np.abs(at[..., None] - np.arange(KNOTS)), 0.0, None)  # (S, N, KNOTS)
    of_hats = group.observe(group.to_lines(hats)) / excess.noise[:, None]
    A, r = of_hats.reshape(-1, KNOTS), excess.lines.ravel()
    weights = np.linalg.lstsq(np.concatenate([A.real, A.imag]), np.concatenate([r.real, r.imag]), rcond=RANK)[0]
    error = excess.lines - of_hats @ weights
    missed = max(float(np.sum(np.abs(error) ** 2)) - (error.size - KNOTS / 2.0), 0.0)
    count, power = excess.count, float(np.sum(excess.power))
    # As many parameters explain a share of anything.
    explained = power - missed * count / (count - KNOTS) if count > KNOTS else 0.0
    y, missed_by = hats[:, seen] @ weights, excess.course(error)[:, seen]
    return Law(x[:, seen].ravel(), y.ravel(), missed_by.ravel(), max(explained, 0.0))


def band_of(found: Sequence[Excess]) -> tuple[float, float]:
    """The band that holds most of the power beyond noise, Hz."""
    frequency = np.concatenate([e.frequency for e in found])
    power = np.concatenate([e.power.sum(axis=0) for e in found])
    order = np.argsort(frequency)
    below = np.maximum.accumulate(np.cumsum(power[order]).clip(0.0))
    low, high = np.searchsorted(below, np.array(BAND) * below[-1])
    return float(frequency[order][low]), float(frequency[order][high])


def growth_of(groups: Sequence[Group], found: Sequence[Excess]) -> float | None:
    """Exponent of the level with which the residual grows; None where there are no two levels of it beyond noise."""
    level = np.concatenate([group.amplitude for group in groups])
    power = np.concatenate([e.power.sum(axis=1) for e in found])
    levels = np.unique(level)
    mean = np.array([power[level == v].mean() for v in levels])
    seen = mean > CHANCE * np.sqrt(found[0].power.shape[1])
    if np.sum(seen) < 2:
        return None
    return float(np.polyfit(np.log(levels[seen]), 0.5 * np.log(mean[seen]), 1)[0])
