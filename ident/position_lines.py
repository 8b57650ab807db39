"""Wave numbers at which the residual torque of a joint repeats in its motor angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.extended import Prediction
from ident.problem import Problem

MOTOR_ORDERS = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)  # periods in a turn of the motor
PERIODOGRAM_RECORDS = 12  # loudest records that the search over motor angle looks at
WAVE_STEPS = 259, 2000  # steps of that search: for periodic records, and at most
WAVES_AT_ONCE = 260
LONG_WAVES = 3  # longer than a posture shows, that are tried
LEAST_POSTURES = 3  # a wave of any length fits the constants of two
FEWEST = 20  # samples in which a wave must lie in the compared band
FOLLOWED = 0.1  # share of the path of a motion along which a ripple must, for its wave number to be looked for
REFINED_SAMPLES = 3000  # that wave numbers are refined with

Part = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Motor angle (T,), what is known beforehand (T, m), orthonormal, and the torque that is left without it (T,)."""


def wave_numbers(problem: Problem, predictions: Sequence[Prediction], joint: int) -> tuple[float, ...]:
    """Candidate periodicities (1/rad) of a joint: those that its residual shows, and motor orders.

    A motion of less than a period does not show its wave number, but parts that turn with the motor
    repeat a whole number of times in its turn.
    """
    ratio = problem.structure.robot.joints[joint].gear_ratio
    return (*position_lines(problem, predictions, joint), *motor_orders(ratio))


def motor_orders(gear_ratio: float) -> tuple[float, ...]:
    """Wave numbers (1/rad of the joint) of parts that turn with its motor; none of a joint without a gear."""
    return tuple(order * gear_ratio for order in MOTOR_ORDERS) if gear_ratio > 1.0 else ()


def position_lines(
    problem: Problem, predictions: Sequence[Prediction], joint: int, count: int = 2
) -> tuple[float, ...]:
    """Wave numbers (1/rad) at which the residual torque of a joint is periodic in its motor angle.

    A least-squares periodogram over the motor angle: for each wave number, sine and cosine with
    weights of their own in every posture, so that no phase has to be carried between postures;
    then the best ones are refined with one phase for all. Waves that are longer than a posture shows are sought over all
    postures from the first.
    """
    records = _loudest(problem, predictions, joint)
    span = max((np.ptp(x.q) for x in records), default=0.0)
    if span <= 0:
        return ()
    step = 0.7 * np.pi / span
    steps = int(np.clip(max(x.highest() for x in records) / step, *WAVE_STEPS))
    coarse = step * np.arange(1, steps + 1)
    power = sum((_own_power(x, step, steps) for x in records), np.zeros(steps))
    total = sum(float(x.residual @ x.residual) for x in records)
    best: list[float] = []
    for k in np.argsort(-power):
        if all(abs(coarse[k] - b) > 2.5 * step for b in best):
            best.append(float(coarse[k]))
        if len(best) == count or power[k] < 1e-3 * total:
            break
    return (*(f for n in best for f in _refine(records, n, step)), *_long_waves(records, step))


@dataclass(frozen=True)
class _Record:
    """Residual torque of a joint over its motor angle, samples of one record.

    ``q``, ``residual`` (T,), the latter without what ``nuisance`` (T, m), orthonormal, explains; ``torque`` (T,) with
    it; ``drive`` (T, 2): velocity and acceleration; ``speed`` (T,) rad/s; ``top`` rad/s: frequency up to which a motion
    is compared, infinite for periodic records.
    """

    q: np.ndarray
    torque: np.ndarray
    drive: np.ndarray
    speed: np.ndarray
    nuisance: np.ndarray
    residual: np.ndarray
    top: float

    def highest(self) -> float:
        """Wave number beyond which a ripple lies in the compared band only where the joint creeps."""
        if np.isinf(self.top):
            return 0.0
        # Speed below which a tenth of the path is made.
        order = np.sort(self.speed)
        slow = order[np.searchsorted(np.cumsum(order), FOLLOWED * order.sum())]
        return float(self.top / max(slow, 1e-300))


