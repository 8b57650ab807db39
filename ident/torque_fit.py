"""Maximum-likelihood fit of the gray-box, with effects, to the torque residual.

Levenberg-Marquardt on ``sum e^H Lambda^-1 e`` with ``e = U - U_model(theta; q)`` over all compared
lines of all segments. A relative error added to the noise (``rho``) and taken away in steps makes
the first steps act as a logarithmic criterion does: from starting guesses off by a factor of two
the plain weighted criterion would stop in wrong minima.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.columns import Columns
from ident.coordinates import PRIOR_LOG_STD, coordinate_names, moves_links, pack, prior_of
from ident.costs import fair_costs, has_scatter, weighted_cost
from ident.derivatives import jacobians, normal_equations, shared_information
from ident.descent import LEAST_RAISED, SLIGHT, Criterion, Point, descend, is_slow, needs_remainders
from ident.errors_in_variables import information_left, trusted_share
from ident.extended import Prediction
from ident.inverse import REMAINDER_STEPS
from ident.model import Model
from ident.parallel import one_thread_each
from ident.problem import Problem, Weights, data_count, data_counts, predictions
from ident.weights import make_weights

HELD, HOLD = 0.1, 0.04  # error added to the noise from which drives are held, and how strongly
ANNEALING = (0.5, 0.1, 0.02, 0.0)
STALE = 1e-3  # change of logarithmic coordinates after which the geometric remainder is made anew
GAP = 1e-6  # relative fall of the cost that ends a fit
LEAST_INFORMATION = 1e-12  # on a coordinate: less counts as this
RIDGE = 1e-12  # relative, of a covariance
DAMPING = 1e-3  # of the first step, in units of the diagonal
LESS_DAMPING, LEAST_DAMPING = 10.0, 1e-9  # what the damping is divided by after a step, and its least
SHORTER = 64.0  # factor on the damping of steps that are taken back (``descent.LOST``)
LEAST_FALL = 0.02  # fall of the cost in a step below which the fit ends
HARDLY_LESS = 0.5  # fall of the cost in a step, over that in the step before, from which its columns are made exactly
CREEPING = 0.03  # share of the way to a cost aimed at, below which a step is the last
# error, relative, of the fall of the cost that columns foretell, up to which they serve the next step too
FORETOLD = 0.1


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    Attributes:
        model: chain, parameters and effects at the minimum.
        costs: (n,) whitened sum of squares by joint, prior excluded; of noise as much as the model of the weights has
            (``fair_costs``).
        counts: (n,) real data that entered.
        information: (p, p) of the data on the fitted coordinates, prior excluded; their normal matrix where the noise
            of the position counts for nothing.
        names: of the fitted coordinates.
        remainders: geometric remainder per group, for warm starts.
        weights: under which it was made.
        converged: whether the step criterion was met.
        softer: fits with more error added to the noise that led to this one, if they are known.
        share: of what noise adds to the cost, that was taken off on the way.
    """

    model: Model
    costs: np.ndarray
    counts: np.ndarray
    information: np.ndarray
    names: tuple[str, ...]
    remainders: tuple[np.ndarray, ...]
    weights: Weights
    converged: bool
    softer: tuple[Fit, ...] = ()
    share: float = 0.0

    @property
    def cost(self) -> float:
        """Sum of squares of the whitened residual."""
        return float(np.sum(self.costs))

    @property
    def count(self) -> int:
        """Real numbers that are compared."""
        return int(np.sum(self.counts))

    @property
    def chi2_per_dof(self) -> float:
        """Cost over degrees of freedom: 1 where noise alone is left."""
        return self.cost / max(self.count - len(self.names), 1)

    def covariance(self) -> np.ndarray:
        """(p, p) of the fitted coordinates, scaled by the misfit where that exceeds one.

        With what is known before the data: a parameter that they do not feel keeps that spread.
        """
        m = len(self.model.par.to_log())
        known = [
            q.spread_allowed(v) ** -2 if q.log or q.bounded else 0.0
            for effect in self.model.effects
            for q, v in zip(effect.hypothesis.parameters, effect.p, strict=True)
        ]
        prior = np.concatenate([np.full(m, PRIOR_LOG_STD**-2), [0.0], known])
        return inverse(self.information / max(1.0, self.chi2_per_dof) + np.diag(prior), RIDGE)


def inverse(H: np.ndarray, ridge: float) -> np.ndarray:
    """Inverse of an information matrix, each coordinate in its own scale, steadied by a relative ``ridge``."""
    size = np.sqrt(np.maximum(np.diag(H), LEAST_INFORMATION))
    return np.linalg.inv(H / np.outer(size, size) + ridge * np.eye(len(H))) / np.outer(size, size)


