"""Noise of records with one steady period, by the end of the transient before it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.identification import identify, set_up
from ident.noise import LEVEL_STEPS, _mean_level, likeliest_levels, residual_covariance, white_levels
from ident.problem import predictions
from ident.transients import ends_of_transients

PERIOD, TOP, STD = 4000, 300, 2e-3


def record(seed, *, decay=0.0, steady=1, transient=1, period=PERIOD):
    """A steady motion, a transient of a time constant of ``decay`` periods beside it, and white noise; of two
    joints."""
    rng = np.random.default_rng(seed)
    t = np.arange((steady + transient) * period) / period
    motion = np.sum([np.sin(2 * np.pi * k * t + k * k) for k in range(1, 40, 2)], axis=0)
    dying = 5.0 * np.exp(-t / decay) * np.sin(2 * np.pi * 47.3 * t) if decay else 0.0
    x = (motion + dying)[:, None] + STD * rng.normal(size=(len(t), 2))
    return SimpleNamespace(
        tau=x, q=1e-3 * x, period=period, periods=steady + transient, transient_periods=transient, steady_periods=steady
    )


@pytest.mark.parametrize(("decay", "spacing"), [(0.0, 2), (0.03, 2), (0.08, 4)])
@pytest.mark.parametrize("period", [PERIOD, PERIOD + 1])
def test_a_line_of_the_end_of_a_transient_holds_the_noise_of_a_line_of_a_period(decay, spacing, period):
    members = [record(seed, decay=decay, period=period) for seed in range(12)]
    found, *spectra = ends_of_transients(members, TOP)
    assert found == spacing
    for X, std in zip(spectra, (STD, 1e-3 * STD), strict=True):
        assert X.shape == (12, TOP // spacing + 1, 2)
        power = np.mean(np.abs(X[:, 2:]) ** 2) * period / std**2
        # Of 24 spectra of at least 74 lines, of which a window leaves half: 3.3 %.
        assert power == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    "records",
    [
        [record(0, decay=0.25)],  # goes on
        [record(0, steady=2)],
        [record(0, transient=0)],
        [record(0), record(1, steady=2)],
    ],
)
def test_nothing_is_told_where_the_transient_goes_on_or_periods_repeat(records):
    assert ends_of_transients(records, TOP) is None


def test_nothing_is_told_by_few_lines():
    assert ends_of_transients([record(0)], 20) is None


@pytest.mark.parametrize("torque", [1e-2, 1.0])
@pytest.mark.parametrize("lines", [60, 400])
def test_the_likeliest_levels_are_those_of_the_noise(torque, lines):
    """Also where noise of the positions rises by ten orders, and that of the torque shows in a few lines alone."""
    rng, tau, q = np.random.default_rng(5), torque * np.array([1.0, 4.0]), np.array([2.0, 0.5])
    gain = np.geomspace(1e-3, 1e2, lines)[:, None, None] * np.array([[1.0, 0.1], [0.2, 1.0]])
    errors = []
    for _ in range(20):
        expected = tau + np.einsum("kij,j->ki", np.abs(gain) ** 2, q)
        power = expected * rng.gamma(8.0, 1.0 / 8.0, size=expected.shape)
        errors.append(np.concatenate(white_levels(power, gain, np.full(lines, 8.0))) / np.concatenate([tau, q]) - 1.0)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.1
    # Eight degrees of freedom a line, and a third of the lines or more hold each.
    assert np.std(errors, axis=0).max() < 2.0 / np.sqrt(8.0 * lines / 3.0)


def test_few_lines_are_not_told_to_hold_no_noise():
    """Of 14 lines of one record three hold more noise of the torque than of the position: likeliest may be a hundredth
    of it, or none."""
    rng = np.random.default_rng(7)
    gain = np.geomspace(0.5, 30.0, 14)[:, None, None]
    likeliest, taken = [], []
    for _ in range(300):
        power = (1.0 + gain[:, 0] ** 2) * rng.exponential(size=(14, 1))
        likeliest.append(likeliest_levels(power, gain**2, np.ones((14, 1)))[0][0])
        taken.append(white_levels(power, gain, np.ones(14))[0][0])
    assert np.quantile(likeliest, 0.05) < 0.02
    assert np.quantile(taken, 0.005) > 0.1
    assert 0.7 < np.median(taken) < 3.0  # its mean is that of a long tail


def test_the_levels_have_settled():
    rng = np.random.default_rng(2)
    gain = np.geomspace(1e-3, 1e2, 200)[:, None, None] * np.eye(2)
    power = (1.0 + np.einsum("kij->ki", gain**2)) * rng.exponential(size=(200, 2))
    level = np.concatenate(likeliest_levels(power[1:], gain[1:] ** 2, np.ones((199, 1))))

    def slope(level):
        """Of the negative log-likelihood by the logarithms of the levels, over the number of lines."""
        m = level[:2] + np.einsum("kij,j->ki", gain**2, level[2:])
        by_mean = (1.0 / m - power / m**2)[1:]
        return (
            np.concatenate(
                [
                    np.sum(by_mean * level[:2], axis=0),
                    np.sum(by_mean * np.einsum("kij->ki", gain[1:] ** 2) * level[2:], axis=0),
                ]
            )
            / 200
        )

    assert LEVEL_STEPS >= 30 and np.abs(slope(level)).max() < 1e-4


@pytest.mark.parametrize("silent", [[0], [1], [0, 1]])
def test_records_without_noise_have_none(silent):
    gain = np.geomspace(1e-3, 1e2, 100)[:, None, None] * np.eye(2)
    power = np.random.default_rng(3).exponential(size=(100, 2))
    power[:, silent] = 0.0
    tau, q = white_levels(power, gain, np.ones(100))
    assert np.all(np.isfinite([tau, q])) and np.all(tau > 0.0) and np.all(q > 0.0)
    assert np.all(tau[silent] < 1e-20) and np.all(q[silent] < 1e-20)


def test_noise_without_bounds_is_refused():
    with pytest.raises(FloatingPointError, match="without bounds"):
        white_levels(np.full((20, 2), np.inf), np.ones((20, 2, 2)), np.ones(20))


@pytest.fixture(scope="module")
def single(clean):
    """The clean experiment, one steady period of each record, without words on noise."""
    data, _ = clean

    def cut(s):
        if s.kind != "multisine":
            return s
        last = (s.transient_periods + 1) * s.period
        return replace(s, periods=s.transient_periods + 1, **s.part(slice(0, last)))

    return replace(data, segments=tuple(cut(s) for s in data.segments), q_std=None, tau_std=None)


def test_noise_of_an_arm_is_found_from_one_steady_period(identified, single):
    _, whole, _ = identified  # by the scatter between periods
    setup, baseline = identify(single)
    assert all(g.U_periods.shape[1] == 1 and g.shows_noise for g in setup.problem.groups)
    assert setup.problem.q_std == pytest.approx(whole.problem.q_std, rel=0.1)
    # Torque noise shows above that of the positions in a few slow lines; differences of samples show what circulates in
    # the loop.
    assert setup.problem.tau_std == pytest.approx(whole.problem.tau_std, rel=0.25)
    assert np.max(set_up(single).problem.tau_std / whole.problem.tau_std) > 10.0
    assert np.all(np.abs(baseline.costs / baseline.counts - 1.0) < 0.2)


def test_picked_records_keep_their_noise(single):
    group = set_up(single).problem.groups[0]
    rows = np.array([0, 2])
    assert np.array_equal(group.pick(rows).U_noise, group.U_noise[rows])


def test_noise_that_all_records_tell_weighs_each_of_them(single):
    """A group whose own lines happened to hold no noise would outweigh all others; it does not."""
    setup, baseline = identify(single)
    group = setup.problem.groups[0]
    Z = predictions(setup.problem, baseline.model, baseline.remainders)[0].sampled_impedance
    samples = setup.problem.samples(group)
    noise = {"tau_std": setup.problem.tau_std, "q_std": setup.problem.q_std, "samples": samples}
    silent = replace(group, U_noise=0.0 * group.U_noise, Q_noise=0.0 * group.Q_noise)
    told, alone = (
        residual_covariance(g, Z, **noise)[0, 0, 0].real for g in (silent, replace(silent, known_noise=None))
    )
    level = setup.problem.tau_std[0] ** 2 / samples
    assert told > 0.2 * level > 20.0 * alone


@pytest.mark.parametrize("lines", [5, 70, 2000])
@pytest.mark.parametrize("other", [0.0, 1.0, 300.0])
def test_the_mean_level_is_the_integral_over_all_levels(lines, other):
    """Where few lines leave it wide, many make it narrow, and where other noise hides it."""
    rng = np.random.default_rng(lines)
    others, dof = other * rng.uniform(0.5, 2.0, (lines, 1)), np.full((lines, 1), 2.0)
    power = (1.0 + others) * rng.gamma(2.0, 0.5, (lines, 1))
    x = power.min() * np.geomspace(1e-6, 1e6, 20000)
    likely = np.array([-np.sum(dof * (np.log(v + others) + power / (v + others))) for v in x]) + np.log(x)
    share = np.exp(likely - likely.max())
    assert _mean_level(power, others, dof) == pytest.approx(np.sum(share * x) / np.sum(share), rel=1e-4)
