"""Optimal operating points: where to measure an arm so that its parameters come out sharpest.

Candidates with information matrices ``H_i`` are weighted, ``M(lambda) = sum lambda_i H_i`` with
``lambda_i >= 0`` and ``sum lambda_i = 1`` the shares of experiment time, so that a criterion of
``M`` is largest: D the determinant, A the inverse of the summed variances, E the smallest
eigenvalue (Wernholt and Lofberg 2007; Pukelsheim 1993; theory.md 5). All three are concave, so that
every result carries a bound on what the best weights could gain beyond it. Several draws of the
parameters from a prior make the design robust: the criterion is averaged over them.

D and A: multiplicative algorithm ``lambda_i <- lambda_i g_i^a`` with ``g_i`` the sensitivity of the
criterion to ``lambda_i``, ``a`` 1 and 1/2 (Silvey, Titterington and Torsney 1978; Yu 2010). At the
optimum ``max g_i = 1`` (Kiefer and Wolfowitz 1960). E: cutting planes ``v^T M v`` at the
eigenvectors, a linear program. Both work on a few candidates and take in those that violate
optimality among all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from ident.candidates import Candidates, draw_candidates
from ident.chain import Structure, build_structure
from ident.graybox import Parameters, parameter_names
from ident.information import conditions, information, linearised, motor_loads
from ident.parallel import one_thread_each
from ident.plan import Plan, make_plan
from robot_assets.errors import DataError
from robot_assets.robot import Robot

CRITERIA = ("D", "A", "E")
TOLERANCE = 1e-3  # optimality gap
LEAST = 1e-6  # weights below it are dropped
INNER, OUTER = 3000, 300  # iterations on the active candidates, and sets of those
SINGULAR = 1e-13  # smallest eigenvalue of the scaled information that counts as seen
POOL = 200  # candidates tried in an exchange
SPREAD = 0.35  # standard deviation of the log-parameters of a prior: a factor of two within two of it
RANDOM = 100  # random designs to compare with


@dataclass(frozen=True)
class Weights:
    """Share of the experiment time for each candidate.

    Attributes:
        weights: (Q,) at least zero, of sum 1.
        gap: bound on what the optimum gains: D: ``max_i tr(M^-1 H_i) / p - 1``, A and E: relative
            fall of the summed variances, and rise of the smallest eigenvalue, at most possible.
        iterations: of the algorithm.
    """

    weights: np.ndarray
    criterion: str
    gap: float
    iterations: int


@dataclass(frozen=True)
class Design:
    """Operating points of an experiment, and how good they are.

    Attributes:
        structure: of the arm. candidates: that it was chosen from.
        weights: optimal shares. chosen: (points,) candidates, repeated where one is measured twice.
        loss: of the chosen points, and of ``RANDOM`` random choices of as many candidates: the
            logarithm of the covariance determinant (D), of the summed variances (A) or of the
            largest eigenvalue of the covariance (E).
        efficiency: of the chosen points against the optimal weights, at most 1.
        std: (p,) standard deviation of the log-parameters ``names`` by noise alone.
        grid: options of ``make_plan`` that the information was computed for.
    """

    structure: Structure
    candidates: Candidates
    weights: Weights
    chosen: np.ndarray
    loss: float
    random_loss: np.ndarray
    efficiency: float
    names: tuple[str, ...]
    std: np.ndarray
    grid: dict
    seed: int

    @property
    def postures(self) -> np.ndarray:
        """(points, n) rad."""
        return self.candidates.q[self.chosen]

    @property
    def ratio(self) -> float:
        """Covariance determinant (or its like for A, E) of the median random choice over this one's."""
        return float(np.exp(np.median(self.random_loss) - self.loss))


