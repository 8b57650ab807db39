"""Link encoders that come late against the motor encoders.

The torque equation does not hold the link encoders. What they show is compared with the motion of
the links that the model predicts along the motor motion: a delay makes the difference of the two
encoders follow the velocity, which looks like wind-up of the gear and is not (effects.md). What else
they show of the gears is fitted with the torque where that hardly shows these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.derivatives import as_real
from ident.extended import Prediction
from ident.group import Group, mean_over_lines
from ident.hypotheses.friction import direction
from ident.problem import Problem

SURE = 5.0  # standard deviations from which a delay is one
LEAST = 0.02  # delay in samples that is worth a name
# delay in samples from which little else looks like it: viscous friction of the link winds the gear up by its velocity
# too
CLEAR = 0.1
EXPLAINED = 0.5  # share of what stiffness and lost motion leave that it must explain
BLOCKS = 12  # of lines, left out one after another for the standard deviation
SMOOTH = 8  # lines on either side over which the remaining power is averaged
PASSES = 3  # of weighting and fitting
LEAST_NOISE = 1e-7  # of a link encoder over its motion, where differences of samples show less


@dataclass(frozen=True)
class LinkDelay:
    """How late the link encoder of a joint comes, with standard deviation; s.

    ``clear`` where a viscous friction of the link, which winds up the gear alike, would have to be unlikely large.
    """

    joint: int
    delay: float
    std: float
    clear: bool = True


def comparable_links(problem: Problem) -> bool:
    """Whether link encoders can be compared with a model: where there are motions alone.

    Below the resonances of an arm its torque hardly shows the gears. Multisines pass these, and need no link encoders.
    """
    known = [g.link_std for g in problem.groups if g.link_std is not None]
    return problem.motions_alone and bool(np.any(np.isfinite(known)))


def with_link_encoders(problem: Problem, late: Sequence[LinkDelay]) -> Problem:
    """The problem with its link encoders compared, those that come late led back in time."""
    delay = np.zeros(problem.structure.n)
    delay[[x.joint for x in late]] = [x.delay for x in late]
    noise = np.fmax.reduce([g.link_std for g in problem.groups if g.link_std is not None])
    return replace(problem, groups=tuple(_compared(group, noise, delay) for group in problem.groups))


def _compared(group: Group, noise: np.ndarray, delay: np.ndarray) -> Group:
    """A group with its link encoders compared: noise, rad, and delay, s, (n,) each."""
    if group.Q_link is None:
        return group
    size = np.std(group.to_time(group.Q), axis=(0, 1))
    return replace(
        group,
        Q_link=group.Q_link * np.exp(1j * group.omega[:, None] * delay),
        link_std=np.maximum(noise, LEAST_NOISE * size),
        links=tuple(int(j) for j in np.flatnonzero(np.all(np.isfinite(group.Q_link), axis=(0, 1)))),
    )


def find_link_delays(
    groups: Sequence[Group], predictions: Sequence[Prediction], sample_time: float
) -> tuple[LinkDelay, ...]:
    """Joints whose link encoder comes late; none where there are no link encoders.

    Args:
        groups: link encoders as they were recorded.
    """
    out = []
    for j in range(groups[0].U.shape[-1]):
        pairs = [
            (group, pred)
            for group, pred in zip(groups, predictions, strict=True)
            if group.Q_link is not None and np.all(np.isfinite(group.Q_link[..., j]))
        ]
        found = _fit_delay(pairs, j) if pairs else None
        if found is not None and found[0] > LEAST * sample_time:
            out.append(LinkDelay(j, *found, clear=found[0] > CLEAR * sample_time))
    return tuple(out)


def _equations(group: Group, pred: Prediction, j: int, delay: float) -> np.ndarray:
    """Link encoder less predicted link motion, and its responses to more delay, a softer gear and lost motion.

    (S, K - 1, 4) complex, rad; the mean position is left out.
    """
    assert group.Q_link is not None  # of which links are compared
    motion, s = pred.motion(), 1j * group.omega
    late = np.exp(-s * delay)
    q_link = late * pred.solution.Q_a[..., pred.structure.driven[j]]
    columns = [
        group.Q_link[..., j] - q_link,
        -s * q_link,
        -late * pred.solution.delta[..., j],
        -late * motion.lines(direction(motion.v(j))),
    ]
    return group.observe(np.stack(columns, axis=-1))[:, 1:]


def _fit_delay(pairs: Sequence[tuple[Group, Prediction]], j: int) -> tuple[float, float] | None:
    """Delay and standard deviation, s, where it is sure and explains most of what is left without it."""
    delay = 0.0
    weights: list[np.ndarray | float] = [1.0] * len(pairs)
    for _ in range(PASSES):
        rows = [_equations(group, pred, j, delay) for group, pred in pairs]
        x = _solve(np.concatenate([_stack(r, w) for r, w in zip(rows, weights, strict=True)]), (1, 2, 3))
        weights = [_inverse_noise(r, x) for r in rows]
        delay += x[0]
    data = np.concatenate([_stack(r, w) for r, w in zip(rows, weights, strict=True)])
    undelayed = [_equations(group, pred, j, 0.0) for group, pred in pairs]
    without = _rest(np.concatenate([_stack(r, w) for r, w in zip(undelayed, weights, strict=True)]), (2, 3))
    block = np.arange(len(data)) % BLOCKS
    parts = np.array([_solve(data[block != k], (1, 2, 3))[0] for k in range(BLOCKS)])
    std = float(np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((parts - parts.mean()) ** 2)))
    sure = delay > SURE * std and without - _rest(data, (1, 2, 3)) > EXPLAINED * without
    return (float(delay), std) if sure else None


def _stack(rows: np.ndarray, weight: np.ndarray | float) -> np.ndarray:
    """Complex (S, K, 4) as weighted real rows (2 S K, 4)."""
    return as_real(rows * np.reshape(np.sqrt(weight), (-1, 1)))


def _inverse_noise(rows: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Weight of each line by what a solution leaves there; (K,)."""
    left = rows[..., 0] - rows[..., 1:] @ x
    power = mean_over_lines(np.mean(np.abs(left) ** 2, axis=0)[:, None], SMOOTH)[:, 0]
    return 1.0 / np.maximum(power, 1e-300)


def _solve(data: np.ndarray, columns: Sequence[int]) -> np.ndarray:
    A = data[:, columns]
    size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    return np.linalg.lstsq(A / size, data[:, 0], rcond=1e-10)[0] / size


def _rest(data: np.ndarray, columns: Sequence[int]) -> float:
    left = data[:, 0] - data[:, columns] @ _solve(data, columns)
    return float(left @ left)
