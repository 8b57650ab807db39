"""Ripples with a second harmonic: their law, and one hidden in the plant."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.diagnosis import diagnose
from ident.hypotheses import catalogue
from ident.hypotheses.drive import cogging
from ident.hypotheses.ripple import ripple
from ident.identification import identify
from ident.model import Effect
from ident.position_lines import wave_numbers
from ident.problem import predictions
from ident.screening import Score, other_waves, screen
from ident.values import reported_parameters
from robot_assets.robot import load_robot
from sim import parse_effect
from sim.effects.effect import Torque
from sim.effects.transmission import carried
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files

sizes = st.floats(-0.6, 0.6)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.tuples(sizes, sizes), st.floats(-20.0, 20.0))
def test_a_ripple_and_its_slope(sine, cosine, second, angle):
    value, slope = ripple(sine, cosine, np.array(second), np.array(angle))
    size = np.hypot(sine, cosine)
    harmonics = [
        sine * np.sin(angle),
        cosine * np.cos(angle),
        size * second[0] * np.sin(2 * angle),
        size * second[1] * np.cos(2 * angle),
    ]
    assert value == pytest.approx(sum(harmonics), abs=1e-9)
    h = 1e-5
    ends = [ripple(sine, cosine, np.array(second), np.array(angle + d))[0] for d in (-h, h)]
    assert slope == pytest.approx((ends[1] - ends[0]) / (2 * h), abs=1e-6)


@dataclass(frozen=True)
class UnevenGear:
    """The gear sees ``q`` with an error of two harmonics; power is conserved."""

    place: str
    amplitude: float
    periods_per_rev: float
    second: float

    def torque(self, run):
        j, load, a, n = run.joint(self.place), carried(run, self.place), self.amplitude, self.periods_per_rev

        def step(x):
            angle = n * x.q[:, j]
            error = a * (np.sin(angle) + self.second * np.cos(2 * angle))
            slope = a * n * (np.cos(angle) - 2 * self.second * np.sin(2 * angle))
            gear = load(x, error, slope * x.v[:, j])
            h = gear - load(x)
            return Torque(j, -h - slope * gear, h)

        return step


def uneven_motor(robot, size):
    waves = [(size, 202.0, 0.0), (0.2 * size, 404.0, -1.0)]
    return [
        parse_effect(f"cogging@elbow_joint:amplitude={a},periods_per_rev={n},phase={p}", robot) for a, n, p in waves
    ]


def test_a_ripple_that_grows_with_the_torque_is_asked_for_in_advance(identified):
    """What the decoy says is recorded gives what the motor delivers, once it ripples; its screening is the
    derivative."""
    _, setup, result = identified
    problem, j = setup.problem, 2
    h = next(h for h in catalogue(problem.structure) if h.key == ("unknown:torque_ripple", "elbow_joint"))
    group = problem.groups[0]
    motion = predictions(problem, result.model, result.remainders)[0].motion()
    U, k, p = motion.solution.U[..., j], result.model.par.stiffness[j], np.array([0.03, 100.0, 0.02])

    def told(part):
        return h.law(part * p + np.array([0.0, (1.0 - part) * p[1], 0.0]), motion, j, k, U)

    q = p[1] * motion.q(j)
    gain = 1.0 + p[0] * np.sin(q) + p[2] * np.cos(q)
    back = motion.lines(gain * group.to_time(told(1.0)[..., None])[..., 0])
    assert np.linalg.norm(back - U) < 0.02 * np.linalg.norm(told(1.0) - U)
    made = h.screen(motion, j, k, (p[1],))
    unit = sum(w * motion.lines(x) for w, x in zip(p[[0, 2]], made.signals, strict=True))
    assert np.linalg.norm((told(1e-4) - U) / 1e-4 - unit) < 1e-3 * np.linalg.norm(unit)
    assert made.start(np.array([0.03, 0.02])) == pytest.approx(p)


def test_other_wave_numbers_that_explain_nearly_as_much_are_kept(identified):
    _, setup, _ = identified
    h = next(h for h in catalogue(setup.problem.structure) if h.key == ("cogging", "elbow_joint"))

    def score(wave, gain, start=np.zeros(5)):
        return Score(h, gain, 2, start, np.ones(2), (wave,))

    best, near, nearer, far = score(300.0, 100.0), score(200.0, 92.0), score(202.0, 91.0), score(50.0, 80.0)
    unstarted, third, fourth = score(150.0, 99.0, None), score(400.0, 91.0), score(800.0, 90.5)
    assert other_waves(best, [unstarted, near, nearer, third, fourth, far]) == (near, third)
    assert other_waves(best, [far, score(302.0, 99.0)]) == ()
    # Of a motor with a gear of 50, by less.
    assert other_waves(best, [near, third, fourth, far], (50.0, 100.0, 800.0)) == (near, third, fourth, far)
    assert other_waves(best, [score(50.0, 40.0)], (50.0,)) == ()


@pytest.mark.parametrize("name", ["cogging", pytest.param("transmission_error", marks=pytest.mark.slow)])
def test_a_ripple_with_a_second_harmonic_is_one_cause(ur10, tmp_path, name):
    """Nothing else is named for what a sine would leave of it."""
    size = {"cogging": 6.0, "transmission_error": 5e-5}[name]
    effects = uneven_motor(ur10, size) if name == "cogging" else [UnevenGear("elbow_joint", size, 202.0, 0.2)]
    drives = draw_drives(np.random.default_rng(8), ur10)
    data = quick_experiment(small_plan(ur10, 8, points=1, levels=(1.0,), period=1000), effects, seed=8, drives=drives)
    verdict = diagnose(through_files(data, tmp_path))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.1] == [(name, "elbow_joint")]
    found = verdict.causes[0].parameters
    assert found["amplitude"].value == pytest.approx(size, rel=0.03)
    assert found["periods_per_rev"].value == pytest.approx(202.0, rel=1e-3)
    assert verdict.unexplained_verdict == "noise floor reached"


@pytest.mark.parametrize("number", [67.0, 23.7])
def test_a_wave_longer_than_a_posture_shows_is_found_over_all_of_them(locked, number):
    """No motor order, and a quarter of a period in each of three postures; drives as they are off their sheet."""
    plan = small_plan(locked, 12, points=3, levels=(1.0,), period=1000, validation_points=0)
    drives = draw_drives(np.random.default_rng(12), locked)
    hidden = parse_effect(f"cogging@elbow_joint:amplitude=5,periods_per_rev={number},phase=0.6", locked)
    setup, first = identify(quick_experiment(plan, [hidden], seed=12, drives=drives))
    problem, preds = setup.problem, predictions(setup.problem, first.model, first.remainders)
    spans = [np.ptp(g.to_time(g.Q)[..., 2], axis=1).max() for g in problem.groups]
    assert number * max(spans) < 2.0
    found = np.array(wave_numbers(problem, preds, 2))
    assert np.min(np.abs(found / number - 1.0)) < 0.01
    cogging = next(h for h in catalogue(problem.structure) if h.key == ("cogging", "elbow_joint"))
    (score,) = screen(problem, first, preds, [cogging])
    assert score.shape[0] == pytest.approx(number, rel=0.01)


def test_a_second_harmonic_is_told_as_a_whole():
    """Where one part of it is found; nothing of it where none is."""
    h = cogging(0, "drive")
    names = [h.coordinate(q.name) for q in h.parameters]
    structure = SimpleNamespace(robot=load_robot("twomass"))
    final = SimpleNamespace(names=names, model=SimpleNamespace(structure=structure))
    covariance = np.diag([1e-2, 1e-2, 1e-2, 1e-2, 1e-2]) ** 2
    for second, told in (((0.2, -0.02), True), ((0.02, -0.02), False)):
        values = reported_parameters(Effect(h, np.array([0.5, 40.0, 0.1, *second])), final, covariance)
        assert ("second_sine" in values, "second_cosine" in values) == (told, told)
        assert values["amplitude"].value == pytest.approx(np.hypot(0.5, 0.1))
