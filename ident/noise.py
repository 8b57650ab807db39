"""Noise of the torque residual, from the scatter between periods.

What circulates in the closed loop obeys the plant and cancels in ``e = U - Z Q``; what is left is
measurement noise ``n_u - Z n_q`` and torque noise that enters the plant. Its covariance is the
weight that makes torque-residual matching the maximum-likelihood form of FRF matching
(Pintelon and Schoukens 2012, ch. 9; theory.md section 2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.group import Group, mean_over_lines
from ident.transients import LEAKED

PRIOR_DOF = 30.0  # weight of the white-noise model against the scatter around it
SMOOTH_DOF = 80.0  # degrees of freedom wanted of the smoothed scatter
WINDOWED = 2.0  # neighbouring lines of a spectrum through a window, that count as one
LEVEL_STEPS = 60  # towards the likeliest levels
LEAST_LEVEL, MOST_LEVEL = 1e-5, 1e5  # of the noise of the torque, over the quietest line, between which it is sought
ROUGH_LEVELS, LEVELS = 60, 120  # of it over that range, and over the part of it that is likely
UNLIKELY = 20.0  # nats below the likeliest level
ROUNDED = 1e-9  # noise of the torque over its size, at least: what rounding leaves of records without noise
LEAST_VARIANCE = 1e-140  # of a line, of records without any noise
FLAT = 1.3  # power left at excited lines, over that at the others, up to which both are noise
FEW_LINES = 100  # lines of a kind, below which they tell nothing of their power
QUIET = 0.75  # quantile of the power of the lines of a band, up to which they hold noise
DOUBT = 1.5  # of the power of noise, by which what such lines hold may be too little
SURE = 1.0  # standard deviations of that power, from the number of such lines
HALVINGS, LEAST_POWER = 24, 1e-9  # of the interval of that power, and the least that a line is assumed to hold
BAND_LINES = 20  # of a band in which a quantile, or the coherence of neighbouring lines, is taken
# coherence of neighbouring lines from which noise is a drift; and standard deviations of it by chance
TOGETHER, NO_CHANCE = 0.8, 5.0


def white_covariance(Z: np.ndarray, tau_var: np.ndarray | float, q_var: np.ndarray) -> np.ndarray:
    """``diag(tau_var) + Z diag(q_var) Z^H``; (L, n, n).

    Args:
        Z: (L, n, n) recorded torque per motor position.
        tau_var, q_var: (n,) variance of a spectral line of each channel; the latter (L, 1, n) where it is not white.
    """
    out = (Z * q_var) @ np.conj(np.swapaxes(Z, 1, 2))
    k = np.arange(Z.shape[1])
    out[:, k, k] += tau_var
    return out


def residual_covariance(
    group: Group,
    Z: np.ndarray,
    *,
    tau_std: np.ndarray,
    q_std: np.ndarray,
    samples: int,
) -> np.ndarray:
    """Covariance of the compared lines of the mean torque residual; (K, n, n).

    Args:
        group: the records.
        Z: (L, n, n) recorded torque per motor position.
        tau_std, q_std: (n,) sample noise, used where nothing shows it (``noise_alone``).
        samples: samples per period.

    The shape over frequency is that of white channel noise carried by ``Z``; what shows the noise alone
    (``noise_alone``) sets its size, and corrects its shape by a smooth matrix where there is enough of it.
    """
    found = noise_alone(group, Z)
    rounded = ROUNDED**2 * np.mean(np.sum(2.0 * np.abs(group.U[:, 1:]) ** 2, axis=1), axis=0) / samples
    if found is None:
        S = white_covariance(Z, tau_std**2 / samples + rounded, q_std**2 / samples)
        return S[: group.n_compared]
    d, lines, dof_line = found
    Zk = Z[: group.n_compared]
    tau_var, q_var = group.known_noise or white_levels(
        np.sum(np.abs(d[:, 1:]) ** 2, axis=0), Zk[lines[1:]], np.full(len(lines) - 1, dof_line)
    )
    S = white_covariance(Zk, tau_var + rounded, q_var)
    root = np.linalg.cholesky(S)
    white = np.linalg.solve(root[lines][None], d[..., None])[..., 0]
    scatter = np.einsum("ski,skj->kij", white, white.conj(), optimize=True)
    half = int(np.ceil(0.5 * SMOOTH_DOF / dof_line))
    smooth, count = _moving_mean(scatter, half)
    dof = (count * dof_line)[:, None, None]
    shape = (dof * smooth + PRIOR_DOF * np.eye(Z.shape[1])) / (dof + PRIOR_DOF)
    nearest = np.searchsorted(0.5 * (lines[1:] + lines[:-1]), np.arange(len(Zk)))
    shape = shape[nearest]
    return root @ shape @ np.conj(np.swapaxes(root, 1, 2))


def noise_alone(group: Group, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray, float] | None:
    """What noise alone makes of the torque residual: (R, J, n) of which the sum of squares is the variance of the mean.

    With the lines (J,) of the period that it stands at, and its degrees of freedom per line. By what periods differ by,
    or the end of a transient one and a single steady one; None where there is neither.
    """
    P = group.U_periods.shape[1]
    if P > 1:
        e = group.U_periods - np.einsum("lij,splj->spli", Z, group.Q_periods, optimize=True)
        d = (e - e.mean(axis=1, keepdims=True))[:, :, : group.n_compared]
        scale = len(e) * (P - 1) * P
        return d.reshape(-1, *d.shape[2:]) / np.sqrt(scale), np.arange(group.n_compared), float(len(e) * (P - 1))
    if group.U_noise is None or group.Q_noise is None:
        return None
    lines = group.noise_spacing * np.arange(LEAKED, group.U_noise.shape[1])
    d = group.U_noise[:, LEAKED:] - np.einsum("lij,slj->sli", Z[lines], group.Q_noise[:, LEAKED:], optimize=True)
    return d / np.sqrt(len(d)), lines, len(d) / WINDOWED


def sample_noise(
    groups: Sequence[Group], impedances: Sequence[np.ndarray], samples: Sequence[int]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Standard deviation of white noise on torque and position samples, (n,) each.

    From what shows the noise of the torque residual alone (``noise_alone``), in all groups together; None where nothing
    does.

    Args:
        impedances: (L, n, n) recorded torque per motor position, by group.
        samples: per period, by group.
    """
    power, gains, dof = [], [], []
    for group, Z, count in zip(groups, impedances, samples, strict=True):
        found = noise_alone(group, Z)
        if found is None:
            continue
        d, lines, dof_line = found
        power.append(count * group.U_periods.shape[1] * np.sum(np.abs(d[:, 1:]) ** 2, axis=0))
        gains.append(Z[lines[1:]])
        dof.append(np.full(len(lines) - 1, dof_line))
    if not power:
        return None
    tau_var, q_var = white_levels(*map(np.concatenate, (power, gains, dof)))
    return np.sqrt(tau_var), np.sqrt(q_var)