@one_thread_each
def design_experiment(
    robot: Robot,
    *,
    points: int = 15,
    candidates: int = 8000,
    criterion: str = "D",
    draws: int = 1,
    realizations: int = 1,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
    **grid,
) -> Design:
    """Operating points for identifying all log-parameters of an arm.

    Args:
        draws: of the parameters from a log-normal prior of ``SPREAD`` about ``robot.toml``; 1: the
            figures of ``robot.toml`` alone.
        grid: sample rate, period, band and the like for ``make_plan``.

    Raises:
        DataError: where an argument is out of range, too few postures are admissible, or the
            experiment cannot show every parameter.
    """
    if points < 1 or draws < 1 or candidates < points:
        found = f"{points} points, {candidates} candidates, {draws} draws"
        raise DataError("design", robot.name, found, "at least one of each, and as many candidates as points")
    _check_criterion(criterion)
    rng = np.random.default_rng(seed)
    structure, nominal = build_structure(robot), Parameters.nominal(robot)
    drawn = draw_candidates(robot, candidates, rng)
    excitation = make_plan(
        robot, points=1, validation_points=0, levels=(1.0,), trajectory=False, seed=seed, postures=drawn.q[:1], **grid
    ).excitation
    given, each = None, []
    for d, par in enumerate(_prior(nominal, draws, rng)):
        lins = linearised(structure, par, drawn.q)
        given = given or conditions(structure, excitation, lins, par, realizations=realizations)
        report = None if progress is None else lambda share, d=d: progress((d + share) / draws)
        each.append(information(structure, par, lins, given, report))
    H = np.stack(each)
    names = parameter_names(robot)
    _check_seen(H, names, robot.name)
    best = optimal_weights(H, criterion=criterion)
    chosen = round_weights(H, best.weights, points, criterion)
    M = H[:, chosen].sum(axis=1)
    loss = float(criterion_loss(M, criterion))
    bound = float(criterion_loss(points * np.tensordot(H, best.weights, (1, 0)), criterion))
    return Design(
        structure=structure,
        candidates=drawn,
        weights=best,
        chosen=chosen,
        loss=loss,
        random_loss=random_losses(H, points, criterion, rng),
        efficiency=float(np.exp((bound - loss) / (M.shape[-1] if criterion == "D" else 1))),
        names=names,
        std=np.sqrt(np.diag(np.linalg.inv(M[0]))),
        grid=grid | {"realizations": realizations},
        seed=seed,
    )


def design_plan(design: Design, *, levels: tuple[float, ...] = (1.0,), validation_points: int = 1) -> Plan:
    """The experiment at the points of a design, and at held-out candidates beside them."""
    rng = np.random.default_rng(design.seed + 1)
    others = np.setdiff1d(np.arange(len(design.candidates.q)), design.chosen)
    held_out = rng.choice(others, min(validation_points, len(others)), replace=False)
    postures = np.concatenate([design.postures, design.candidates.q[held_out]])
    structure = design.structure
    par = Parameters.nominal(structure.robot)
    return make_plan(
        structure.robot,
        points=len(design.chosen),
        validation_points=len(held_out),
        levels=levels,
        seed=design.seed,
        postures=postures,
        **motor_loads(structure, par, linearised(structure, par, postures)),
        **design.grid,
    )


def criterion_loss(M: np.ndarray, criterion: str) -> np.ndarray:
    """Logarithm of what a design is to make small, of information matrices (D, ..., p, p): (...).

    D: mean of ``-log det`` over the D draws; A: log of the mean of ``tr M^-1``; E: minus log of the
    mean of the smallest eigenvalue.
    """
    if criterion == "D":
        return -np.linalg.slogdet(M)[1].mean(axis=0)
    value = np.linalg.eigvalsh(M)
    small = np.maximum(value, 1e-300)
    return np.log((1 / small).sum(axis=-1).mean(axis=0)) if criterion == "A" else -np.log(small[..., 0].mean(axis=0))


def optimal_weights(H: np.ndarray, *, criterion: str = "D", tolerance: float = TOLERANCE) -> Weights:
    """Weights of candidates that are optimal up to a gap.

    Args:
        H: (Q, p, p) information matrices, or (D, Q, p, p) for D draws of the parameters.

    Raises:
        DataError: for a criterion that there is not, or candidates that together are singular.
    """
    _check_criterion(criterion)
    H = H[None] if H.ndim == 3 else H
    _check_seen(H, None, "optimal_weights")
    return _cutting_planes(H, tolerance) if criterion == "E" else _multiplicative(H, criterion, tolerance)


def round_weights(H: np.ndarray, weights: np.ndarray, points: int, criterion: str = "D") -> np.ndarray:
    """(points,) candidates whose equal shares come close to the weights, and then better.

    Efficient rounding (Pukelsheim and Rieder 1992), then exchange of one point at a time for the
    candidate that lowers the loss most (Fedorov 1972), until none does.
    """
    H = H[None] if H.ndim == 3 else H
    chosen = np.repeat(np.arange(len(weights)), apportion(weights, points))
    M = np.tensordot(H, weights, (1, 0))
    promising = np.argsort(_sensitivity(H, M, "A" if criterion == "E" else criterion))[-POOL:]
    pool = np.union1d(promising, chosen)
    loss = float(criterion_loss(H[:, chosen].sum(axis=1), criterion))
    for _ in range(50):
        before = loss
        for k in range(points):
            rest = H[:, np.delete(chosen, k)].sum(axis=1)
            losses = criterion_loss(rest[:, None] + H[:, pool], criterion)
            best = int(np.argmin(losses))
            if losses[best] < loss - 1e-10:
                loss, chosen[k] = float(losses[best]), pool[best]
        if loss > before - 1e-9:
            break
    return np.sort(chosen)


