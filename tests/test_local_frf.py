"""Local methods on a simulated elastic arm in closed loop, started at rest: bias, covariance, transient."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from ident.dataset import Dataset, Segment
from ident.frf import estimate_frf
from ident.local_frf import estimate_local
from ident.plan import make_plan
from robot_assets.errors import DataError

RATE = 250.0


def plant(n, damping):
    """(A, B, C) sampled at ``RATE``: n motors on springs, their links coupled; anti-resonances 8 to 16 Hz."""
    J = np.diag(1.0 + 0.3 * np.arange(n))
    links = np.diag(0.6 + 0.2 * np.arange(n)) + 0.12
    k = np.diag(links) * (2 * np.pi * np.linspace(8, 16, n)) ** 2
    M = scipy.linalg.block_diag(J, links)
    S = np.block([[np.diag(k), -np.diag(k)], [-np.diag(k), np.diag(k)]])
    Mi = np.linalg.inv(M)
    D = damping * S / (2 * np.pi * 12) * 2
    D[:n, :n] += 0.5 * np.eye(n)
    A = np.block([[np.zeros((2 * n, 2 * n)), np.eye(2 * n)], [-Mi @ S, -Mi @ D]])
    B = np.vstack([np.zeros((2 * n, n)), Mi[:, :n]])
    E = scipy.linalg.expm(np.block([[A, B], [np.zeros((n, 5 * n))]]) / RATE)
    return E[: 4 * n, : 4 * n], E[: 4 * n, 4 * n :], np.eye(n, 4 * n)


def frf_of(n, damping, frequency):
    """(F, n, n) from torque to ``(j w)^2 q``."""
    A, B, C = plant(n, damping)
    w = 2 * np.pi * frequency
    z = np.exp(1j * w / RATE)[:, None, None]
    return -(w**2)[:, None, None] * (
        C @ np.linalg.solve(z * np.eye(len(A)) - A, np.broadcast_to(B, (len(w), *B.shape)))
    )


def recorded(
    robot,
    n,
    *,
    period=4096,
    periods=1,
    transient=0,
    experiments=1,
    noise=0.0,
    damping=0.02,
    band=(1.0, 30.0),
    seed=0,
    warm=False,
):
    """Multisines that excite all inputs at all lines of a band, from rest; noise relative to the motion."""
    rng = np.random.default_rng(seed)
    A, B, C = plant(n, damping)
    lines = np.arange(int(np.ceil(band[0] * period / RATE)), int(band[1] * period / RATE) + 1)
    w = (2 * np.pi * 2.0) ** 2 * 2.0
    segments = []
    robot = replace(robot, joints=robot.joints[:n])
    for e in range(experiments):
        X = np.zeros((period // 2 + 1, n), complex)
        X[lines] = np.exp(2j * np.pi * rng.random((len(lines), n)))
        r = np.fft.irfft(X, n=period, axis=0)
        r *= 40.0 / r.std()
        N, wait = periods * period, 6 * period if warm else 0
        q, u = np.empty((N, n)), np.empty((N, n))
        x, last = np.zeros(4 * n), np.zeros(n)
        disturbed = rng.normal(size=(N + wait, 3, n)) * noise
        for t in range(-wait, N):
            y = C @ x + 2e-3 * disturbed[t, 0]
            torque = r[t % period] - w * y - 0.12 * w * (y - last) * RATE
            last = y
            if t >= 0:
                q[t], u[t] = y, torque + 5.0 * disturbed[t, 1]
            x = A @ x + B @ (torque + 5.0 * disturbed[t, 2])
        segments.append(
            Segment(
                f"e{e + 1}",
                "multisine",
                "identification",
                np.arange(N) / RATE,
                u,
                q,
                r=np.tile(r, (periods, 1)),
                operating_point="p",
                q0=np.zeros(n),
                period=period,
                periods=periods,
                transient_periods=transient,
                experiment=e + 1,
                realization=1,
                excited_lines=lines,
            )
        )
    joints = tuple(robot.joint_names)
    std = noise * np.array([2e-3, 5.0])[:, None] * np.ones(n)
    return Dataset("arm", robot, RATE, joints, "zoh", std[0], std[1], None, tuple(segments))


def relative_error(frf, n, damping=0.02):
    """(F,) largest error of an entry over the largest entry of its line."""
    G = frf_of(n, damping, frf.frequency)
    return np.abs(frf.G[0] - G).max(axis=(1, 2)) / np.abs(G).max(axis=(1, 2))


@pytest.mark.parametrize(("n", "lpm", "lrm"), [(1, 4e-3, 3e-4), (2, 2e-2, 2e-3), (6, 0.2, 2e-2)])
@pytest.mark.parametrize("periods", [1, 2])
def test_one_experiment_gives_the_whole_matrix(ur10, n, lpm, lrm, periods):
    """From rest, 16 s a period, no noise: what is left is the bias of the local model."""
    data = recorded(ur10, n, periods=periods)
    for method, bound in (("lpm", lpm), ("lrm", lrm)):
        frf = estimate_local(data, method=method)
        assert frf.G.shape == (1, len(frf.frequency), n, n)
        assert relative_error(frf, n).max() < bound


def test_the_rational_model_follows_resonances_that_the_polynomial_cannot(ur10):
    data = recorded(ur10, 6)
    rational, polynomial = (relative_error(estimate_local(data, method=m), 6) for m in ("lrm", "lpm"))
    assert np.median(rational) < 0.25 * np.median(polynomial) and rational.max() < 0.25 * polynomial.max()


def test_longer_records_lower_the_bias(ur10):
    short, long = (np.median(relative_error(estimate_local(recorded(ur10, 3, period=p)), 3)) for p in (2048, 8192))
    assert long < 0.1 * short


def test_the_transient_is_removed(ur10):
    """As good from rest as in the steady state, where dividing the spectra is spoilt by the transient."""
    cold, warm = recorded(ur10, 2, experiments=2), recorded(ur10, 2, experiments=2, warm=True)
    local = [np.median(relative_error(estimate_local(d), 2)) for d in (cold, warm)]
    plain = [np.median(relative_error(estimate_frf(d, estimator="jio"), 2)) for d in (cold, warm)]
    assert plain[1] < 1e-9 and plain[0] > 3e-3
    assert local[0] < 3 * local[1] + 1e-6 and local[0] < 1e-2 * plain[0]


@pytest.mark.parametrize("method", ["lpm", "lrm"])
@pytest.mark.parametrize(("n", "periods", "experiments"), [(1, 1, 1), (2, 1, 1), (2, 3, 1), (3, 1, 2), (6, 1, 1)])
def test_the_deviation_is_honest(ur10, method, n, periods, experiments):
    """Mean square of error over that claimed, at lines well off the resonances and over the whole band."""
    errors, claimed = [], []
    for seed in range(8):
        data = recorded(ur10, n, periods=periods, experiments=experiments, noise=0.05, damping=0.1, seed=seed)
        frf = estimate_local(data, method=method)
        errors.append(np.abs(frf.G[0] - frf_of(n, 0.1, frf.frequency)) ** 2)
        claimed.append(frf.total_std[0] ** 2)
    ratio = np.mean(errors, axis=0) / np.mean(claimed, axis=0)
    assert 0.6 < np.mean(ratio) < 1.7
    assert 0.5 < np.median(ratio) < 1.5


def test_the_covariance_is_that_of_the_matrix(ur10):
    """Chi-square of the whole matrix, four complex numbers a line."""
    values = []
    for seed in range(12):
        frf = estimate_local(recorded(ur10, 2, noise=0.05, damping=0.1, seed=seed))
        e = np.swapaxes(frf.G[0] - frf_of(2, 0.1, frf.frequency), -1, -2).reshape(-1, 4)
        values.append(np.einsum("fi,fij,fj->f", e.conj(), np.linalg.inv(frf.covariance[0]), e).real)
    assert 0.6 < np.mean(values) / 4 < 1.7


def test_noise_alone_is_told_from_what_repeats(ur10):
    """Three periods: a disturbance that repeats in each stands on the excited lines alone."""
    data = recorded(ur10, 2, periods=3, noise=0.02, damping=0.1)
    period = 4096
    rng = np.random.default_rng(9)
    X = np.zeros((period // 2 + 1, 2), complex)
    lines = data.segments[0].excited_lines
    X[lines] = np.exp(2j * np.pi * rng.random((len(lines), 2)))
    extra = np.tile(np.fft.irfft(X, n=period, axis=0), (3, 1))
    extra *= 0.5 / extra.std()
    disturbed = replace(data, segments=(replace(data.segments[0], tau=data.segments[0].tau + extra),))
    before, after = estimate_local(data), estimate_local(disturbed)
    assert np.median(before.total_std / before.noise_std) == pytest.approx(1.0, abs=0.25)
    assert np.median(after.total_std / after.noise_std) > 3
    assert np.median(after.noise_std / before.noise_std) == pytest.approx(1.0, abs=0.1)


def test_feedback_does_not_bias(ur10):
    """Error averaged over draws falls as their root: 40 draws leave a sixth of one draw's error."""
    frfs = [estimate_local(recorded(ur10, 2, noise=0.3, damping=0.1, seed=s)) for s in range(40)]
    G = frf_of(2, 0.1, frfs[0].frequency)
    errors = np.stack([f.G[0] - G for f in frfs])
    rms = np.sqrt(np.mean(np.abs(errors) ** 2))
    assert np.sqrt(np.mean(np.abs(errors.mean(axis=0)) ** 2)) < 0.3 * rms


