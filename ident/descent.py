"""Damped steps down the criterion of a fit (Levenberg-Marquardt)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.coordinates import TIMING_LIMIT, clip_effects, moves_geometry, pack, shifts_posture, unpack
from ident.costs import by_noise, weighted_cost
from ident.derivatives import shared_slope
from ident.extended import Prediction
from ident.inverse import REMAINDER_STEPS
from ident.model import Model, has_loop
from ident.problem import Problem, Weights, predictions

LOG_RANGE = 7.0  # of a baseline parameter about its starting guess: a factor of a thousand
TRIALS = 6  # dampings that are tried for a step
MORE_DAMPING, LEAST_RAISED = 8.0, 1e-4  # factor on the damping after a step that failed, and the least that is raised
LOST = 1.2  # rise of the cost, with a geometric remainder made anew, that takes steps back
SLIGHT = 2.0  # fall of the cost that tells nothing


@dataclass(frozen=True)
class Point:
    """Where a fit stands.

    Attributes:
        x: coordinates of ``model``.
        remainders: geometric remainders of the last time that they were made anew.
        cost: weighted squares of what ``predictions`` leave.
        noise: the part of them that is taken off (``Criterion.share``).
    """

    model: Model
    x: np.ndarray
    predictions: list[Prediction]
    remainders: list[np.ndarray]
    cost: float
    noise: float = 0.0

    @property
    def value(self) -> float:
        """What is minimised, but for the prior."""
        return self.cost - self.noise


@dataclass(frozen=True)
class Step:
    """A step that lowers the criterion: where it leads, by how much it falls, and by how much the columns said."""

    to: Point
    gain: float
    foretold: float


@dataclass(frozen=True)
class Criterion:
    """What a fit minimises: weighted squares, less a share of what noise of the position adds to them, and a prior.

    Attributes:
        center, prior: of the coordinates, and its weight.
        share: that is taken off (``errors_in_variables``).
    """

    problem: Problem
    weights: Weights
    center: np.ndarray
    prior: np.ndarray
    share: float = 0.0

    def noise(self, found: Sequence[Prediction]) -> float:
        """What noise adds to the squares that some predictions leave, as far as it is taken off."""
        return self.share * float(np.sum(by_noise(self.problem, found, self.weights))) if self.share else 0.0

    def stepped(self, at: Point, step: np.ndarray, anew: bool) -> Point | None:
        """The point a step away; None where there is no model.

        Args:
            anew: whether the geometric remainders are made anew there.
        """
        if not np.all(np.isfinite(step)):
            return None
        try:
            model = unpack(at.model, at.x + step, TIMING_LIMIT * self.problem.sampling.sample_time)
            steps = REMAINDER_STEPS if anew else 0
            found = predictions(self.problem, model, at.remainders, steps=steps, near=at.predictions)
            cost = weighted_cost(self.problem, found, self.weights)
            return Point(model, pack(model), found, at.remainders, cost, self.noise(found))
        except (np.linalg.LinAlgError, FloatingPointError, ValueError):
            return None

    def settled(self, last: Point, at: Point) -> Point:
        """A point with geometric remainders of its own, else the ``last`` that had them.

        Steps are taken with the remainder held. Where the links hang on gears that are far too soft the
        remainder answers them so strongly that a step which lowers the cost raises it in truth.
        """
        try:
            found = predictions(self.problem, at.model, last.remainders, steps=REMAINDER_STEPS, near=at.predictions)
            cost = weighted_cost(self.problem, found, self.weights)
        except (np.linalg.LinAlgError, FloatingPointError, ValueError):
            return last
        if not cost < LOST * last.cost:
            return last
        return Point(at.model, at.x, found, [p.solution.W for p in found], cost, self.noise(found))

    def cut(self, at: Point, step: np.ndarray) -> np.ndarray:
        """A step within what a linear model may be trusted for, and within the range of the coordinates."""
        m = len(at.model.par.to_log())
        step, low, high = step.copy(), self.center[:m] - LOG_RANGE, self.center[:m] + LOG_RANGE
        step[m + 1 :] = clip_effects(at.model, step[m + 1 :])
        step[:m] = np.clip(at.x[:m] + np.clip(step[:m], -1.0, 1.0), low, high) - at.x[:m]
        return step


def descend(
    criterion: Criterion, at: Point, H: np.ndarray, b: np.ndarray, damping: float, anew: bool
) -> tuple[Step | None, float]:
    """A step that lowers the criterion, and the damping that it took; None where no damping does, in all coordinates or
    in those that are no ``nuisances``.

    Args:
        H, b: normal equations of the weighted squares at that point, (p, p) and (p,).
        damping: of the first trial, in units of the diagonal.
        anew: whether geometric remainders are made anew at each trial.
    """
    if criterion.share:
        b = b - criterion.share * shared_slope(criterion.problem, at.model, at.predictions, criterion.weights)
    step, taken = _tried(criterion, at, H, b, damping, anew, np.ones(len(at.x), bool))
    free = ~nuisances(at.model)
    if step is None and not np.all(free) and not is_slow(at.model) and _foretold(criterion, at, H, b, free) > SLIGHT:
        # A law may jump with one of them, as a friction does where rest is no longer told from a slow turn, and no step
        # leads there.
        return _tried(criterion, at, H, b, damping, anew, free)
    return step, taken


def _tried(
    criterion: Criterion, at: Point, H: np.ndarray, b: np.ndarray, damping: float, anew: bool, free: np.ndarray
) -> tuple[Step | None, float]:
    """``descend`` in the coordinates that are ``free`` (p,), by the whole slope ``b``."""
    off, prior = at.x - criterion.center, criterion.prior
    H_p, b_p = H + np.diag(prior), b - prior * off
    size = np.diag(H_p).copy()
    size[size <= 0] = 1.0
    among = np.ix_(free, free)
    for _ in range(TRIALS):
        step = np.zeros(len(b))
        step[free] = np.linalg.solve((H_p + damping * np.diag(size))[among], b_p[free])
        step = criterion.cut(at, step)
        to = criterion.stepped(at, step, anew)
        gain = at.value - to.value if to is not None else -np.inf
        foretold = float(2.0 * b @ step - step @ H @ step)
        if to is not None and gain > np.sum(prior * ((off + step) ** 2 - off**2)):
            return Step(to, gain, foretold), damping
        # A step whose parts are cut to size may be foretold to lead uphill: a shorter one does not.
        if is_slow(at.model) and abs(foretold) < SLIGHT:
            break
        damping = max(damping, LEAST_RAISED) * MORE_DAMPING
    return None, damping


def _foretold(criterion: Criterion, at: Point, H: np.ndarray, b: np.ndarray, free: np.ndarray) -> float:
    """Fall of the criterion that its slope says of the best step in the ``free`` coordinates."""
    prior = criterion.prior
    slope = (b - prior * (at.x - criterion.center))[free]
    return float(slope @ np.linalg.lstsq((H + np.diag(prior))[np.ix_(free, free)], slope, rcond=None)[0])


def nuisances(model: Model) -> np.ndarray:
    """(p,) which coordinates of a fit are parameters of effects that only say in what form these act."""
    own = len(model.par.to_log()) + 1
    return np.array([False] * own + [q.nuisance for e in model.effects for q in e.hypothesis.parameters])


def is_slow(model: Model) -> bool:
    """Whether columns take most of the time of a fit: beside loops each is a periodic motion of its own."""
    return any(has_loop(e) for e in model.effects)


def needs_remainders(problem: Problem, model: Model) -> bool:
    """Whether geometric remainders are made anew at each step.

    They hold the gravity torque of the chain, at one posture or along a motion: what changes either needs new ones, as
    softer gears do along a motion.
    """
    return problem.motions_alone or shifts_posture(model) or any(moves_geometry(e, False) for e in model.effects)
