"""Steps in position found in the samples, and nowhere else."""

import numpy as np
import pytest

from ident.dataset_io import load_dataset, save_dataset
from ident.excitation import operating_points
from ident.hypotheses.sensing import encoder_eccentricity, sensor_lag
from ident.identification import identify
from ident.model import Effect
from ident.noise import drifting
from ident.quantization import Steps, _blurred_grid, _exact_grid, rounding_error, with_rounding
from ident.trust import within_steps
from robot_assets.robot import load_robot
from sim import run_experiment
from sim.effects import EFFECTS
from sim.experiment import plan_experiment


def motion(rng, N=4000):
    t = np.arange(N) / 1000
    return 0.8 + sum(
        a * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for a, f in ((0.01, 2.25), (4e-3, 5.5), (1e-3, 11.0))
    )


@pytest.mark.parametrize("step", [2e-5, 6.1e-5, 2 * np.pi / 2**16])
@pytest.mark.parametrize("seed", range(3))
def test_a_rounded_position_shows_its_step(step, seed):
    rng = np.random.default_rng(seed)
    q = motion(rng)
    found = _exact_grid(np.round((q + 3e-6 * rng.normal(size=len(q))) / step) * step)
    assert found[0] == pytest.approx(step, rel=1e-3)
    blurred = _blurred_grid(np.round(q / step) * step + 2e-6 * rng.normal(size=len(q)), 2e-6)
    assert blurred[0] == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize(
    ("levels", "jitter", "found"), [(5, 0.0, True), (3, 0.0, True), (2, 0.0, False), (5, 0.01, False)]
)
def test_a_joint_that_moves_by_few_steps_shows_them_where_they_are_exact(levels, jitter, found):
    """Of positions that differ by other than whole steps so few tell none."""
    step, q = 1.1e-3, motion(np.random.default_rng(0))
    cells = np.round((levels - 1) * (q - q.min()) / np.ptp(q))
    offsets = jitter * np.sin(np.arange(levels))
    step_found = _exact_grid(step * (cells + offsets[cells.astype(int)]))
    assert (step_found is not None) is found
    assert step_found is None or step_found[0] == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_a_smooth_position_with_noise_has_no_steps(seed):
    rng = np.random.default_rng(seed)
    q = motion(rng) + 3e-6 * rng.normal(size=4000)
    assert _exact_grid(q) is None and _blurred_grid(q, 3e-6) is None


def lines_of_rounding(cells, middle, slope):
    """Power of the error of odd multisines of so many steps about one place in a step, over that of white errors: what
    it is, and as
    it is foretold from the rounded record; (2, top)."""
    rng = np.random.default_rng(3)
    N, top, step, draws = 4000, 280, 1e-4, 40
    odd = np.arange(3, top, 2)
    at = 0.7
    actual, foretold = np.zeros(top), np.zeros(top)
    for _ in range(draws):
        X = np.zeros((1, 2 * top), complex)
        X[0, odd] = np.exp(2j * np.pi * rng.random(len(odd))) / odd**slope
        X *= cells * step / np.ptp(np.fft.irfft(X * N, N))
        X[0, 0] = at + middle * step
        q = np.fft.irfft(X * N, N, axis=1) + 0.05 * step * rng.normal(size=(1, N))
        lines = np.fft.rfft(np.round((q - at) / step) * step + at, norm="forward")
        actual += np.abs(lines[0, :top] - X[0, :top]) ** 2
        foretold += rounding_error(lines[:, : 2 * top], step, at, N, top)
    return np.stack([actual, foretold]) / (draws * step**2 / 12 / N)


@pytest.mark.parametrize(
    ("cells", "middle", "slope"), [(9.0, 0.0, 0.5), (20.0, 0.25, 1.0), (60.0, 0.13, 1.0), (60.0, 0.13, 0.5)]
)
def test_what_steps_leave_in_lines_is_foretold_from_the_rounded_motion(cells, middle, slope):
    both = lines_of_rounding(cells, middle, slope)
    for band in (slice(5, 60), slice(60, 280)):
        actual, foretold = both[:, band].mean(axis=1)
        assert foretold == pytest.approx(actual, rel=0.25)


def test_about_the_middle_of_a_step_the_odd_lines_hold_the_errors():
    for power in lines_of_rounding(9.0, 0.0, 0.5):
        assert power[5:280:2].mean() > 5 * power[6:280:2].mean()


def test_a_joint_within_one_step_has_white_errors():
    Q = np.zeros((2, 50), complex)
    Q[:, 0] = 0.7
    assert rounding_error(Q, 1e-4, 0.7, 4000, 20) == pytest.approx(np.full(20, 1e-8 / 12 / 4000))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_beside_an_encoder_in_steps_nothing_is_left_but_noise(tmp_path, seed):
    """A loop that hunts between steps of 45 times the encoder's noise, at two levels: chi-square stays that of
    noise."""
    robot = load_robot("ur10")
    plan = plan_experiment(
        robot,
        operating_points(robot, 2, np.random.default_rng(seed)),
        points=2,
        seed=seed,
        levels=(1.0, 0.4),
        period=4000,
    )
    hidden = EFFECTS["encoder_quantization"](place="shoulder_lift_joint", resolution=9e-5)
    save_dataset(run_experiment(plan, [hidden], seed=seed), tmp_path / "d")
    setup, fit = identify(load_dataset(tmp_path / "d"))
    assert [s.joint for s in setup.steps] == [1]
    assert 0.85 < fit.chi2_per_dof < 1.15 and not np.any(drifting(setup.problem.groups))


@pytest.mark.slow
def test_what_circulates_in_the_loop_is_no_rounding_that_averages_out(tmp_path):
    """Positions differ from period to period by more than their errors do: at joint 2 of the IRB by twice as much."""
    robot = load_robot("irb")
    plan = plan_experiment(
        robot, operating_points(robot, 2, np.random.default_rng(4)), points=1, seed=4, levels=(1.0, 0.3), period=2000
    )
    hidden = EFFECTS["encoder_quantization"](place="joint_2", resolution=3.6e-5)
    save_dataset(run_experiment(plan, [hidden], seed=4), tmp_path / "d")
    data = load_dataset(tmp_path / "d")
    setup, fit = identify(data)
    assert [s.joint for s in setup.steps] == [1]
    assert np.all(fit.costs / fit.counts < 1.1)
    # As told by the positions alone these would repeat far less.
    less = with_rounding(setup.problem.groups, setup.steps, data)
    assert np.mean([g.rounding[:, 1] for g in less]) < 0.6 * np.mean([g.rounding[:, 1] for g in setup.problem.groups])


def test_an_error_within_the_steps_of_an_encoder_is_not_trusted():
    steps = (Steps(2, 1e-4, 1e-9),)

    def within(joint, *p):
        return within_steps(Effect(encoder_eccentricity(joint, f"joint_{joint}"), np.array(p)), steps)

    assert within(2, 6e-5, -6e-5) and not within(2, 9e-5, 6e-5)
    assert not within(1, 6e-5, -6e-5)
    assert not within_steps(Effect(sensor_lag(2, "joint_2"), np.array([1e-5, 0.0])), steps)


def test_a_step_is_known_to_the_digits_of_a_recorder():
    """However exactly the samples lie on their grid."""
    q = 8.69e-5 * np.round(np.random.default_rng(0).normal(0.0, 30.0, 4000))
    step, std = _exact_grid(q)
    assert step == pytest.approx(8.69e-5, rel=1e-12) and std == pytest.approx(1e-6 * step)
