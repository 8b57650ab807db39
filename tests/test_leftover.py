"""What no effect explains: where it sits, how it grows and on what it depends."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.hypotheses.friction import velocity_power
from ident.identification import identify
from ident.leftover import Excess, band_of, find_leftover, growth_of, law_of
from ident.model import Effect
from ident.refits import refit
from sim.effects.effect import Torque
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files


@dataclass(frozen=True)
class Drag:
    """Drag with the square of the speed, which the catalogue lacks."""

    place: str
    coefficient: float  # N m s2/rad2

    def torque(self, run):
        j = run.joint(self.place)

        def drag(x):
            v = x.v[:, j]
            return Torque(j, -self.coefficient * v * np.abs(v))

        return drag


def baseline_of(robot, folder, effects):
    """The fitted baseline of records with effects in them."""
    drives = draw_drives(np.random.default_rng(3), robot)
    plan = small_plan(robot, 3, points=1, levels=(1.0,), period=1000, validation_points=0)
    data = quick_experiment(plan, effects, seed=3, drives=drives)
    setup, baseline = identify(through_files(data, folder))
    return setup.problem, baseline


def share_of_velocity(left):
    """What the velocity explains of the residual, by the text."""
    assert "mostly at elbow_joint" in left.text
    return int(left.text.split("motor velocity explains ")[1].split("%")[0]) / 100.0


def test_a_drag_is_told_by_its_joint_and_the_velocity(locked, tmp_path):
    problem, baseline = baseline_of(locked, tmp_path, [Drag("elbow_joint", 40.0)])
    drag = Effect(velocity_power(2, "elbow_joint", 2), np.array([30.0]))
    with_drag = refit(problem, replace(baseline.model, effects=(drag,)), baseline.weights, baseline.remainders)
    nameless = SimpleNamespace(explained=1.0, candidates=[SimpleNamespace(fit=with_drag)])
    left = find_leftover(problem, baseline, nameless)
    assert share_of_velocity(left) > 0.95
    assert left.plot.y == pytest.approx(40.0 * left.plot.x * np.abs(left.plot.x), abs=0.1 * np.max(left.plot.y))
    alone = find_leftover(problem, baseline, None)  # the drives have taken up a part of it
    assert "mostly at elbow_joint" in alone.text and np.std(alone.plot.y) < 0.5 * np.std(left.plot.y)


def test_of_noise_alone_next_to_nothing_is_left(locked, tmp_path):
    problem, baseline = baseline_of(locked, tmp_path, [])
    left = find_leftover(problem, baseline, None)
    noise = problem.tau_std[locked.joint_names.index(left.plot.title.split()[-1])]
    assert baseline.chi2_per_dof < 1.1
    assert np.std(left.plot.y) < 0.3 * noise


def excess(power, step_hz=1.0):
    """Of a group of records with lines ``step_hz`` apart."""
    group = SimpleNamespace(
        omega=2.0 * np.pi * step_hz * np.arange(power.shape[1]), n_compared=power.shape[1], window=None
    )
    return Excess(group, np.ones(power.shape[1]), np.sqrt(1.0 + power))


def test_the_band_is_that_of_the_power_beyond_noise():
    frequency = np.linspace(0.0, 50.0, 501)
    power = np.where((frequency >= 10.0) & (frequency <= 20.0), 1.0, 0.0)[None]
    low, high = band_of([excess(power, 0.1), excess(0.0 * power, 0.1)])
    assert low == pytest.approx(11.0, abs=0.2) and high == pytest.approx(19.0, abs=0.2)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.5])
def test_the_growth_with_the_level_is_found_over_groups_that_differ(exponent):
    levels = [np.array([0.5, 1.0]), np.array([2.0, 4.0, 4.0])]
    found = [excess(100.0 * (v**exponent)[:, None] ** 2 * np.ones(3)) for v in levels]
    assert growth_of([SimpleNamespace(amplitude=v) for v in levels], found) == pytest.approx(exponent)


def test_records_that_leave_less_than_noise_have_a_band_too():
    low, high = band_of([excess(np.full((2, 5), -0.5))])
    assert 0.0 <= low <= high <= 4.0


def test_there_is_no_growth_of_one_level_or_of_nothing():
    one, two = (SimpleNamespace(amplitude=np.array(v)) for v in ([1.0, 1.0], [0.5, 1.0]))
    assert growth_of([one], [excess(np.ones((2, 3)))]) is None
    assert growth_of([two], [excess(np.zeros((2, 3)))]) is None


class Periods:
    """A group of whole periods with 60 compared lines."""

    n_time, n_compared, window = 512, 60, None
    omega = 2.0 * np.pi * np.arange(100)

    def to_lines(self, x):
        return np.fft.rfft(x, axis=-2, norm="forward")[..., : len(self.omega), :]

    def to_time(self, X):
        return np.fft.irfft(X, n=self.n_time, axis=-2, norm="forward")

    def observe(self, X):
        return X[..., : self.n_compared, :]


def test_a_law_is_found_by_the_lines_that_are_beyond_noise():
    """Many lines of the residual are below the noise: what is left of them is no function of the variable any more."""
    rng, group = np.random.default_rng(0), Periods()
    spectrum = np.zeros((2, 100, 1), complex)
    spectrum[:, 1:40:2] = np.exp(2j * np.pi * rng.uniform(size=(2, 20, 1)))
    x = group.to_time(spectrum)[..., 0]
    law = 10.0 * x * np.abs(x)
    noise = np.where(np.arange(60) < 12, 0.1, 1e3)
    drawn = noise * (rng.normal(size=(2, 60, 2)) @ [1.0, 1j]) / np.sqrt(2.0)

    def found(signal):
        lines = group.to_lines(signal[..., None])[:, :60, 0] + drawn
        excess = Excess(group, noise, lines / noise)
        return law_of(excess, x), np.sum(excess.power)

    true, whole = found(law)
    assert true.explained == pytest.approx(whole, rel=0.02)
    assert true.y == pytest.approx(10.0 * true.x * np.abs(true.x), abs=0.5 * np.max(x) ** 2)
    other, whole = found(20.0 * rng.normal(size=x.shape))
    assert other.explained < 0.4 * whole