def _loudest(problem: Problem, predictions: Sequence[Prediction], joint: int) -> list[_Record]:
    """The records of every group in which most of a joint's torque is unexplained."""
    each, out = max(2, PERIODOGRAM_RECORDS // len(problem.groups)), []
    for group, pred in zip(problem.groups, predictions, strict=True):
        motion = pred.motion()
        R = (group.U - pred.U)[..., joint : joint + 1].copy()
        R[:, group.n_compared :] = 0.0
        signals = (motion.q(joint), motion.v(joint), motion.acceleration(joint), group.to_time(R)[..., 0])
        if group.window is None:
            pick, top = np.arange(0, signals[0].shape[1], max(1, signals[0].shape[1] // 600)), np.inf
        else:
            # The return that closes a motion was not recorded.
            inside = np.flatnonzero(group.window > 0.5)
            pick, top = (
                inside[:: max(1, len(inside) // max(600, 3 * group.n_compared))],
                float(group.omega[group.n_compared - 1]),
            )
        records = []
        for q, v, a, r in zip(*(x[:, pick] for x in signals), strict=True):
            known = np.stack([np.ones_like(v), q - q.mean(), v, a, np.sign(v)], axis=1)
            known = np.linalg.qr(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300))[0]
            left = r - known @ (known.T @ r)
            records.append(_Record(q, r, np.stack([v, a], axis=1), np.abs(v), known, left, top))
        out += sorted(records, key=lambda x: -float(x.residual @ x.residual))[:each]
    return out


def _own_power(x: _Record, step: float, count: int) -> np.ndarray:
    """Fall of the squared residual of a record by waves at multiples of ``step``, each where it lies in the compared
    band."""
    power = np.zeros(count)
    for first in range(1, count + 1, WAVES_AT_ONCE):
        n = step * np.arange(first, min(first + WAVES_AT_ONCE, count + 1))
        seen = x.speed * n[0] <= x.top
        if seen.sum() < FEWEST:
            break
        q, N, r = x.q[seen], x.nuisance[seen], x.residual[seen]
        E = np.multiply(*_waves(q - x.q.mean(), n[0], step, len(n))).reshape(len(q), -1)[:, : len(n)]
        if np.isfinite(x.top):
            E = E * (x.speed[seen][:, None] * n <= x.top)
        sizes = np.einsum("tk,tk->k", E, E.conj()).real, np.einsum("tk,tk->k", E, E)
        along = N.T @ E
        # What is known beforehand is orthonormal over all samples, of which a wave may have a part.
        sizes = (
            sizes[0] - np.einsum("mk,mk->k", along, along.conj()).real,
            sizes[1] - np.einsum("mk,mk->k", along, along),
        )
        power[first - 1 : first - 1 + len(n)] = _fall(*sizes, r @ E, 1e-9 * len(r) ** 2)
    return power


def _refine(records: Sequence[_Record], center: float, width: float, count: int = 4) -> list[float]:
    """Best wave numbers near ``center`` with one phase for all records.

    Postures far apart leave a comb of nearly equal maxima; the best of them are all returned.
    """
    spread = np.ptp([x.q.mean() for x in records]) + np.ptp(records[0].q)
    return _peaks(_seen(records, center), spread, center - 1.5 * width, center + 1.5 * width, count)


def _peaks(parts: Sequence[Part], spread: float, first: float, last: float, count: int) -> list[float]:
    """Wave numbers from ``first`` to ``last`` that explain most, over motor angles that far apart."""
    count_fine = int(np.clip(2 * (last - first) * spread, 41, 1500))
    step = (last - first) / (count_fine - 1)
    power = _coherent_power(parts, first, step, count_fine)
    peaks = np.flatnonzero((power >= np.roll(power, 1)) & (power >= np.roll(power, -1)))
    out = []
    for k in peaks[np.argsort(-power[peaks])][:count]:
        nearest = first + (k - 1) * step
        near = _coherent_power(parts, nearest, step / 20, 41)
        out.append(float(nearest + np.argmax(near) * step / 20))
    return out


def _long_waves(records: Sequence[_Record], width: float) -> list[float]:
    """Wave numbers, from one period over all postures to about ``2 width``, that explain most of the torque of all
    periodic records together.

    Over less than a period a wave is a constant and a slope, which a posture alone cannot tell from other errors; over
    several postures the constants and slopes are those of one wave. Friction and inertia of the motor are the same in
    all.
    """
    whole = [x for x in records if np.isinf(x.top)]
    at = np.sort([x.q.mean() for x in whole])
    if 1 + np.sum(np.diff(at) > max((np.ptp(x.q) for x in whole), default=0.0)) < LEAST_POSTURES:
        return []
    thin = [slice(None, None, max(1, len(x.q) * len(whole) // REFINED_SAMPLES)) for x in whole]
    q, r = (np.concatenate([getattr(x, key)[t] for x, t in zip(whole, thin, strict=True)]) for key in ("q", "torque"))
    N = np.linalg.qr(np.concatenate([x.drive[t] for x, t in zip(whole, thin, strict=True)]))[0]
    spread = np.ptp(q)
    return _peaks([(q, N, r - N @ (N.T @ r))], spread, 2.0 * np.pi / spread, 2.5 * width, LONG_WAVES)


def _seen(records: Sequence[_Record], wave_number: float) -> list[Part]:
    """Motor angle, what is known beforehand and residual of each record where a wave lies in the compared band; some
    thousand samples."""
    most = max(250, REFINED_SAMPLES // len(records))
    out = []
    for x in records:
        seen = np.flatnonzero(x.speed * wave_number <= x.top)
        seen = seen[:: max(1, len(seen) // most)]
        if len(seen) > x.nuisance.shape[1]:
            N = np.linalg.qr(x.nuisance[seen])[0]
            r = x.residual[seen]
            out.append((x.q[seen], N, r - N @ (N.T @ r)))
    return out


def _coherent_power(parts: Sequence[Part], first: float, step: float, count: int) -> np.ndarray:
    """Fall of the squared residual by a sine and a cosine of each wave number, one phase for all records.

    Of each wave what is known of its record beforehand is left out: of less than a period that is most of it.
    """
    power, square, moment, samples = np.zeros(count), np.zeros(count, complex), np.zeros(count, complex), 0
    for q, N, r in parts:
        coarse, fine = (x.reshape(len(q), -1) for x in _waves(q, first, step, count))

        def along(x: np.ndarray, coarse: np.ndarray = coarse, fine: np.ndarray = fine) -> np.ndarray:
            return ((coarse * x[:, None]).T @ fine).ravel()[:count]

        power += len(q)
        square += ((coarse**2).T @ fine**2).ravel()[:count]
        moment += along(r)
        samples += len(q)
        for known in N.T:
            share = along(known)
            power -= np.abs(share) ** 2
            square -= share**2
    return _fall(power, square, moment, 1e-9 * max(samples, 1) ** 2)


def _waves(q: np.ndarray, first: float, step: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Factors (T, a, 1) and (T, 1, b) of ``exp(j q w)`` at wave numbers ``w`` from ``first`` in equal steps.

    ``count`` of them or a few more, in the order of ``(a, b)``: an exponential costs far more than a product.
    """
    width = int(np.ceil(np.sqrt(count)))
    coarse = np.exp(1j * np.outer(q, first + step * width * np.arange(-(-count // width))))
    fine = np.exp(1j * step * np.outer(q, np.arange(width)))
    return coarse[:, :, None], fine[:, None, :]


def _fall(power: np.ndarray | float, square: np.ndarray, moment: np.ndarray, least: float) -> np.ndarray:
    """Fall of the squared residual by cosine and sine, the real and imaginary parts of waves ``E``.

    Args:
        power, square, moment: sums over the samples of ``E E*``, ``E E`` and ``E`` times the residual.
        least: smallest determinant of the normal equations.
    """
    cc, ss, cs = 0.5 * (power + square.real), 0.5 * (power - square.real), 0.5 * square.imag
    det = np.maximum(cc * ss - cs**2, least)
    return (ss * moment.real**2 - 2 * cs * moment.real * moment.imag + cc * moment.imag**2) / det