def anneal(
    problem: Problem,
    model: Model,
    *,
    ladder: Sequence[float] = ANNEALING,
    iterations: int = 12,
    gap: float = GAP,
    remainders: Sequence[np.ndarray | None] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Fits under less and less error added to the noise (``ladder``), each from where the last one ended.

    With as much error as ``HELD`` the drives are held near their starting guesses: there the data say little, and a
    gear that once has lost its spring does not find it again.
    """
    stages: list[Fit] = []
    for i, rho in enumerate(ladder):
        say = None if progress is None else lambda text, i=i: progress(f"{text}, stage {i + 1}/{len(ladder)}")
        stages.append(
            fit(
                problem,
                stages[-1].model if stages else model,
                rho=rho,
                hold=HOLD if rho >= HELD else 0.0,
                iterations=iterations,
                gap=gap,
                remainders=stages[-1].remainders if stages else remainders,
                progress=say,
            )
        )
    return replace(stages[-1], softer=tuple(stages[:-1]))


@one_thread_each
def fit(
    problem: Problem,
    model: Model,
    *,
    rho: float = 0.0,
    hold: float = 0.0,
    iterations: int = 12,
    gap: float = GAP,
    weights: Weights | None = None,
    remainders: Sequence[np.ndarray | None] | None = None,
    most: float = np.inf,
    aim: float = np.inf,
    exact: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Fit baseline parameters, timing and effects together.

    Args:
        model: start.
        rho: relative error added to the noise.
        hold: penalty on the drives by their squared distance from the starting guesses, natural logarithm, beyond the
            weak prior; in units of the data that are compared.
        iterations: at most.
        gap: relative fall of the cost in a step below which the fit ends.
        weights: those to fit under; of the start where None.
        remainders: geometric remainders to start from.
        most: cost of the start above which there is no fit.
        aim: cost that decides: a fit above it that only creeps towards it (``CREEPING``) ends, not converged.
        exact: beside laws of the gears the last steps, and the information, are by exact derivatives (``jacobian``),
            which take several times as long. Beside others, and in motions, which hardly show springs, these add
            nothing.

    Raises:
        ArithmeticError: where the start costs more.
    """
    m = len(model.par.to_log())
    center, prior = prior_of(problem, model)
    count = data_count(problem)
    prior[:m] += hold * count
    starts = [None] * len(problem.groups) if remainders is None else remainders
    found = predictions(problem, model, starts, steps=REMAINDER_STEPS)
    if weights is None:
        weights = make_weights(problem, found, rho)
    cost = weighted_cost(problem, found, weights)
    if np.isfinite(most) and not cost <= most:
        raise FloatingPointError(f"a start that costs {cost:.3g}, more than {most:.3g}")
    if problem.motions_alone:
        # Motions hardly show the gears. Where the model is far from the data their springs would follow its error.
        prior = prior * max(1.0, cost / count)
    criterion = Criterion(problem, weights, center, prior)
    at = settled = Point(model, pack(model), found, [p.solution.W for p in found], cost)
    share_known = not has_scatter(problem, model)  # then nothing is taken off
    anew, moves, drift = needs_remainders(problem, model), moves_links(model), np.zeros(len(at.x))
    laws = any(e.hypothesis.gear_law for e in model.effects)
    exact = exact and not problem.motions_alone and laws
    fine = converged = False  # fine: whether the steps are by exact derivatives already
    damping, slow, last = DAMPING, is_slow(model), 0.0
    columns: list[Columns] = []
    for _ in range(iterations):
        fresh = not columns
        columns = columns or jacobians(problem, at.model, at.predictions, exact=fine)
        H, b = normal_equations(problem, columns, at.predictions, weights)
        if not share_known:
            share = trusted_share(H, shared_information(problem, at.model, at.predictions, weights))
            if share < 1.0 and laws:
                share = 0.0  # what noise adds is told as of linear gears, and is more than there can be
            criterion, share_known = replace(criterion, share=share), True
            at = settled = replace(at, noise=criterion.noise(at.predictions))
        step, damping = descend(criterion, at, H, b, damping, anew or fine)
        if step is None:
            converged = fresh and fine == exact
            if converged:
                break
            fine, damping, columns = fine or fresh, DAMPING, []
            continue
        if not (slow and abs(step.gain - step.foretold) <= max(FORETOLD * step.foretold, SLIGHT)):
            columns = []
        drift += np.abs(step.to.x - at.x)
        at, damping = step.to, max(damping / LESS_DAMPING, LEAST_DAMPING)
        if np.max(np.where(moves, drift, 0.0)) > STALE:
            at, drift = criterion.settled(settled, at), np.zeros(len(at.x))
            if at is settled:
                last = 0.0
                damping, columns = max(damping, LEAST_RAISED) * SHORTER, []
                continue
            settled = at
        if progress is not None:
            progress(f"fit: chi2/dof {at.cost / count:.3g}")
        if step.gain < max(gap * at.cost, LEAST_FALL):
            converged = fine == exact
            if converged:
                break
            fine, columns = True, []
        if exact and not fine and HARDLY_LESS * last < step.gain < last:  # along a valley that these columns do not see
            fine, columns = True, []
        last = step.gain
        if step.gain < CREEPING * (at.cost - aim):
            break
    if np.any(drift):
        at = criterion.settled(settled, at)
    if fine != exact or not columns:
        columns = jacobians(problem, at.model, at.predictions, exact=exact)
    H, _ = normal_equations(problem, columns, at.predictions, weights)
    if criterion.share:
        shared = shared_information(problem, at.model, at.predictions, weights)
        H = information_left(H, criterion.share * shared)
    return Fit(
        model=at.model,
        costs=fair_costs(problem, at.predictions, weights),
        counts=data_counts(problem),
        information=H,
        names=coordinate_names(at.model),
        remainders=tuple(at.remainders),
        weights=weights,
        converged=converged,
        share=criterion.share,
    )


def left_beside(
    problem: Problem, result: Fit, preds: Sequence[Prediction], made: Sequence[Columns], more: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of further columns of outputs with all coordinates of a fit free: (c, c) and (c,).

    Args:
        made: derivatives by the coordinates; more: (S, K, n + M, c), by group.
    """
    _, prior = prior_of(problem, result.model)
    p, c = len(prior), more[0].shape[-1]
    wide = [m.replaced({p + i: x[..., i] for i in range(c)}) for m, x in zip(made, more, strict=True)]
    H, b = normal_equations(problem, wide, preds, result.weights)
    across = H[p:, :p] @ inverse(H[:p, :p] + np.diag(prior), RIDGE)
    return H[p:, p:] - across @ H[:p, p:], b[p:] - across @ b[:p]
