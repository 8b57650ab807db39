"""Intervals of the gain: how often they hold what they are for."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident import gain, refuted
from ident.attribute import Attribution
from ident.diagnosis import diagnose
from ident.gain import Errors, line_squares, mean_squares, measure_gain
from ident.model import Effect, Model
from ident.motion import Steady, Torques
from ident.notes import along_note, chosen_motion_note
from ident.verdict import UNKNOWN
from sim import parse_effect
from tests.conftest import quick_experiment, small_plan, through_files

LINES, DRAWS = 120, 150
NOISE = 0.02


def complex_normal(rng, shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0)


def resonance(lines, quality):
    x = lines / 40.0
    return 1.0 / np.abs(1.0 - x**2 + 1j * x / quality)


def gains(of_excitation, at_random, rng):
    """Closed shares and intervals of single records of random phase, and the share that many of them have.

    Args:
        of_excitation, at_random: each (before, after), (K,) errors of a linear model and of stochastic nonlinear
            distortion.
    """
    excited = np.arange(LINES) % 4 == 1

    def squares(n):
        X = excited * np.exp(2j * np.pi * rng.random((n, LINES)))
        common = complex_normal(rng, X.shape)
        draws = (common, 0.5 * common + np.sqrt(0.75) * complex_normal(rng, X.shape))
        return [
            np.abs(g * X + s * c + NOISE * complex_normal(rng, X.shape)) ** 2
            for g, s, c in zip(of_excitation, at_random, draws)
        ]

    noise = np.full((LINES, 1), NOISE**2)
    floor = np.sqrt(mean_squares(noise[None])[0, 0])
    before, after = (np.sqrt(mean_squares(x[..., None]).mean()) for x in squares(5000))
    out = []
    for b, a in zip(*squares(DRAWS)):
        rows = Errors(("one",) * LINES, *(line_squares(x.reshape(-1, 1)) for x in (b, a, noise)))
        out.append(measure_gain(rows, {"drive": "N m"}, [0], "validation segments", rng))
    return out, (before - after) / (before - floor)


FLAT = np.ones(LINES)
PEAK = resonance(np.arange(LINES), 8.0)


@pytest.mark.parametrize(
    ("of_excitation", "at_random", "widest"),
    [
        ((FLAT, 0.3 * FLAT), (0.0, 0.0), 1.5),
        ((FLAT, 0.1 * FLAT), (0.3, 0.2), 1.8),
        ((PEAK, 0.1 * PEAK), (0.3 * PEAK, 0.2 * PEAK), 2.0),
        ((0.0, 0.0), (FLAT, 0.3 * FLAT), 1.3),
        ((0.0, 0.0), (PEAK, 0.3 * PEAK), 1.3),
    ],
    ids=["linear", "both", "both, resonant", "stochastic", "stochastic, resonant"],
)
def test_the_interval_of_a_single_periodic_record_covers_what_other_phases_show(of_excitation, at_random, widest):
    found, true = gains(of_excitation, at_random, np.random.default_rng(3))
    low, high = np.array([g.ci95 for g in found]).T
    assert np.mean((low <= true) & (true <= high)) > 0.9
    scatter = np.std([g.gap_closed for g in found])
    assert 0.85 < np.mean(high - low) / (3.92 * scatter) < widest


def test_lines_of_a_record_make_up_its_mean_square():
    lines = np.random.default_rng(0).random((30, 2))
    assert line_squares(lines).mean(axis=0) == pytest.approx(mean_squares(lines[None])[0])


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        ((1.0, 1.1, 1.2), (1.5, 1.7, 1.6), True),
        ((1.0, 1.1, 1.2), (0.5, 1.7, 1.0), False),
        ((1.0, 1.1, 1.2), (0.1,) * 3, False),
    ],
)
def test_what_surely_harms_is_told(before, after, worse):
    rows = [np.square(x)[:, None] for x in (before, after, (0.1,) * 3)]
    gain = measure_gain(Errors(("a", "b", "c"), *rows), {"drive": "N m"}, [0], "method", np.random.default_rng(0))
    assert gain.worse == worse


def test_a_gap_within_the_noise_of_some_records_has_no_interval():
    """Of three records two lie below the noise; a quarter of the resamples has no gap."""
    rows = [np.array(x)[:, None] for x in ((9.0, 0.9, 0.9), (1.0, 0.5, 0.5), (1.0, 1.0, 1.0))]
    told = measure_gain(Errors(("a", "b", "c"), *rows), {"drive": "N m"}, [0], "method", np.random.default_rng(0))
    assert told.gap_closed is not None and told.ci95 is None and not told.worse
    rows[0][1:] = 4.0
    told = measure_gain(Errors(("a", "b", "c"), *rows), {"drive": "N m"}, [0], "method", np.random.default_rng(0))
    low, high = told.ci95
    assert 0.9 < low <= told.gap_closed <= high < 1.5


def test_a_cause_that_harms_held_out_data_is_taken_back(locked, tmp_path):
    """A spring that was taken off before the data that are held out were recorded."""
    plan = small_plan(locked, 4, levels=(1.0,))
    spring = parse_effect("gravity_spring@elbow_joint:stiffness=60,rest_angle=0.3", locked)
    held, bare = (quick_experiment(plan, effects, seed=4) for effects in ([spring], []))
    segments = tuple(b if b.role == "validation" else a for a, b in zip(held.segments, bare.segments, strict=True))
    verdict = diagnose(through_files(replace(held, segments=segments), tmp_path), max_causes=1)
    (note,) = (x for x in verdict.notes if x.startswith("Taken back: gravity_spring at elbow_joint."))
    assert "predicted worse" in note
    assert not verdict.causes and verdict.unexplained_verdict == UNKNOWN
    assert verdict.gain.before == verdict.gain.after


@pytest.mark.parametrize(
    ("rattles", "left", "left_along"), [(False, [0.2, 0.1], [0.2, 0.1]), (True, [0.2, 6.0], [0.2, 0.1])]
)
def test_each_record_is_predicted_in_the_steady_motion_that_its_torque_tells(monkeypatch, rattles, left, left_along):
    """Of two records one is met by a start from nothing, and one by a start from what the recorded torque says: or by
    none, where the gear rattles, and along the record alone."""
    measured = np.zeros((2, 3, 1), complex)
    group = SimpleNamespace(U=measured, segments=("first", "second"), window=None, observe=lambda X: X)
    law = SimpleNamespace(channel="spring", options={"bends": lambda p, f, k: p * f})
    model = Model(None, None, (Effect(law, np.array([1.0])),))
    monkeypatch.setattr(gain, "along_record", lambda h: SimpleNamespace(channel="spring", options={"along": True}))

    def predicted(model, off):
        """Off by so much in each record; of states by which the start of the next prediction is told."""
        state = np.array(off)[:, None, None] * np.ones((2, 3, 1))
        steady = {("a", "b"): Steady(np.zeros((2, 8)), np.zeros((1, 2), complex), np.zeros((3, 2)))}
        solution = SimpleNamespace(W=state, torques=Torques(spring=state, steady=steady))
        return SimpleNamespace(model=model, group=group, sampling=None, solution=solution, U=measured + state)

    def predict(model, group, sampling, *, W=None, torques=None, steps=None):
        if "along" in model.effects[0].hypothesis.options:
            return predicted(model, [5.0, 0.1])
        assert W is torques.spring or np.array_equal(W, torques.spring)
        off = W[:, 0, 0]
        return predicted(model, np.where(off == 0.1, 6.0, off) if rattles else off)

    monkeypatch.setattr(gain, "predict", predict)
    told = gain.in_recorded_motion(predicted(model, [0.2, 7.0]))
    assert told.records.tolist() == [False, not rattles] and "in second," in chosen_motion_note(["second"])
    assert told.rattles.tolist() == [False, rattles]
    assert told.prediction.U[:, 0, 0].real == pytest.approx(left)
    seen = np.where(told.rattles[:, None, None], told.along.U, told.prediction.U)
    assert seen[:, 0, 0].real == pytest.approx(left_along)
    linear = replace(model, effects=())
    start = predicted(linear, [0.2, 7.0])
    assert gain.in_recorded_motion(start).prediction is start


def test_a_law_that_rattles_is_told_to_be_trusted_along_the_record():
    errors = Errors(
        ("one", "two"), *(np.full((2, 1), x) for x in (100.0, 25.0, 1.0)), along=(np.full((2, 1), 4.0), np.ones((2, 1)))
    )
    simulated, along = (
        measure_gain(x, {"drive": "N m"}, [], "method", np.random.default_rng(0)) for x in (errors, errors.seen_along())
    )
    assert (simulated.after, along.after) == (5.0, 2.0) and simulated.gap_closed < 0.6 < along.gap_closed
    (note,) = along_note(simulated, along)
    assert "leaves 5 N m" in note and "and 2 N m" in note
    assert along_note(simulated, simulated) == () and replace(errors, along=None).seen_along().after is errors.after


@pytest.mark.parametrize(
    ("left", "kept"),
    [
        ({3: 1.1, 2: 9.0, 1: 9.0, 0: 10.0}, 3),  # nothing is refuted
        ({3: 7.0, 2: 1.1, 1: 9.0, 0: 10.0}, 2),
        ({3: 7.0, 2: 5.4, 1: 1.2, 0: 10.0}, 1),
        ({3: 7.0, 2: 6.5, 1: 1.1, 0: 10.0}, 3),  # the last alone is not to blame
        ({3: 12.0, 2: 11.5, 1: 11.5, 0: 10.0}, 0),
    ],
)
def test_causes_found_last_go_where_held_out_data_refute_them(monkeypatch, ur10, left, kept):
    """Held-out errors are those that a model with so many causes leaves."""
    causes = [SimpleNamespace(effect=f"e{i}", place="base", key=(f"e{i}", "base"), options={}) for i in range(3)]

    def model(n):
        effects = tuple(SimpleNamespace(hypothesis=h) for h in causes[:n])
        return SimpleNamespace(
            model=SimpleNamespace(effects=effects), chi2_per_dof=1.0, costs=np.ones(1), counts=np.ones(1)
        )

    def tested(found, inertias):
        n = len(found.final.model.effects)
        rows = (np.full((40, 1), x**2) for x in (10.0, left[n], 1.0))
        gain = measure_gain(Errors(("s",) * 40, *rows), {"elbow_joint": "N m"}, [], "method", np.random.default_rng(0))
        return refuted.HeldOut(gain, gain, (), ())

    monkeypatch.setattr(refuted, "without_effect", lambda problem, final, key: model(len(final.model.effects) - 1))
    monkeypatch.setattr(Attribution, "left_share", 0.0)
    monkeypatch.setattr(Attribution, "without_causes", lambda self: replace(self, final=model(0), rounds=()))
    rounds = tuple(SimpleNamespace(candidates=[SimpleNamespace(hypothesis=h)]) for h in causes)
    result = Attribution(model(0), True, True, 0.0, rounds, model(3), False)
    setup = SimpleNamespace(problem=SimpleNamespace(structure=SimpleNamespace(robot=ur10), groups=()))
    found, test, lines = refuted.taken_back(setup, result, tested)
    assert len(found.rounds) == len(found.final.model.effects) == kept and test.gain.after == left[kept]
    told = {3: [], 2: ["e2"], 1: ["e2", "e1"], 0: ["e0 at base, e1 at base, e2"]}[kept]
    assert [line.split(": ")[1].split(" at base.")[0] for line in lines] == told
