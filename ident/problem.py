"""Data, weights and predictions of a fit to the torque residual, and what is compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.chain import Structure
from ident.extended import Prediction, predict
from ident.graybox import Parameters
from ident.group import Group
from ident.inverse import Sampling
from ident.model import Model
from ident.motion import Torques
from ident.parallel import map_threads
from ident.time_steps import TimeSteps

NOT_COMPUTED = (np.linalg.LinAlgError, ArithmeticError, ValueError, RuntimeError)  # a model that has no solution


@dataclass(frozen=True)
class Problem:
    """Data and weights of a fit.

    Attributes:
        groups: records.
        sampling: how they were sampled.
        nominal: starting guesses, centre of the weak prior.
        tau_std, q_std: (n,) sample noise where single periods give no scatter.
        free_timing: whether a common timing offset is fitted.
        start: drives to begin with where a fit of the drives alone leads to some that cannot be those of the arm; else
            None.
        scatter_share: of what the scatter between periods says that noise adds to costs, that is taken off where these
            are compared; that which the baseline has borne, none before it is known.
        noise_left: whether ``tau_std`` is what a model has left: errors of its laws are in it.
        noise_denied: whether it is more than the dataset gives, as fast lines of motions show, or lines that nothing excites.
    """

    structure: Structure
    groups: tuple[Group, ...]
    sampling: Sampling
    nominal: Parameters
    tau_std: np.ndarray
    q_std: np.ndarray
    free_timing: bool = True
    scatter_share: float = 0.0
    start: Parameters | None = None
    noise_left: bool = False
    noise_denied: bool = False

    @property
    def begun(self) -> Parameters:
        """Drives from which strong effects are sought."""
        return self.nominal if self.start is None else self.start

    @property
    def motions_alone(self) -> bool:
        """Whether no record is periodic."""
        return all(group.window is not None for group in self.groups)

    @property
    def steps(self) -> TimeSteps | None:
        """Time steps of the simulation that made the records; None of a machine."""
        return self.groups[0].steps

    def samples(self, group: Group) -> int:
        """Samples of a period of a group, or of the whole of a motion."""
        return round(group.period_time / self.sampling.sample_time)


@dataclass(frozen=True)
class Weights:
    """(K, n + M, n + M) whitening per group: real and imaginary parts of residuals have unit variance under noise.

    ``by_noise``: (n,) what noise adds to the cost of the model that they were made with, by joint (``noise_of``); None
    where the scatter between periods says nothing of it.
    """

    whiten: tuple[np.ndarray, ...]
    covariance: tuple[np.ndarray, ...]
    by_noise: np.ndarray | None = None

    def apply(self, g: int, X: np.ndarray) -> np.ndarray:
        """Whiten outputs (S, K, n + M) or (S, K, n + M, p), complex as given."""
        if X.ndim == 4:
            return np.matmul(self.whiten[g], X)
        return np.matmul(self.whiten[g], X[..., None])[..., 0]


def residual(group: Group, prediction: Prediction) -> np.ndarray:
    """Measured less predicted recorded torque at the compared lines; (S, K, n) complex, N m."""
    return group.observe(group.U - prediction.U)


def output_error(group: Group, prediction: Prediction) -> np.ndarray:
    """The same of all outputs; (S, K, n + M) complex, N m and rad."""
    return group.observe_outputs(group.outputs - prediction.outputs())


def data_counts(problem: Problem) -> np.ndarray:
    """Real numbers that are compared, by joint; (n,)."""
    n = problem.structure.n
    each = [np.full(n + len(g.links), record_count(g) * (2 * g.n_compared - 1)) for g in problem.groups]
    return by_joint(problem, each)


def record_count(group: Group) -> float:
    """Records of a group, those seen through a window as the share that it leaves."""
    return len(group.segments) * group.window_share


def data_count(problem: Problem) -> int:
    """Real numbers that are compared."""
    return int(np.sum(data_counts(problem)))


def compared_lines(group: Group) -> int:
    """Lines that enter a comparison: up to the band for periodic data, all for a motion."""
    return group.n_compared if group.window is None else len(group.omega)


def predictions(
    problem: Problem,
    model: Model,
    remainders: Sequence[np.ndarray | None],
    steps: int | None = 0,
    near: Sequence[Prediction] = (),
) -> list[Prediction]:
    """What a model predicts for all records, from geometric remainders near their own.

    Args:
        near: predictions of a model with the same effects, with whose torques loops begin; from rest where empty.
    """

    def one(of: tuple[Group, np.ndarray | None, Prediction | None]) -> Prediction:
        group, W, p = of
        torques = p.solution.torques if p else Torques()
        return predict(model, group, problem.sampling, W=W, steps=steps, torques=torques, near=p)

    told: Sequence[Prediction | None] = near or [None] * len(problem.groups)
    return map_threads(one, zip(problem.groups, remainders, told, strict=True))


def by_joint(problem: Problem, each: Sequence[np.ndarray]) -> np.ndarray:
    """Sums over groups of figures of their outputs (n + M,), those of link encoders with their joints; (n,)."""
    total = np.zeros(problem.structure.n)
    for group, figures in zip(problem.groups, each, strict=True):
        total += figures[: len(total)]
        total[list(group.links)] += figures[len(total) :]
    return total