def apportion(weights: np.ndarray, points: int) -> np.ndarray:
    """(Q,) whole numbers of sum ``points`` close to ``points * weights``; Pukelsheim and Rieder 1992.

    Where more candidates carry weight than there are points, the heaviest are kept.
    """
    support = np.flatnonzero(weights > LEAST)
    support = support[np.argsort(weights[support])[::-1][:points]]
    w = weights[support] / weights[support].sum()
    counts = np.maximum(np.ceil((points - 0.5 * len(support)) * w), 1).astype(int)
    while counts.sum() < points:
        counts[np.argmin(counts / w)] += 1
    while counts.sum() > points:
        counts[np.argmax(np.where(counts > 0, (counts - 1) / w, -1.0))] -= 1
    out = np.zeros(len(weights), int)
    out[support] = counts
    return out


def random_losses(
    H: np.ndarray, points: int, criterion: str, rng: np.random.Generator, count: int = RANDOM
) -> np.ndarray:
    """(count,) losses of random choices of as many different candidates, measured as long."""
    H = H[None] if H.ndim == 3 else H
    picks = np.array([rng.choice(H.shape[1], points, replace=False) for _ in range(count)])
    return criterion_loss(np.stack([H[:, pick].sum(axis=1) for pick in picks], axis=1), criterion)


def _prior(nominal: Parameters, draws: int, rng: np.random.Generator) -> list[Parameters]:
    x = nominal.to_log()
    return [nominal, *(nominal.with_log(x + SPREAD * rng.standard_normal(len(x))) for _ in range(draws - 1))]


def _check_criterion(criterion: str) -> None:
    if criterion not in CRITERIA:
        raise DataError("criterion", "design", repr(criterion), f"one of {CRITERIA}")


def _check_seen(H: np.ndarray, names: tuple[str, ...] | None, where: str) -> None:
    """Refuse candidates that together leave a parameter, or a combination of some, unseen."""
    mean = H.mean(axis=1)
    size = np.sqrt(np.einsum("dii->di", mean))
    scale = np.where(size > 0, size, 1.0)
    value, vector = np.linalg.eigh(mean / (scale[:, :, None] * scale[:, None, :]))
    d = int(np.argmin(value[:, 0]))
    if not np.all(np.isfinite(value)) or value[d, 0] < SINGULAR:
        worst = int(np.argmax(np.abs(vector[d, :, 0])))
        raise DataError(
            "parameters", where, f"nothing seen of {names[worst] if names else worst}", "a band that shows it"
        )


def _inverse(M: np.ndarray) -> np.ndarray:
    """Inverse of (D, p, p), scaled to a unit diagonal meanwhile: parameters differ by many decades."""
    d = np.sqrt(np.einsum("dii->di", M))
    scale = d[:, :, None] * d[:, None, :]
    return np.linalg.inv(M / scale) / scale


def _sensitivity(H: np.ndarray, M: np.ndarray, criterion: str) -> np.ndarray:
    """(Q,) gain of D or A by the share of each candidate, of weighted mean 1 at ``M`` (D, p, p)."""
    W = _inverse(M)
    if criterion == "D":
        return _traces(H, W) / (len(M) * M.shape[-1])
    return _traces(H, W @ W) / np.einsum("dii->", W)


def _traces(H: np.ndarray, W: np.ndarray) -> np.ndarray:
    """(Q,) ``sum_d tr(W_d H_di)``."""
    D, Q, p, _ = H.shape
    return sum(H[d].reshape(Q, p * p) @ W[d].ravel() for d in range(D))


