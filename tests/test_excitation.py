"""Multisines and plans."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.excitation import crest_factor, odd_random_grid, operating_points, orthogonal_multisines
from ident.plan import make_plan
from ident.plan_file import plan_from_toml, plan_to_toml
from robot_assets.errors import DataError
from robot_assets.robot import load_robot


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 7))
def test_experiments_are_orthogonal_with_the_wanted_amplitudes(seed, n):
    rng = np.random.default_rng(seed)
    lines = np.array([3, 7, 11, 25])
    amplitudes = rng.uniform(0.5, 2.0, (4, n))
    r = orthogonal_multisines(rng, lines, amplitudes, 128, draws=5)
    R = 2 * np.fft.rfft(r, axis=1, norm="forward")[:, lines].transpose(1, 2, 0)
    product = R @ R.conj().swapaxes(1, 2) / n
    assert np.allclose(product, amplitudes[:, :, None] ** 2 * np.eye(n), atol=1e-9)
    rest = np.delete(np.fft.rfft(r, axis=1), lines, axis=1)
    assert np.abs(rest).max() < 1e-9 * np.abs(r).max() * 128


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_grid_is_odd_and_leaves_one_of_each_group_out(seed):
    lines, detection = odd_random_grid(np.random.default_rng(seed), 4000, 1000.0, (0.5, 70.0))
    assert np.all(lines % 2 == 1) and np.all(detection % 2 == 1) and not set(lines) & set(detection)
    odd = np.sort(np.concatenate([lines, detection]))
    for i in range(len(odd) // 4):
        assert np.isin(odd[4 * i : 4 * i + 4], detection).sum() == 1


def test_many_draws_lower_the_crest_factor():
    lines = np.arange(1, 200, 2)
    amplitudes = np.ones((len(lines), 6))
    few = [crest_factor(orthogonal_multisines(np.random.default_rng(s), lines, amplitudes, 1000, 6)) for s in range(8)]
    many = [
        crest_factor(orthogonal_multisines(np.random.default_rng(s), lines, amplitudes, 1000, 120)) for s in range(8)
    ]
    assert np.mean(many) < np.mean(few) - 0.2


def test_a_plan_survives_its_file_and_repeats_by_seed(tmp_path, ur10):
    plan = make_plan(ur10, points=2, seed=3, period=500)
    plan_to_toml(plan, tmp_path / "plan.toml")
    again = plan_from_toml(tmp_path / "plan.toml")
    same = make_plan(ur10, points=2, seed=3, period=500)
    for a, b, c in zip(plan.experiments, again.experiments, same.experiments, strict=True):
        assert np.allclose(a.r, b.r, atol=1e-8) and np.array_equal(a.r, c.r)
        assert a.role == b.role and a.amplitude == b.amplitude
    assert {e.amplitude for e in plan.experiments} == {1.0, 0.5, 0.25}
    assert {e.role for e in plan.experiments} == {"identification", "validation"}


def test_a_log_grid_has_the_wanted_density_everywhere():
    lines, detection = odd_random_grid(np.random.default_rng(1), 8000, 1000.0, (1.0, 70.0), per_decade=30)
    both = np.sort(np.concatenate([lines, detection])) / 8.0
    assert np.all(lines % 2 == 1) and both[0] >= 1.0 and both[-1] <= 70.0
    above = both[both > 5.0]  # below, the odd lines themselves are sparser
    assert np.diff(np.log10(above)).max() < 2.5 / 30
    assert len(above) == pytest.approx(30 * np.log10(70 / 5), abs=4)
    assert len(detection) == len(both) // 4


@pytest.mark.parametrize("name", ["ur10", "irb", "panda", "twomass"])
def test_motions_stay_within_the_limits_and_start_and_end_at_rest(name):
    robot = load_robot(name)
    for seed in range(5):
        (motion,) = make_plan(robot, points=1, seed=seed, period=500).trajectories
        q = motion.q_ref
        assert np.all(q >= robot.q_min) and np.all(q <= robot.q_max)
        assert np.all(np.abs(np.diff(q, axis=0)).max(axis=0) * 1000 < 0.55 * robot.array("velocity_limit"))
        assert np.array_equal(q[0], q[10]) and np.allclose(q[-1], q[-10])
        assert np.abs(np.diff(q, 2, axis=0)).max() * 1e6 < 40.0  # rad/s2: no steps, no kinks
        assert motion.role == "validation"


@pytest.mark.parametrize("name", ["ur10", "irb", "panda"])
def test_operating_points_are_spread_and_keep_off_the_limits(name):
    robot = load_robot(name)
    q = operating_points(robot, 8, np.random.default_rng(0))
    span = robot.q_max - robot.q_min
    assert np.all(q > robot.q_min + 0.15 * span) and np.all(q < robot.q_max - 0.15 * span)
    half = np.minimum(0.3 * span, 1.6)
    cells = np.floor((q - 0.5 * (robot.q_min + robot.q_max) + half) / (2 * half) * 8)
    assert np.array_equal(np.sort(cells, axis=0), np.tile(np.arange(8.0)[:, None], robot.n))


def test_levels_take_turns_over_points_where_the_budget_is_spread(ur10):
    plan = make_plan(ur10, points=6, levels=(1.0, 0.5, 0.25), levels_per_point=1, period=500, trajectory=False)
    used = {e.operating_point: e.amplitude for e in plan.experiments if e.role == "identification"}
    assert list(used.values()) == [1.0, 0.5, 0.25] * 2
    assert len([e for e in plan.experiments if e.role == "identification"]) == 36
    whole = make_plan(ur10, points=2, period=500, trajectory=False)
    assert len([e for e in whole.experiments if e.role == "identification"]) == 36


def test_levels_scale_one_and_the_same_signal(ur10):
    plan = make_plan(ur10, points=1, validation_points=0, levels=(1.0, 0.5), period=500, trajectory=False)
    strong, weak = ([e.r for e in plan.experiments if e.amplitude == a] for a in (1.0, 0.5))
    assert np.array_equal(0.5 * np.array(strong), np.array(weak))


def test_realizations_and_points_have_phases_of_their_own(ur10):
    plan = make_plan(ur10, points=2, realizations=3, levels=(1.0,), validation_points=0, period=500, trajectory=False)
    first = np.array([e.r for e in plan.experiments if e.experiment == 1])
    assert len(first) == 6
    phases = np.angle(np.fft.rfft(first, axis=1)[:, plan.excitation.lines]).reshape(6, -1)
    agreement = np.abs(np.exp(1j * phases) @ np.exp(-1j * phases).T) / phases.shape[1]
    assert np.abs(agreement - np.eye(6)).max() < 4 / np.sqrt(phases.shape[1])


@pytest.mark.parametrize(
    "wrong",
    [
        {"injection": "voltage"},
        {"points": 0},
        {"realizations": 0},
        {"periods": 1, "transient_periods": 1},
        {"period": 10},
        {"band_hz": (0.0, 50.0)},
        {"band_hz": (50.0, 5.0)},
        {"band_hz": (5.0, 600.0)},
        {"band_hz": (5.01, 5.02)},
        {"levels": ()},
        {"levels": (1.0, -0.5)},
        {"levels": (float("nan"),)},
    ],
)
def test_a_wrong_plan_is_one_clear_error(ur10, wrong):
    with pytest.raises(DataError):
        make_plan(ur10, **wrong)


def test_a_motion_read_from_a_file_is_as_smooth_as_the_one_written(tmp_path):
    robot = load_robot("panda")
    plan = make_plan(robot, points=1, seed=1, period=500)
    plan_to_toml(plan, tmp_path / "plan.toml")
    a, b = plan.trajectories[0].q_ref, plan_from_toml(tmp_path / "plan.toml").trajectories[0].q_ref
    assert a.shape == b.shape and np.abs(a - b).max() < 1e-7
    assert np.abs(np.diff(a - b, 2, axis=0)).max() * 1e6 < 0.01  # rad/s2


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("simgap-plan/1", "simgap-plan/2", "simgap-plan/2"),
        ('robot = "ur10"', 'robot = "panda"', "7 finite numbers"),
        ('injection = "torque"', 'injection = "love"', "love"),
        ("period = 500", "period = 50", "lines"),
        ("transient_periods = 1", "transient_periods = 3", "transient_periods"),
        ("seed = 3", 'seed = "x"', "seed"),
        ("lines = [", "lines = [3, ", "rows"),
        ("samples = ", "samples = 9", "rows"),
        ('role = "identification"', 'role = "spare"', "spare"),
        ("experiment = 1", "experiment = 0", "experiment"),
        ("[[experiment]]", "[[experiment", "TOML"),
    ],
)
def test_a_broken_plan_file_is_one_clear_error(tmp_path, ur10, old, new, found):
    plan_to_toml(make_plan(ur10, points=1, seed=3, period=500), tmp_path / "plan.toml")
    text = (tmp_path / "plan.toml").read_text()
    assert old in text
    (tmp_path / "plan.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(DataError) as caught:
        plan_from_toml(tmp_path / "plan.toml")
    assert found in str(caught.value) and "plan.toml" in str(caught.value) and "\n" not in str(caught.value)