def test_a_zippered_grid_does_as_well(ur10):
    """Each input at its own lines: as many values, inputs told apart without overlap."""
    data = recorded(ur10, 2, period=8192)
    full = estimate_local(data)
    s = data.segments[0]
    R = np.fft.rfft(s.r, axis=0)
    for j in range(2):
        R[s.excited_lines[(np.arange(len(s.excited_lines)) + j) % 2 == 0], j] = 0
    w = (2 * np.pi * 2.0) ** 2 * 2.0
    A, B, C = plant(2, 0.02)
    r = np.fft.irfft(R, n=8192, axis=0)
    q, u, x, last = np.empty_like(r), np.empty_like(r), np.zeros(8), np.zeros(2)
    for t in range(8192):
        q[t] = C @ x
        u[t] = r[t] - w * q[t] - 0.12 * w * (q[t] - last) * RATE
        last = q[t]
        x = A @ x + B @ u[t]
    masked = estimate_local(replace(data, segments=(replace(s, r=r, q=q, tau=u),)))
    assert relative_error(masked, 2).max() < 5 * relative_error(full, 2).max()


def test_estimate_frf_offers_both(ur10):
    data = recorded(ur10, 2)
    for method in ("lpm", "lrm"):
        frf = estimate_frf(data, estimator=method)
        assert frf.estimator == method and frf.realizations == 1 and frf.amplitude == 1.0
        assert np.array_equal(frf.G, estimate_local(data, method=method).G)