def white_levels(power: np.ndarray, Z: np.ndarray, dof: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Channel variances, (n,) each, of the line power (K, n) of the residual.

    Few lines may be likeliest without any noise of the torque: beside the likeliest noise of the positions its mean
    over all levels that are likely is taken.

    Args:
        dof: (K,) degrees of freedom of the lines.

    Raises:
        FloatingPointError: power or gain without bounds.
    """
    if not (np.all(np.isfinite(power)) and np.all(np.isfinite(Z))):
        raise FloatingPointError("noise without bounds")
    floor = 1e-12 * np.maximum(power.mean(axis=0), 1e-300)
    power, gain, weight = np.maximum(power, LEAST_VARIANCE), np.abs(Z) ** 2, dof[:, None]
    q_var = likeliest_levels(power, gain, weight)[1]
    return _mean_level(power, gain @ q_var, weight) + floor, q_var + 1e-12 * floor


def likeliest_levels(power: np.ndarray, gain: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variances of torque and position, (n,) each, that are likeliest of the line power (K, n) of ``torque + gain @
    position``.

    Powers of lines of noise are gamma distributed about their mean ``m``: ``sum(weight (log m + power / m))`` is least
    (Whittle 1953), by multiplicative steps, under which variances stay positive (Fevotte, Bertin and Durrieu, Neural
    Comput. 21, 2009, eq. 4.7).

    Args:
        gain: (K, n, n); weight: (K, 1) degrees of freedom.
    """
    n, k = power.shape[1], np.arange(power.shape[1])
    columns = np.zeros((len(power), n, 2 * n))
    columns[:, k, k] = 1.0
    columns[:, :, n:] = gain
    A, b, w = columns.reshape(-1, 2 * n), power.ravel(), np.broadcast_to(weight, power.shape).ravel()
    own = np.maximum(np.diagonal(gain, axis1=1, axis2=2), 1e-300)
    level = np.maximum(np.concatenate([np.median(power, axis=0), np.median(power / own, axis=0)]), LEAST_VARIANCE)
    for _ in range(LEVEL_STEPS):
        inverse = 1.0 / np.maximum(A @ level, LEAST_VARIANCE)
        level = level * (A.T @ (w * b * inverse**2)) / np.maximum(A.T @ (w * inverse), 1e-300)
    return level[:n], level[n:]


def _mean_level(power: np.ndarray, others: np.ndarray, dof: np.ndarray) -> np.ndarray:
    """Mean (n,) over all levels of the torque noise, each as likely as it makes the power (K, n) of lines that hold
    other noise too.

    Integrals by the trapezoidal rule over the logarithm of the level, where it is not unlikely: many lines make that
    narrow.
    """
    least = np.log(np.maximum(np.min(power, axis=0), LEAST_VARIANCE))

    def log_density(x: np.ndarray) -> np.ndarray:
        mean = np.exp(x)[:, None] + others
        return -np.sum(dof * (np.log(mean) + power / mean), axis=1) + x

    rough = np.linspace(np.log(LEAST_LEVEL), np.log(MOST_LEVEL), ROUGH_LEVELS)
    seen = log_density(least + rough[:, None])
    near = seen > seen.max(axis=0) - UNLIKELY
    low, high = rough[np.argmax(near, axis=0)], rough[-1 - np.argmax(near[::-1], axis=0)]
    x = least + np.linspace(low - (rough[1] - rough[0]), high + (rough[1] - rough[0]), LEVELS)
    likely = log_density(x)
    share = np.exp(likely - likely.max(axis=0))
    return np.sum(share * np.exp(x), axis=0) / np.sum(share, axis=0)


def _moving_mean(x: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean over lines k-half..k+half, and how many lines entered."""
    k = np.arange(len(x))
    return mean_over_lines(x, half), np.minimum(k + half + 1, len(x)) - np.maximum(k - half, 0)


def unexcited_noise(groups: Sequence[Group], whitened: Sequence[np.ndarray]) -> float:
    """Power of what a model leaves at the lines that nothing excites, over that of the noise it was whitened with; 1
    where it is less.

    Noise that is neither given nor seen to scatter between periods is guessed from differences of samples, as white:
    where it is coloured more is left, at excited lines and at the others alike. What a model lacks shows at those
    excited first: where these hold ``FLAT`` times as much as the others nothing is said about noise, and 1 returned.

    Args:
        whitened: (S, K, n) residual by group, real and imaginary parts of unit variance.
    """
    power, count = np.zeros(2), np.zeros(2)
    for group, Z in zip(groups, whitened, strict=True):
        excited = group.excited[:, 1 : Z.shape[1]]
        squares = np.sum(np.abs(Z[:, 1:]) ** 2, axis=2)
        for i, lines in enumerate((excited, ~excited)):
            power[i] += np.sum(squares[lines])
            count[i] += 2 * Z.shape[2] * np.sum(lines)
    if np.any(count == 0):
        return 1.0
    at_excited, at_others = power / count
    return float(max(at_others, 1.0)) if at_excited < FLAT * at_others else 1.0


def alike_at_all_lines(groups: Sequence[Group], whitened: Sequence[np.ndarray]) -> np.ndarray | None:
    """Power (n,) of what a model leaves, over that of the noise it was whitened with, where that is noise; None else.

    It is where most joints are left more than noise as given, and as much at excited lines as at other odd ones and at
    even ones near by. What a linear model lacks shows at excited lines alone, a distortion at odd ones more than at
    even ones or the other way round, and both at a joint of their own (Pintelon and Schoukens 2012, 4.3): such a joint
    has the noise of the others, or what it is left at the lines where that is least.

    Args:
        whitened: as of ``unexcited_noise``.
    """
    n = whitened[0].shape[2]
    ratio, count = np.zeros((3, n)), np.zeros((3, 1))
    total = np.zeros((3, n))
    for group, Z in zip(groups, whitened, strict=True):
        power = np.abs(Z[:, 1:]) ** 2
        near = mean_over_lines(power.mean(axis=0), BAND_LINES)
        excited, odd = group.excited[:, 1 : Z.shape[1]], np.arange(1, Z.shape[1]) % 2 == 1
        for i, kind in enumerate((excited, ~excited & odd, ~excited & ~odd)):
            ratio[i] += np.sum((power / np.maximum(near, 1e-300))[kind], axis=0)
            count[i] += np.sum(kind)
            total[i] += 0.5 * np.sum(power[kind], axis=0)
    told = count[:, 0] >= FEW_LINES
    if n < 2 or not told[0] or not np.any(told[1:]):
        return None
    mean, left = ratio[told] / count[told], total.sum(axis=0) / count.sum()
    alike = mean.max(axis=0) < FLAT * mean.min(axis=0)
    if np.sum(alike & (left > FLAT)) <= n / 2:
        return None
    least = np.min(total[told] / count[told], axis=0)
    return np.where(alike, left, np.minimum(least, np.median(left[alike])))


def torque_noise_left(left: Sequence[np.ndarray], shares: Sequence[np.ndarray]) -> np.ndarray:
    """Power of white noise of the torque samples that a model leaves room for, over that which was assumed; (n,), at
    most 1.

    What a model leaves is never less than noise. In each band of lines that power is sought at which a quantile is that
    of noise, which what is missing in few of them moves little. Bands count by how far they narrow it down, so that the
    quietest count most; ``SURE`` of its standard deviations are added, as where the noise of the positions hides it.
    Fewer lines than half a band tell nothing.

    Args:
        left: (S, K, n) residual by group, each joint of unit mean power for noise as assumed.
        shares: (K, n) of the torque in that noise; the rest is that of the positions.
    """
    found, told = np.zeros(shares[0].shape[1]), np.zeros(shares[0].shape[1])
    for Z, share in zip(left, shares, strict=True):
        for first in range(1, Z.shape[1] - BAND_LINES // 2, BAND_LINES):
            band = slice(first, first + BAND_LINES)
            power, torque = np.abs(Z[:, band]) ** 2, share[band]
            quiet = power_of_noise(power, torque)
            slope = np.mean(torque / (torque * quiet + 1.0 - torque), axis=0)
            # Lines of noise have exponential powers, and a quantile of N of them varies by this (Kendall and Stuart
            # 1977, 14.2).
            relative = np.sqrt(QUIET / (1.0 - QUIET) / power[..., 0].size) / -np.log(1.0 - QUIET)
            weight = (slope / relative) ** 2
            found, told = found + weight * quiet, told + weight
    told = np.maximum(told, 1e-300)
    return np.minimum(found / told + SURE / np.sqrt(told), 1.0)


def power_of_noise(power: np.ndarray, share: np.ndarray) -> np.ndarray:
    """The part of the assumed power of one of two noises at which the ``QUIET`` quantile of lines is that of noise;
    (n,), 0 to 1.

    Args:
        power: (S, L, n) of the lines, over that of both noises as assumed.
        share: (L, n) of the former in it.
    """
    low, high = np.zeros(share.shape[1]), np.ones(share.shape[1])
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        ratio = power / np.maximum(share * middle + 1.0 - share, LEAST_POWER)
        louder = np.quantile(ratio, QUIET, axis=(0, 1)) > -np.log(1.0 - QUIET)
        low, high = np.where(louder, middle, low), np.where(louder, high, middle)
    return high


def power_at_fast_lines(left: Sequence[np.ndarray], shares: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Power of noise in the upper half of the lines, and that of the torque in it, over those assumed; (n,) each.

    As in ``torque_noise_left`` a quantile tells it, but it may be more than was assumed.

    Args:
        left, shares: as there.
    """
    n = shares[0].shape[1]
    fast, share = (
        np.concatenate([X[..., X.shape[-2] // 2 :, :].reshape(-1, n) for X in part]) for part in (left, shares)
    )
    power = np.quantile(np.abs(fast) ** 2, QUIET, axis=0) / -np.log(1.0 - QUIET)
    share = share.mean(axis=0)
    return power, (power - (1.0 - share)) / share


def line_coherence(periods: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Coherence of what differs between periods from each line to the next.

    Noise that is stationary over many periods has independent lines (Pintelon and Schoukens 2012, ch. 2): the coherence
    is about the inverse root of the number of pairs then. What ends a period elsewhere than it began it, as a drift
    does, steps there: its lines go together, as far up as they are above the other noise. A random walk has about a
    third, and so has what is left of a transient.

    Args:
        periods: spectra (S, P, L, n) of single periods by group, the mean left out.

    Returns:
        (bands, n) coherence, 0 to 1, over bands of ``BAND_LINES``, and (bands,) the number of pairs of lines in each.
    """
    bands = max(X.shape[2] for X in periods) // BAND_LINES + 1
    n = periods[0].shape[-1]
    joint, power, count = np.zeros((bands, n), complex), np.zeros((bands, n)), np.zeros(bands)
    for X in periods:
        d = X - X.mean(axis=1, keepdims=True)
        d = d / np.sqrt(np.maximum(np.mean(np.abs(d) ** 2, axis=(0, 1)), 1e-300))
        of = np.arange(d.shape[2] - 1) // BAND_LINES
        np.add.at(joint, of, np.sum(d[:, :, 1:] * d[:, :, :-1].conj(), axis=(0, 1)))
        np.add.at(power, of, np.sum(np.abs(d[:, :, 1:]) ** 2, axis=(0, 1)))
        np.add.at(count, of, len(d) * (d.shape[1] - 1))
    return np.abs(joint) / np.maximum(power, 1e-300), count


def drifting(groups: Sequence[Group]) -> np.ndarray:
    """Joints (n,) at which nearly all that differs between periods, of the torque or of the position in some band, is a
    drift.

    Of a drive that hunts between the steps of its encoder, in pulses that go together in all lines, nothing is told.
    """
    measured = [g for g in groups if g.window is None and g.U_periods.shape[1] > 1]
    out = np.zeros(groups[0].U.shape[-1], bool)
    if not measured:
        return out
    for channel in ("U_periods", "Q_periods"):
        together, count = line_coherence([getattr(g, channel)[:, :, 1 : g.n_compared] for g in measured])
        out |= np.any((together > TOGETHER) & (together * np.sqrt(count)[:, None] > NO_CHANCE), axis=0)
    for g in measured:
        out &= True if g.rounding is None else ~np.any(g.rounding, axis=0)
    return out
