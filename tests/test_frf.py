"""FRF averages on synthetic closed loops: bias, covariance, levels, distortion."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ident.dataset import Dataset, Segment
from ident.distortion import estimate_distortion
from ident.frf import Blocks, _covariance, average, estimate_frf, experiment_sets
from ident.frf_basis import frf_levels
from ident.frf_output import write_frf
from ident.units import response_unit
from robot_assets.errors import DataError


def closed_loop(rng, noise, M=12, P=2, F=60, n=2):
    """Spectra of a loop ``u = r - K y_m``, ``y_m = G u + v``: the noise circulates."""
    k = np.linspace(0.2, 2.0, F)
    G = np.empty((F, n, n), complex)
    G[:, 0, 0], G[:, 1, 1] = 1 / (1 + 1j * k), 2 / (2 + 1j * k)
    G[:, 0, 1] = G[:, 1, 0] = 0.2 / (1 + 2j * k)
    K = 0.8 * np.eye(n)
    T = np.array([[1, 1], [1, -1]]) / np.sqrt(2)
    phases = np.exp(2j * np.pi * rng.random((M, F, n, 1)))
    R = phases * T
    v = noise * (rng.normal(size=(M, P, F, n, n)) + 1j * rng.normal(size=(M, P, F, n, n))) / np.sqrt(2)
    S = np.linalg.inv(np.eye(n) + K @ G)
    U = S @ (R[:, None] - K @ v)
    Y = G @ U + v
    return G, Blocks(U, Y, R)


@pytest.mark.parametrize("estimator", ["h1", "jio", "ari", "har", "log"])
def test_all_averages_are_exact_without_noise(estimator):
    G, blocks = closed_loop(np.random.default_rng(0), 0.0)
    assert np.allclose(average(blocks, estimator), G, atol=1e-10)


def test_h1_has_the_largest_bias_under_feedback():
    rng = np.random.default_rng(1)
    bias = {}
    for estimator in ("h1", "jio", "ari", "har"):
        errors = []
        for _ in range(30):
            G, blocks = closed_loop(rng, 0.3, M=8)
            errors.append(average(blocks, estimator) - G)
        bias[estimator] = np.abs(np.mean(errors, axis=0)).mean()
    assert bias["h1"] > 2 * max(bias["jio"], bias["ari"], bias["har"])


@pytest.mark.parametrize("estimator", ["h1", "jio", "ari", "har", "log"])
@pytest.mark.parametrize(("M", "P"), [(6, 4), (1, 2), (6, 1)])
def test_the_covariance_covers_the_scatter(estimator, M, P):
    """Both covariances: 95 % regions of each entry, and chi-square of the whole matrix."""
    rng = np.random.default_rng(2)
    inside, chi2 = [], []
    for _ in range(25):
        G, blocks = closed_loop(rng, 0.02, M=M, P=P)
        estimate = average(blocks, estimator)
        error = np.swapaxes(estimate - G, -1, -2).reshape(len(G), -1)
        pair = []
        for C in _covariance(blocks, estimate, estimator):
            std = np.sqrt(np.einsum("fii->fi", C).real)
            pair.append(np.mean(np.abs(error) ** 2 < 2.996 * std**2))
        inside.append(pair)
        chi2.append(np.mean(np.einsum("fi,fij,fj->f", error.conj(), np.linalg.inv(C), error).real) / 4)
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.95) < 0.03)
    assert 0.85 < np.mean(chi2) < 1.5


def test_distortion_shows_in_the_total_but_not_in_the_noise():
    """A disturbance that repeats in every period: only realizations tell (theory.md 3.1)."""
    rng = np.random.default_rng(4)
    G, blocks = closed_loop(rng, 0.001, M=6, P=3)
    M, _P, F, n, _ = blocks.U.shape
    e = 0.05 * (rng.normal(size=(M, 1, F, n, n)) + 1j * rng.normal(size=(M, 1, F, n, n))) / np.sqrt(2)
    blocks = Blocks(blocks.U, blocks.Y + e, blocks.R)
    estimate = average(blocks, "ari")
    noise, total = (np.sqrt(np.einsum("fii->fi", C).real) for C in _covariance(blocks, estimate, "ari"))
    error = np.swapaxes(estimate - G, -1, -2).reshape(F, -1)
    assert np.sqrt(np.mean(np.abs(error / total) ** 2)) == pytest.approx(1.0, abs=0.2)
    assert np.median(total / noise) > 20


@pytest.mark.parametrize(("M", "P"), [(2, 2), (3, 2), (2, 1), (4, 3)])
def test_every_covariance_can_weight_a_fit(M, P):
    """Positive definite, with distortion that varies from line to line and is common to the outputs."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        _, blocks = closed_loop(rng, 1e-3, M=M, P=P)
        common = rng.normal(size=(M, 1, 60, 1, 2)) * np.exp(2 * rng.normal(size=(1, 1, 60, 1, 1)))
        Y = blocks.Y + 0.05 * common * np.array([[1.0], [0.98]])
        blocks = Blocks(blocks.U, Y, blocks.R)
        for C in _covariance(blocks, average(blocks, "jio"), "jio"):
            d = np.sqrt(np.einsum("fii->fi", C).real)
            assert np.linalg.eigvalsh(C / (d[:, :, None] * d[:, None, :])).min() > 0


