"""Laws of friction and of gears along time, in compiled code.

Those with memory are stepped. Each takes (S, T) signals over one period and returns the periodic steady state: the
period is run again until it repeats (friction elements forget in one).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ident.hypotheses.yielding import SLIP, along_path, yielding_point

TURNED = 19.1  # argument beyond which tanh is one in double precision
LEAST_STEP = 1e-3  # of a velocity in a step of the grid, over the width of a turn that is averaged over it
RESOLVED = 1e-3  # of the half of a middle, within which a step of time need not be averaged over
LEAST_SLOPE = 1e-6  # of what is solved for the torque of a middle
NEWTON_STEPS = 30
VECTORS = {"contract", "reassoc", "nsz"}  # what lets the compiler step several records at once
CUBIC, BACKLASH, SOFTENING, HYSTERESIS, LINK, CABLE = 0, 1, 2, 3, 4, 5


class Law(NamedTuple):
    """A law of the gear, or of a cable on a link.

    Attributes:
        code: which; a, b: its parameters. ``BACKLASH`` takes ``k x`` within a dead band ``a`` wide, and a damper ``b``
            with it; ``HYSTERESIS`` yields at ``b`` after a stiffness ``a``; ``LINK`` is ``a x + b tanh(x' / k)`` on a
            link; ``CABLE`` is ``a x`` and a spring ``k`` that yields at ``b`` there.
        k: linear stiffness of the gear, N m/rad.
        exponent, recoil: of an element that yields (see ``yielding``); a Maxwell slip where nothing is said.
        start: torque of such an element where a motion begins, over that at which it yields: it was left by motions
            that were not recorded. What repeats has none.
        lead: s, by which ``LINK`` turns before the velocity does: of ``x' + lead x''`` in place of ``x'``.
    """

    code: int
    a: float
    b: float
    k: float
    exponent: float = SLIP
    recoil: float = 0.0
    start: float = 0.0
    lead: float = 0.0

    @property
    def shape(self) -> tuple[int, float, float, float, float, float]:
        """What the compiled code asks for: all but the ``start`` and the ``lead``."""
        return self[:6]


@njit(cache=True, nogil=True)
def smooth_sign(v: np.ndarray, smoothing: float, clipped: float = 0.0) -> np.ndarray:
    """Sign of ``v`` (S, T), averaged over each step of the grid, in which ``v`` goes along a line.

    A ``smoothing`` above zero widens the turn to ``tanh`` of that width, or of that of the step; ``clipped`` is the
    share of a turn that is a line of that width instead.
    """
    S, T = v.shape
    out = np.empty((S, T))
    for i in range(S):
        for k in range(T):
            slope = 0.25 * abs(v[i, (k + 1) % T] - v[i, k - 1])
            if smoothing <= 0:
                out[i, k] = min(max(v[i, k] / max(slope, 1e-300), -1.0), 1.0)
                continue
            x = v[i, k] / np.sqrt(0.36 * slope * slope + smoothing * smoothing)
            out[i, k] = np.tanh(x) if abs(x) < TURNED else np.sign(x)
            if clipped > 0.0:
                line = mean_of_line(v[i, k], max(slope, LEAST_STEP * smoothing), smoothing)
                out[i, k] += clipped * (line - out[i, k])
    return out


@njit(cache=True, nogil=True)
def mean_of_line(x: float, half: float, width: float) -> float:
    """Mean of ``x / width``, at most 1 either way, over ``half`` on both sides of ``x``."""
    total = 0.0
    for sign in (1.0, -1.0):
        end = abs(x + sign * half)
        total += sign * (0.5 * end * end / width if end < width else end - 0.5 * width)
    return total / (2.0 * half)


@njit(cache=True, nogil=True)
def spring_torque(code: int, a: float, b: float, k: float, x: float, x_old: float, h_old: float) -> float:
    """Torque beyond ``k x`` of a gear at deflection ``x`` whose law has no kinks; or of a ``CABLE``, see
    ``loop_sweep``, on a link."""
    if code == 5:
        return a * x + min(max(h_old - a * x_old + k * (x - x_old), -b), b)
    if code == 0:
        return a * x * x * x
    return min(max(h_old + a * (x - x_old), -b), b)


@njit(cache=True, nogil=True)
def spring_point(
    code: int, a: float, b: float, k: float, free: float, direct: float, x_old: float, x_older: float, h_old: float
) -> float:
    """Deflection ``x`` that solves ``x + direct h(x) = free``: a rising function of ``x``."""
    if code == 0:
        x = 2.0 * x_old - x_older
        for _ in range(60):
            step = (x + direct * a * x * x * x - free) / (1.0 + 3.0 * direct * a * x * x)
            x -= step
            if abs(step) <= 1e-7 * abs(x) + 1e-18:  # the next one would be its square
                break
        return x
    if code == 3:
        x = (free - direct * (h_old - a * x_old)) / (1.0 + direct * a)
        h = h_old + a * (x - x_old)
        if h > b:
            return free - direct * b
        if h < -b:
            return free + direct * b
        return x
    held = h_old - (a + k) * x_old
    x = (free - direct * held) / (1.0 + direct * (a + k))
    z = held + k * x
    if z > b:
        return (free - direct * b) / (1.0 + direct * a)
    if z < -b:
        return (free + direct * b) / (1.0 + direct * a)
    return x


@njit(cache=True, nogil=True)
def middle_of(code: int, a: float, b: float, k: float) -> tuple[float, float]:
    """What the middle of a dead band, or of a gear that is softer there, takes of the spring, N m/rad, and its half,
    rad."""
    return (k, 0.5 * a) if code == 1 else (k - a, b)


@njit(cache=True, nogil=True)
def taken(half: float, lag: float, x: float) -> float:
    """What a middle ``half`` wide to either side takes from a gear at ``x``, as a deflection of what is taken there.

    ``lag`` is that of the damper which is taken with the spring, over the spring. A flank carries what is not taken
    from it, and never pulls.
    """
    if x > half:
        return min(x + lag, half)
    return max(x + lag, -half) if x < -half else x + lag


@njit(cache=True, nogil=True)
def taken_until(half: float, lag: float, x: float) -> float:
    """Integral of ``taken`` by ``x``, for a ``lag`` of at least zero."""
    if x <= -half - lag:
        return -half * x
    inside = min(x, half)
    total = half * (half + lag) + 0.5 * ((inside + lag) ** 2 - half**2)
    return total + half * (x - inside)


@njit(cache=True, nogil=True)
def mean_taken(half: float, lag: float, x: float, spread: float) -> float:
    """Mean of ``taken`` over ``x`` plus and minus half of ``spread``, which the deflection goes in a step of time."""
    if lag < 0.0:
        return -mean_taken(half, -lag, -x, spread)
    low, high = x - 0.5 * spread, x + 0.5 * spread
    if low > half or high < -half - lag or (low > -half - lag and high < half) or spread < RESOLVED * half:
        return taken(half, lag, x)
    return (taken_until(half, lag, high) - taken_until(half, lag, low)) / spread


@njit(cache=True, nogil=True)
def in_a_step(x: np.ndarray, t: int) -> float:
    """How far a periodic motion (T,) goes in the step about a point of it."""
    return 0.5 * abs(x[(t + 1) % len(x)] - x[t - 1])


@njit(cache=True, nogil=True)
def middle_torque(
    slope: float, half: float, lag: float, q: float, v: float, dq: float, dv: float, spread: float
) -> float:
    """Torque ``h = -slope mean_taken`` of a middle at ``x = q - dq h`` with the velocity ``v - dv h``.

    By Newton's steps from where the gear is not within its middle, or is at one point of it.

    Args:
        lag: time by which what is taken is late, s.
    """
    y = (q + lag * v) / max(1.0 - slope * (dq + lag * dv), LEAST_SLOPE)  # where all is taken
    x = q + dq * slope * y
    if x > half:
        y = min(y, half)
    elif x < -half:
        y = max(y, -half)
    h = -slope * y
    if spread < RESOLVED * half:
        return h
    best, least = h, np.inf
    for _ in range(NEWTON_STEPS):
        x, late = q - dq * h, lag * (v - dv * h)
        miss = h + slope * mean_taken(half, late, x, spread)
        if abs(miss) < least:
            best, least = h, abs(miss)
        if abs(miss) <= 1e-9 * abs(slope) * half:
            break
        low, high = x - 0.5 * spread, x + 0.5 * spread
        rise = (taken(half, late, high) - taken(half, late, low)) / spread
        within = max(min(high, half) - max(low, -half), 0.0) / spread
        h -= miss / max(1.0 - slope * (dq * rise + dv * lag * within), LEAST_SLOPE)
    return best


def sees_rate(law: Law) -> bool:
    """Whether a law depends on a velocity."""
    return law.code == LINK or (law.code == BACKLASH and law.b > 0.0)


def largest_slope(law: Law, reach: float) -> float:
    """Largest stiffness of a nonlinear gear within a deflection ``reach``, N m/rad."""
    if law.code == CUBIC:
        return law.k + 3.0 * law.a * reach**2
    return law.k + law.a * (1.0 + max(law.recoil, 0.0)) if law.code == HYSTERESIS else law.k


def mean_slope(law: Law, x: np.ndarray) -> np.ndarray:
    """Torque of a law per small deflection beside a motion ``x`` (S, T), in the mean over time; (S,) N m/rad.

    Of an element that yields, which has no slope of its own, that of its torque on the deflection.
    """
    if law.code == CUBIC:
        return 3.0 * law.a * np.mean(x**2, axis=1)
    if law.code in (BACKLASH, SOFTENING):
        slope, half = middle_of(law.code, law.a, law.b, law.k)
        spread = np.maximum(0.5 * np.abs(np.roll(x, -1, axis=1) - np.roll(x, 1, axis=1)), RESOLVED * half)
        within = np.minimum(x + 0.5 * spread, half) - np.maximum(x - 0.5 * spread, -half)
        return -slope * np.mean(np.maximum(within, 0.0) / spread, axis=1)
    if law.code == LINK:
        return np.full(len(x), law.a)
    x = x - x.mean(axis=1, keepdims=True)
    torque = along_motion(law, x, x)  # what yields sees no rate
    return np.sum(torque * x, axis=1) / np.maximum(np.sum(x**2, axis=1), 1e-300)


def along_motion(law: Law, x: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Torque (S, T) of a law along a periodic motion (S, T) and its rate, N m."""
    if law.code == LINK:
        return law.a * x + law.b * np.tanh(rate / law.k)
    if law.code == CABLE:
        return law.a * x + along_path(np.diff(x, axis=1, prepend=x[:, -1:]), law.k, law.b, SLIP, 0.0)
    if law.code in (BACKLASH, SOFTENING):
        slope, half = middle_of(law.code, law.a, law.b, law.k)
        late = law.b * rate / law.k if law.code == BACKLASH else np.zeros_like(x)
        return -slope * along_middle(half, late, x)
    return along_deflection(*law.shape, x, np.zeros(len(x)), 0)


@njit(cache=True, nogil=True)
def along_middle(half: float, late: np.ndarray, x: np.ndarray) -> np.ndarray:
    """``mean_taken`` (S, T) along a periodic motion; ``late`` (S, T) rad, its ``lag``."""
    S, T = x.shape
    out = np.empty((S, T))
    for i in range(S):
        for t in range(T):
            out[i, t] = mean_taken(half, late[i, t], x[i, t], in_a_step(x[i], t))
    return out


def along_deflection(
    code: int,
    a: float,
    b: float,
    k: float,
    exponent: float,
    recoil: float,
    x: np.ndarray,
    mean: np.ndarray,
    bisections: int,
) -> np.ndarray:
    """Torque beyond ``k x`` of a nonlinear gear along a deflection, moved to where the gear carries a mean torque; (S,
    T).

    What yields does not see where it is, only how it moves. Within a dead band that holds all of the motion many places
    carry none: bisection ends at the last of them. Of other laws false position finds the only one (Dowell and Jarratt,
    BIT 11, 1971).

    Args:
        x: (S, T) rad; mean: (S,) N m of ``k x`` and the law; bisections: at most; 0 leaves ``x`` where it is.
    """
    if code == HYSTERESIS:
        return along_path(np.diff(x, axis=1, prepend=x[:, -1:]), a, b, exponent, recoil)
    return _moved_to_mean(code, a, b, k, x, np.ascontiguousarray(mean), bisections)


@njit(cache=True, nogil=True)
def _moved_to_mean(
    code: int, a: float, b: float, k: float, x: np.ndarray, mean: np.ndarray, bisections: int
) -> np.ndarray:
    """``along_deflection`` of a gear without memory."""
    S, T = x.shape
    out = np.empty((S, T))
    least = k if code != 2 else min(a, k)
    slope, half = middle_of(code, a, b, k)
    for i in range(S):
        reach = 0.0
        for t in range(T):
            reach = max(reach, abs(x[i, t]))
        reach += abs(mean[i]) / least + (a if code == 1 else b)
        low, high, offset = -reach, reach, 0.0
        last, too_low, too_high = 0, 0.0, 0.0  # misses at both ends, zero as long as one is not known
        for _step in range(bisections + 1):
            total = 0.0
            for t in range(T):
                new = x[i, t] + offset
                if code == 0:
                    out[i, t] = spring_torque(code, a, b, k, new, new, 0.0)
                else:
                    out[i, t] = -slope * mean_taken(half, 0.0, new, in_a_step(x[i], t))
                total += k * new + out[i, t]
            miss = total / T - mean[i]
            if code != 1 and abs(miss) <= 1e-11 * k * reach:
                break
            side = 1 if miss > 0.0 else -1
            if side > 0:
                high, too_high, too_low = offset, miss, too_low * (0.5 if side == last else 1.0)
            else:
                low, too_low, too_high = offset, miss, too_high * (0.5 if side == last else 1.0)
            last = side
            if code == 1 or too_low == 0.0 or too_high == 0.0:
                offset = 0.5 * (low + high)
            else:
                offset = (low * too_high - high * too_low) / (too_high - too_low)
    return out


@njit(cache=True, nogil=True)
def link_point(stiffness: float, friction: float, turn: float, q: float, v: float, dq: float, dv: float) -> float:
    """Torque that solves ``h = stiffness (q - dq h) + friction tanh((v - dv h) / turn)``.

    By Newton's steps on the velocity that is left, in units of ``turn``: from zero, where the difference of both sides
    is steepest, they never overshoot.
    """
    slope = 1.0 + stiffness * dq
    wanted = v * slope - dv * stiffness * q  # slope turn z + dv friction tanh(z)
    size, line, jump = abs(wanted), slope * turn, dv * friction
    z, y = size / (line + jump), 1.0
    for _ in range(60):
        if z > TURNED:
            y = 1.0
            break
        y = 1.0 - 2.0 / (np.exp(2.0 * z) + 1.0)
        bend = 1.0 - y * y
        step = (size - line * z - jump * y) / (line + jump * bend)
        z += step
        if step <= 1e-5 * z + 1e-12:  # the next one would be of its square
            y += bend * step
            break
    return (stiffness * q + (friction * y if wanted >= 0 else -friction * y)) / slope


@njit(cache=True, nogil=True, fastmath=VECTORS)
def loop_sweep(
    code: int,
    a: float,
    b: float,
    k: float,
    exponent: float,
    recoil: float,
    linear: np.ndarray,
    rate: np.ndarray,
    modes: np.ndarray,
    start: np.ndarray,
    memory: np.ndarray,
    out: np.ndarray,
    returns: int,
    begin: float,
) -> tuple[np.ndarray, np.ndarray]:
    """One period of a law that moves the arm by which it is moved (see ``loop.steady_loop``).

    Args:
        code, a, b, k, exponent, recoil: as in ``Law``; of ``LINK`` its ``lead`` in steps in place of the last.
        linear, rate: (T, S) position and velocity without the law, rad, rad/s; the latter for laws that ask for it
            alone.
        modes: (4, modes) complex: poles, decay, gain_old, gain_new.
        start: (modes, S) complex state of the modes one step before the period.
        memory: (3, S) deflection, the one before and torque there; replaced by those at the end. Of ``LINK`` the second
            is the velocity.
        out: (T, S) torque, N m; that of an earlier sweep is replaced.
        returns: step from which on the period is but a return to where it began, T where it is none: what yields is led
            to the torque ``begin`` there, N m, smoothly, as a jump would swing the arm.

    Returns:
        (modes, S) state at the end, and (S,) largest change of the torque over the largest torque.
    """
    T, S = linear.shape
    rounded, damped = code == 3 and exponent < SLIP, code == 1 and b > 0.0
    middle = code == 1 or code == 2
    slope, half = middle_of(code, a, b, k)
    lag = b / k if damped else 0.0
    poles, decay, gain_old, gain_new = modes
    # A mode without the share of the torque of this step: that of the next one follows from both in one go.
    gain = decay * gain_new + gain_old
    direct = gain_new.real.sum()
    direct_rate = (poles * gain_new).real.sum()
    re, im = np.empty((len(decay), S)), np.empty((len(decay), S))
    end = np.empty((len(decay), S), np.complex128)
    x, past, h = memory
    free, free_rate = np.empty(S), np.zeros(S)
    change, largest, last = np.zeros(S), np.full(S, 1e-300), np.zeros(S)
    for m in range(len(decay)):
        for i in range(S):
            state = decay[m] * start[m, i] + gain_old[m] * h[i]
            re[m, i], im[m, i] = state.real, state.imag
    for t in range(T):
        for i in range(S):
            free[i] = linear[t, i]
        for m in range(len(decay)):
            for i in range(S):
                free[i] -= re[m, i]
        if code == 4 or damped:
            for i in range(S):
                free_rate[i] = rate[t, i]
            for m in range(len(decay)):
                p, w = poles[m].real, poles[m].imag
                for i in range(S):
                    free_rate[i] -= p * re[m, i] - w * im[m, i]
        if t >= returns:
            linear_part = a if code == 5 else 0.0
            share = (t - returns + 1.0) / (T - returns)
            share = share * share * (3.0 - 2.0 * share)
            for i in range(S):
                if t == returns:
                    last[i] = h[i] - linear_part * x[i]
                yields = last[i] + share * (begin - last[i])
                past[i] = x[i]
                x[i] = (free[i] - direct * yields) / (1.0 + direct * linear_part)
                h[i] = linear_part * x[i] + yields
        elif code == 4:
            for i in range(S):
                # Of the acceleration it is led by, the torque of this step is a part.
                ahead = free_rate[i] + recoil * (free_rate[i] - past[i])
                h[i] = link_point(a, b, k, free[i], ahead, direct, direct_rate * (1.0 + recoil))
                past[i] = free_rate[i] - direct_rate * h[i]
        elif middle:
            for i in range(S):
                new, spread = x[i], abs(x[i] - past[i])
                for _ in range(2):  # how far it goes in this step is not known before
                    h[i] = middle_torque(slope, half, lag, free[i], free_rate[i], direct, direct_rate, spread)
                    new = free[i] - direct * h[i]
                    spread = abs(new - x[i])
                    if abs(abs(new) - half) > spread + lag * abs(free_rate[i]):
                        break
                past[i] = x[i]
                x[i] = new
        else:
            for i in range(S):
                if rounded:
                    step, h[i] = yielding_point(a, b, exponent, recoil, h[i], free[i] - x[i], direct, x[i] - past[i])
                    new = x[i] + step
                else:
                    new = spring_point(code, a, b, k, free[i], direct, x[i], past[i], h[i])
                    h[i] = spring_torque(code, a, b, k, new, x[i], h[i])
                past[i] = x[i]
                x[i] = new
        for m in range(len(decay)):
            d, e, f, g = decay[m].real, decay[m].imag, gain[m].real, gain[m].imag
            for i in range(S):
                old = re[m, i]
                re[m, i] = d * old - e * im[m, i] + f * h[i]
                im[m, i] = d * im[m, i] + e * old + g * h[i]
        for i in range(S):
            change[i] = max(change[i], abs(h[i] - out[t, i]))
            largest[i] = max(largest[i], abs(h[i]))
            out[t, i] = h[i]
    for m in range(len(decay)):
        for i in range(S):
            end[m, i] = (complex(re[m, i], im[m, i]) - gain_old[m] * h[i]) / decay[m]
    return end, change / largest


def modal_compliance(M: np.ndarray, D: np.ndarray, K: np.ndarray, column: int, dt: float) -> np.ndarray:
    """Modes of ``[(s^2 M + s D + K)^{-1}]_{cc}``: poles, decay, gain_old, gain_new; (4, modes).

    Conjugate pairs are folded into one mode of twice the residue; a first-order hold over ``dt``.
    """
    N = len(M)
    M_inv = np.linalg.inv(M)
    A = np.block([[np.zeros((N, N)), np.eye(N)], [-M_inv @ K, -M_inv @ D]])
    poles, right = np.linalg.eig(A)
    B = np.zeros(2 * N)
    B[N:] = M_inv[:, column]
    residue = right[column] * np.linalg.solve(right, B)
    upper = poles.imag > 1e-9
    real = np.abs(poles.imag) <= 1e-9
    poles = np.concatenate([poles[upper], poles[real]])
    residue = np.concatenate([2 * residue[upper], residue[real]])
    order = np.lexsort((poles.real, poles.imag))  # the same of arms near by, which go on from each other
    poles, residue = poles[order], residue[order]
    z = poles * dt
    decay = np.exp(z)
    phi1 = np.expm1(z) / z
    phi2 = (phi1 - 1.0) / z
    return np.stack([poles, decay, residue * dt * (phi1 - phi2), residue * dt * phi2])