def _multiplicative(H: np.ndarray, criterion: str, tolerance: float) -> Weights:
    D, Q, p, _ = H.shape
    step = 1.0 if criterion == "D" else 0.5
    g = _sensitivity(H, H.mean(axis=1), criterion)
    active = np.argsort(g)[-min(Q, 4 * p) :]
    w, iterations, gap = np.full(len(active), 1.0 / len(active)), 0, np.inf
    for _ in range(OUTER):
        part = H[:, active]
        flat = part.reshape(D, len(active), p * p)
        for _ in range(INNER):
            M = np.stack([(w @ f).reshape(p, p) for f in flat])
            g = _sensitivity(part, M, criterion)
            iterations += 1
            if g.max() - 1 < 0.3 * tolerance:
                break
            w = w * g**step
            w /= w.sum()
        g = _sensitivity(H, M, criterion)
        gap = float(g.max() - 1)
        if gap < tolerance:
            break
        keep = w > LEAST
        new = np.argsort(g)[-p:]
        new = np.setdiff1d(new[g[new] > 1], active[keep])
        active = np.concatenate([active[keep], new])
        w = np.concatenate([w[keep], np.full(len(new), 0.1 / max(len(new), 1))])
        w /= w.sum()
    weights = np.zeros(Q)
    weights[active] = w
    return Weights(weights, criterion, gap, iterations)


def _cutting_planes(H: np.ndarray, tolerance: float) -> Weights:
    """E-optimal weights: ``max sum_d t_d`` with ``v^T M_d v >= t_d`` for ever more unit vectors v.

    Cuts are made where the linear program ends and part of the way there from the best weights so far,
    which spares it most of its zigzag (Ben-Ameur and Neto 2007). For multipliers ``mu`` of the cuts, of
    sum 1 within each draw, ``max_i sum mu_c v_c^T H_i v_c`` bounds the optimum from above.
    """
    D, Q, p, _ = H.shape
    best = _multiplicative(H, "A", 0.1).weights
    active = np.flatnonzero(best > 0)
    value, vector = np.linalg.eigh(np.tensordot(H, best, (1, 0)))
    lower, upper, iterations = float(value[:, 0].sum()), np.inf, 0
    cuts = [list(v.T) for v in vector]
    while upper > lower * (1 + tolerance) and iterations < OUTER:
        iterations += 1
        planes = [np.stack([np.outer(v, v).ravel() for v in c]) for c in cuts]
        rows = [H[d, active].reshape(-1, p * p) @ planes[d].T for d in range(D)]
        shares, dual, target = _program(rows)
        use = _traces(H, np.stack([(m @ b).reshape(p, p) for m, b in zip(dual, planes, strict=True)]))
        upper = min(upper, float(use.max()))
        end = np.bincount(active, np.maximum(shares, 0), Q)
        for weights in (0.7 * best + 0.3 * end, end):
            value, vector = np.linalg.eigh(np.tensordot(H, weights, (1, 0)))
            if value[:, 0].sum() > lower:
                lower, best = float(value[:, 0].sum()), weights
            for d in range(D):
                cuts[d] += [vector[d, :, k] for k in range(min(4, p)) if value[d, k] < 1.5 * upper]
        new = np.argsort(use)[-10:]
        active = np.union1d(active, new[use[new] > target])
    return Weights(best / best.sum(), "E", float(upper / lower - 1), iterations)


def _program(rows: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray], float]:
    """Shares (A,), multipliers of the cuts of each draw, and value of the linear program.

    Args:
        rows: for each draw (A, cuts), what each active candidate adds to each cut.
    """
    A, D = len(rows[0]), len(rows)
    # Every cut is scaled to itself: those of well-known directions are larger by many decades.
    size = [r.max(axis=0) for r in rows]
    unit = min(float(x.min()) for x in size)
    blocks = [np.hstack([-(r / x).T, np.outer(unit / x, np.eye(D)[d])]) for d, (r, x) in enumerate(zip(rows, size))]
    result = scipy.optimize.linprog(
        np.append(np.zeros(A), -np.ones(D)),
        A_ub=np.vstack(blocks),
        b_ub=np.zeros(sum(len(b) for b in blocks)),
        A_eq=np.append(np.ones(A), np.zeros(D))[None],
        b_eq=[1.0],
        bounds=[(0, None)] * A + [(None, None)] * D,
        method="highs",
    )
    if result.x is None:
        raise DataError(
            "E-optimal weights", "design", result.message, "a solvable linear program; try criterion D or A"
        )
    mu = np.split(-result.ineqlin.marginals / np.concatenate(size), np.cumsum([len(b) for b in blocks])[:-1])
    mu = [np.maximum(m, 0) / max(np.maximum(m, 0).sum(), 1e-300) for m in mu]
    return result.x[:A], mu, float(unit * result.x[A:].sum())