def test_realizations_lower_the_error_by_their_root():
    rng = np.random.default_rng(3)

    def rms(M):
        return np.sqrt(
            np.mean([np.abs(average((b := closed_loop(rng, 0.05, M=M))[1], "jio") - b[0]) ** 2 for _ in range(30)])
        )

    assert rms(16) / rms(4) == pytest.approx(0.5, rel=0.15)


RATE, SHORTEST = 500.0, 500
GRID = np.arange(3, 80, 4)


def rigid(n):
    """FRF of rigid coupled inertias, (n, n): constant over frequency."""
    return np.linalg.inv(np.diag(1.0 + np.arange(n)) + 0.2)


def recorded(
    robot,
    n,
    *,
    M=1,
    P=2,
    levels=(1.0,),
    skip=(),
    reference=True,
    noise=1.0,
    disturbance=0.0,
    seed=0,
    longer=1,
    point="p",
):
    """(dataset, even-line disturbance rms (n,)): ``A q = u - d``, ``u = r - K q``, white sample noise; in periods that
    are ``longer`` by a whole number."""
    rng = np.random.default_rng(seed)
    robot = replace(robot, joints=robot.joints[:n])
    q_std, tau_std = noise * 1e-5 * np.ones(n), noise * 1e-3 * np.ones(n)
    PERIOD, LINES = longer * SHORTEST, longer * GRID
    w = 2 * np.pi * np.arange(PERIOD // 2 + 1) * RATE / PERIOD
    A = -(w**2)[:, None, None] * np.linalg.inv(rigid(n))
    closed = np.linalg.inv(A + 3e3 * np.eye(n))
    T = np.exp(2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n)
    even = np.arange(4, 80, 2) * longer
    d = np.zeros((len(w), n), complex)
    d[even] = disturbance * np.exp(2j * np.pi * rng.random((len(even), n)))
    segments = []
    for m in range(1, M + 1):
        phases = np.exp(2j * np.pi * rng.random((len(LINES), n)))
        for level in levels:
            for e in range(n):
                if (m, e + 1) in skip:
                    continue
                r = np.zeros((len(w), n), complex)
                r[LINES] = level * phases * T[:, e]
                q = np.einsum("fij,fj->fi", closed, r - d)
                u = r - 3e3 * q
                time = [np.tile(np.fft.irfft(x, PERIOD, axis=0, norm="forward"), (P, 1)) for x in (u, q, r)]
                segments.append(
                    Segment(
                        name=f"r{m}e{e + 1}a{level:g}",
                        kind="multisine",
                        role="identification",
                        t=np.arange(P * PERIOD) / RATE,
                        tau=time[0] + tau_std * rng.normal(size=time[0].shape),
                        q=time[1] + q_std * rng.normal(size=time[0].shape),
                        r=time[2] if reference else None,
                        operating_point=point,
                        period=PERIOD,
                        periods=P,
                        experiment=e + 1,
                        realization=m,
                        amplitude=level,
                        excited_lines=LINES,
                    )
                )
    joints = tuple(robot.joint_names)
    data = Dataset("loop", robot, RATE, joints, "none", q_std, tau_std, None, tuple(segments))
    return data, np.full(n, disturbance)


@pytest.mark.parametrize("n", [1, 2, 6])
@pytest.mark.parametrize(("M", "P", "reference"), [(1, 1, True), (1, 2, True), (3, 2, False), (3, 1, False)])
def test_recordings_of_any_shape_give_the_arm_and_an_honest_deviation(ur10, n, M, P, reference):
    """One period alone is judged by the noise of the samples, everything else by its scatter.

    Mean squares of error and of deviation are compared over draws: the mean of their ratio would
    be large merely because a deviation is itself estimated. Each third of the band is held to it.
    """
    errors, claimed = [], []
    for seed in range(30):
        data, _ = recorded(ur10, n, M=M, P=P, reference=reference, seed=seed)
        frf = estimate_frf(data)
        errors.append(np.abs(frf.G[0] - rigid(n)) ** 2)
        claimed.append(frf.total_std[0] ** 2)
        assert np.median(np.abs(frf.G[0] - rigid(n))) < 0.05
    assert frf.G.shape == (1, len(GRID), n, n) and frf.covariance.shape == (1, len(GRID), n * n, n * n)
    assert (frf.estimator, frf.realizations, frf.periods) == ("jio" if reference else "ari", M, P)
    assert np.allclose(frf.frequency, GRID * RATE / SHORTEST)
    ratio = np.mean(errors, axis=0) / np.mean(claimed, axis=0)
    for part in np.array_split(ratio, 3):
        assert 0.7 < np.mean(part) < 1.25


def test_the_highest_level_is_taken_and_others_on_demand(ur10):
    data, _ = recorded(ur10, 2, levels=(0.25, 1.0))
    assert frf_levels(data) == (1.0, 0.25)
    high, low = estimate_frf(data), estimate_frf(data, amplitude=0.25)
    assert high.amplitude == 1.0 and low.amplitude == 0.25
    assert np.median(low.total_std / high.total_std) == pytest.approx(4.0, rel=0.2)


def test_points_of_other_periods_and_levels_share_their_frequencies(ur10):
    """The second point has twice the period, the lines in between too, and was never measured at level 1."""
    here, _ = recorded(ur10, 2, levels=(1.0, 0.5))
    there, _ = recorded(ur10, 2, levels=(0.5,), longer=2, point="other")
    finer = np.union1d(there.segments[0].excited_lines, [9, 11])
    others = tuple(replace(s, name=f"other-{s.name}", excited_lines=finer) for s in there.segments)
    data = replace(here, segments=here.segments + others)
    frf = estimate_frf(data)
    assert frf.operating_points == ("p", "other") and np.array_equal(frf.lines, GRID)
    assert np.allclose(frf.frequency, GRID * RATE / SHORTEST)
    for q in range(2):
        assert np.sqrt(np.mean(np.abs((frf.G[q] - rigid(2)) / frf.total_std[q]) ** 2)) == pytest.approx(1.0, abs=0.3)
    levels = estimate_distortion(data, frf)
    assert levels.levels == (1.0, 0.5) and np.isnan(levels.excited[1, 0]).all()
    assert levels.excited[1, 1] == pytest.approx(levels.excited[0, 1], rel=0.2)


def test_levels_of_linear_joints_are_told_in_newtons(ur10, tmp_path, monkeypatch):
    data, _ = recorded(ur10, 2)
    monkeypatch.setattr("ident.units.linear_joints", lambda robot: np.array([False, True]))
    summary = write_frf(data, tmp_path / "frf")
    assert summary == json.loads((tmp_path / "frf" / "frf.json").read_text())
    assert summary["distortion_unit"] == dict(zip(data.joints, ("N m", "N"), strict=True))
    assert list(summary["distortion_N_m"]["odd"]) == list(data.joints)
    assert response_unit(data.robot) == "(rad/s² or m/s²)/(N m or N)"


def test_points_without_a_common_frequency_are_refused(ur10):
    data, _ = recorded(ur10, 2)
    apart = tuple(replace(s, name=f"b{s.name}", operating_point="b", excited_lines=GRID + 1) for s in data.segments)
    with pytest.raises(DataError, match=r"no frequency that all segments share.*ml"):
        estimate_frf(replace(data, segments=data.segments + apart))


@pytest.mark.parametrize("given", [None, np.zeros(2)])
@pytest.mark.parametrize("noise", [1.0, 10.0])
def test_a_single_period_is_judged_by_lines_that_nothing_excites(ur10, given, noise):
    """Whatever the robot's file says of noise, where the dataset says nothing of it or that there is none."""
    errors, claimed = [], []
    for seed in range(20):
        data, _ = recorded(ur10, 2, P=1, noise=noise, seed=seed)
        frf = estimate_frf(replace(data, q_std=given, tau_std=given))
        errors.append(np.abs(frf.G[0] - rigid(2)) ** 2)
        claimed.append(frf.total_std[0] ** 2)
    ratio = np.mean(errors, axis=0) / np.mean(claimed, axis=0)
    for part in np.array_split(ratio, 3):
        assert 0.7 < np.mean(part) < 1.3


def test_a_single_period_of_lines_that_are_all_excited_is_judged_by_differences_of_its_samples(ur10):
    quiet, loud = (recorded(ur10, 2, P=1, noise=x)[0] for x in (1.0, 10.0))

    def spread(data):
        every = tuple(replace(s, excited_lines=np.arange(GRID[0], GRID[-1] + 1)) for s in data.segments)
        kept = replace(data, segments=every, q_std=None, tau_std=None)
        return np.median(estimate_frf(kept).total_std[0, ::4])

    assert spread(loud) > 2.0 * spread(quiet)


@pytest.mark.parametrize(
    ("make", "ask", "words"),
    [
        (dict(), dict(amplitude=0.3), "amplitude: loop: found 0.3"),
        (dict(), dict(role="validation"), "none of role validation"),
        (dict(), dict(estimator="best"), "estimator"),
        (dict(reference=False), dict(estimator="jio"), "r: operating point p"),
        (dict(skip={(1, 2)}), dict(), "experiments: operating point p: found 1"),
    ],
)
def test_what_cannot_be_estimated_is_said(ur10, make, ask, words):
    with pytest.raises(DataError, match=words):
        estimate_frf(recorded(ur10, 2, **make)[0], **ask)


def test_equal_experiments_are_refused(ur10):
    data, _ = recorded(ur10, 2, noise=0.0, reference=False)
    first, second = data.segments
    twice = replace(data, segments=(first, replace(second, tau=first.tau, q=first.q)))
    with pytest.raises(DataError, match="not independent"):
        estimate_frf(twice)


def test_an_incomplete_realization_is_left_out(ur10):
    data, _ = recorded(ur10, 2, M=3, skip={(2, 1)})
    frf = estimate_frf(data)
    assert frf.realizations == 2
    alone = [s.name for s in data.segments if s.name in frf.not_used]
    assert len(alone) == len(frf.not_used) == 1 and estimate_frf(recorded(ur10, 2, M=3)[0]).not_used == ()


def test_distortion_is_freed_of_what_the_loop_passes_on(ur10):
    data, size = recorded(ur10, 2, P=3, disturbance=0.05, noise=0.01)
    levels = estimate_distortion(data, estimate_frf(data))
    assert np.allclose(levels.even[0, 0], size, rtol=0.03)
    assert np.all(levels.odd[0, 0] < 0.02 * size)
    even = np.arange(4, 80, 2)
    torque = np.fft.rfft(data.segments[0].periodic("tau").mean(axis=0), axis=0, norm="forward")[even]
    raw = np.sqrt(np.mean(np.abs(torque) ** 2, axis=0))
    assert np.all(np.abs(raw / size - 1) > 0.2)


def test_segments_that_do_not_say_which_they_are_are_all_used(clean):
    """In sets of as many as there are joints; what is repeated, and what is beyond that number, makes sets of its
    own."""
    data, _ = clean
    point = [
        s
        for s in data.select(role="identification", kind="multisine")
        if s.amplitude == 1.0 and s.operating_point == "op01"
    ]
    numbers = [sorted(x) for x in experiment_sets(point, 6)]
    assert numbers == [[1, 2, 3, 4, 5, 6]] * (len(point) // 6) and len(point) >= 6
    unnumbered = [replace(s, experiment=None, realization=None) for s in point]
    assert [list(x.values()) for x in experiment_sets(unnumbered * 2, 6)] == [unnumbered[:6]] * (2 * len(point) // 6)
    assert len(experiment_sets([*point, *point], 6)) == 2 * len(point) // 6
    assert [sorted(x) for x in experiment_sets(point[:6], 3)] == [[1, 2, 3]] * 2
    assert [sorted(x) for x in experiment_sets(point[:4], 3)] == [[1, 2, 3], [1]]


def test_multisines_without_excited_lines_are_refused_by_name(clean):
    data, _ = clean
    with pytest.raises(DataError, match=r"excited_lines: .*found none"):
        estimate_frf(replace(data, segments=tuple(replace(s, excited_lines=()) for s in data.segments)))