def test_what_cannot_be_estimated_is_said(ur10):
    data = recorded(ur10, 2)
    s = data.segments[0]
    equal = s.r[:, [0, 0]]
    with pytest.raises(DataError, match="method"):
        estimate_local(data, method="lpv")
    with pytest.raises(DataError, match="no reference"):
        estimate_local(replace(data, segments=(replace(s, r=None),)))
    with pytest.raises(DataError, match="excited lines: arm: found 9"):
        estimate_local(replace(data, segments=(replace(s, excited_lines=s.excited_lines[:9]),)))
    with pytest.raises(DataError, match="not excited independently"):
        estimate_local(replace(data, segments=(replace(s, r=equal),)))
    with pytest.raises(DataError, match="without excitation"):
        estimate_local(replace(data, segments=(replace(s, r=s.r * [1.0, 0.0]),)))
    with pytest.raises(DataError, match=r"amplitude: arm: found 0\.5"):
        estimate_local(data, amplitude=0.5)


def test_plans_of_one_experiment(ur10):
    options = dict(points=1, validation_points=0, levels=(1.0,), trajectory=False, period=2000, band_hz=(1.0, 20.0))
    plan = make_plan(ur10, grid="all", experiments=1, **options)
    assert len(plan.experiments) == 1 and np.all(np.diff(plan.excitation.lines) == 1)
    spectrum = np.abs(np.fft.rfft(plan.experiments[0].r, axis=0))[plan.excitation.lines]
    assert np.all(spectrum > 1e-3 * spectrum.max(axis=0))
    odd = make_plan(ur10, grid="odd", **options).excitation
    assert np.all(np.diff(odd.lines) == 2) and not len(odd.detection)
    for wrong in (dict(grid="even"), dict(experiments=0), dict(experiments=7)):
        with pytest.raises(DataError, match=next(iter(wrong))):
            make_plan(ur10, **wrong)
