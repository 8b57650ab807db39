"""What held-out data say of causes that the data of the fit hardly tell apart."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.arbitration import (
    ALIKE,
    MOST_SEGMENTS,
    NUMBERS,
    SURE,
    joints_of,
    nats_for,
    rivals_of,
    weighed_on_held_out,
    with_rival,
)
from ident.attribute import Attribution
from ident.evidence import Candidate
from ident.gain import Errors
from ident.hypotheses.friction import coulomb_friction, stribeck_friction
from ident.hypotheses.transmission import backlash
from ident.identification import identify
from ident.model import Effect
from ident.parallel import Workers
from ident.refits import refit
from ident.rounds import Round
from sim import parse_effect
from tests.conftest import quick_experiment, small_plan, through_files

pytestmark = pytest.mark.xdist_group("arbitration")
STARTS = {"coulomb_friction": [9.0, 0.0, 1e-3, 0.0], "stribeck_friction": [7.0, 9.0, 0.1, 1e-3, 1.5, 0.0]}
# of speeds far above those of the multisines: over these it falls as a line does
HIDDEN = {
    "coulomb_friction": "torque=8",
    "stribeck_friction": "coulomb=4,static=9,stribeck_velocity=0.12",
}


def errors(left, noise=1.0, names=None):
    """Errors after of rows and joints."""
    left = np.array(left, float)
    return Errors(names or tuple(f"s{i}" for i in range(len(left))), left, left, np.full(left.shape, noise))


@pytest.mark.parametrize(
    ("own", "rival", "expected"),
    [
        ([[4.0], [9.0]], [[4.0], [9.0]], 0.0),
        ([[4.0], [9.0]], [[0.04], [0.09]], NUMBERS * (np.log(100.0) - ALIKE)),  # half of it, of two segments
        ([[0.04], [0.09]], [[4.0], [9.0]], -NUMBERS * (np.log(100.0) - ALIKE)),
        ([[9.0]] * 40, [[1.0]] * 40, 0.5 * NUMBERS * MOST_SEGMENTS * (np.log(9.0) - ALIKE)),
        (
            [[1.0, 50.0], [1.0, 50.0]],
            [[1.01, 5.0], [1.01, 5.0]],
            NUMBERS * (np.log(10.0) - ALIKE),
        ),  # where they differ most
        ([[3.0], [4.0]], [[4.0], [3.0]], 0.0),  # now the one, now the other
        ([[3.0], [3.0]], [[3.27], [3.27]], 0.0),
        ([[1.0], [1.5]], [[0.5], [0.5]], 0.0),  # noise
        ([[3.0], [3.0]], [[0.0], [0.0]], SURE),
    ],
)
def test_held_out_errors_speak_for_the_model_that_leaves_less(own, rival, expected):
    assert nats_for(errors(rival), errors(own)) == pytest.approx(expected, abs=1e-12)


def test_stretches_of_a_motion_count_as_one_segment():
    names = ("motion",) * 8
    told = nats_for(errors([[1.0]] * 8, names=names), errors([[4.0]] * 8, names=names))
    assert told == pytest.approx(0.5 * NUMBERS * (np.log(4.0) - ALIKE))


def test_joints_at_which_neither_cause_sits_say_nothing():
    own, rival = errors([[100.0, 1e6]] * 4), errors([[10.0, 1e4]] * 4)
    assert nats_for(rival, own, (0,)) == pytest.approx(2.0 * NUMBERS * (np.log(10.0) - ALIKE))
    assert nats_for(rival, own) == pytest.approx(2.0 * NUMBERS * (np.log(100.0) - ALIKE))
    joint, chain = (Candidate(SimpleNamespace(joint=j, on_chain=on), None, 0.0) for j, on in ((2, False), (1, True)))
    assert joints_of(joint, joint) == (2,) and joints_of(joint, chain) is None


def test_models_that_differ_by_chance_alone_are_hardly_moved():
    rng = np.random.default_rng(3)
    draws = [[errors(5.0 * rng.chisquare(200, (12, 2)) / 200) for _ in range(2)] for _ in range(200)]
    moved = [nats_for(*pair, (0,)) for pair in draws]
    assert np.mean(np.abs(moved) > 1.0) < 0.05 and abs(np.mean(moved)) < 0.1


@pytest.fixture(scope="module", params=list(HIDDEN))
def friction(locked, tmp_path_factory, request):
    """What is hidden, its problem, held-out motion, and what each of both laws comes to."""
    hidden = [parse_effect(f"{request.param}@elbow_joint:{HIDDEN[request.param]}", locked)]
    data = quick_experiment(small_plan(locked, 3, levels=(1.0,), trajectory=True), hidden, seed=3)
    setup, baseline = identify(through_files(data, tmp_path_factory.mktemp("friction")))
    laws = {law.__name__: law(2, "elbow_joint") for law in (coulomb_friction, stribeck_friction)}
    candidates = []
    for name, p in STARTS.items():
        model = replace(baseline.model, par=setup.problem.nominal, effects=(Effect(laws[name], np.array(p)),))
        found = refit(setup.problem, model, baseline.weights, baseline.remainders, 40)
        candidates.append(Candidate(laws[name], found, 0.0, 0.5))
    return request.param, setup, baseline, Round(baseline, tuple(candidates), (), 1.0, 1.0)


def led_by(found, effect, share):
    """The round as if one of its candidates had won it with a probability."""
    ordered = sorted(found.candidates, key=lambda c: c.hypothesis.effect != effect)
    odds = (share, 1.0 - share)
    return replace(found, candidates=tuple(replace(c, probability=p) for c, p in zip(ordered, odds, strict=True)))


def weighed(friction, first, share):
    """Both laws weighed, one of which led with a probability."""
    _, setup, baseline, found = friction
    led = led_by(found, first, share)
    start = Attribution(baseline, True, True, 0.0, (led,), led.candidates[0].fit, False)
    result, lines = weighed_on_held_out(setup.problem, setup.held_out, start, Workers())
    candidates = result.rounds[0].candidates
    assert sum(c.probability for c in candidates) == pytest.approx(1.0)
    assert [e.hypothesis.key for e in result.final.model.effects] == [candidates[0].hypothesis.key]
    return {c.hypothesis.effect: c.probability for c in candidates}, lines


@pytest.mark.parametrize("first", list(HIDDEN))
def test_a_motion_tells_what_small_motions_about_a_posture_do_not(friction, first):
    """A law that the held-out motion needs wins against one that led with 0.9; one that it does not need gains
    nothing, and the plain law keeps its lead."""
    hidden = friction[0]
    odds, lines = weighed(friction, first, 0.9)
    if hidden == "stribeck_friction":
        assert next(iter(odds)) == hidden and odds[hidden] >= 0.9 - 1e-9
    else:
        assert odds["stribeck_friction"] <= (0.1 if first == hidden else 0.9) + 1e-9
    if hidden == "stribeck_friction" and first != hidden:
        told, gain = lines
        assert told.startswith(f"Held-out data speak for {hidden} at elbow_joint against {first} at elbow_joint")
        assert gain.startswith("They have chosen")


@pytest.mark.parametrize("unusable", ["no segments", "not fitted", "fitted badly", "not predicted"])
def test_a_rival_that_cannot_be_told_is_left_as_it_was(friction, monkeypatch, unusable):
    """No held-out record that a model follows, or no fit that is as good as the data of the search have told."""
    if unusable == "no segments":
        nothing = errors(np.zeros((0, 3)), names=())
        monkeypatch.setattr("ident.arbitration.segment_errors", lambda *args: (nothing, []))
    elif unusable == "not predicted":

        def fails(*args):
            raise FloatingPointError

        monkeypatch.setattr("ident.arbitration.segment_errors", fails)
    else:
        bad = None if unusable == "not fitted" else replace(friction[2], costs=1e3 * friction[2].costs)
        monkeypatch.setattr("ident.arbitration.refit", lambda *args: bad)
    odds, lines = weighed(friction, "coulomb_friction", 0.7)
    assert odds == pytest.approx({"coulomb_friction": 0.7, "stribeck_friction": 0.3}) and lines == []


def test_a_decoy_takes_probability_and_no_place(friction):
    hidden, setup, baseline, found = friction
    led = led_by(found, "coulomb_friction", 0.9)
    own, other = led.candidates
    decoy = replace(other, hypothesis=replace(other.hypothesis, effect="unknown:dip"))
    effect = replace(other.fit.model.effects[0], hypothesis=decoy.hypothesis)
    decoy = replace(decoy, fit=replace(other.fit, model=replace(other.fit.model, effects=(effect,))))
    start = Attribution(baseline, True, True, 0.0, (replace(led, candidates=(own, decoy)),), own.fit, False)
    result, _ = weighed_on_held_out(setup.problem, setup.held_out, start, Workers())
    first, second = result.rounds[0].candidates
    assert first.hypothesis is own.hypothesis and result.final is own.fit
    assert (second.probability > 0.5) == (hidden == "stribeck_friction")


def test_without_held_out_data_or_rivals_nothing_is_weighed(friction):
    _, setup, baseline, found = friction
    led = led_by(found, found.candidates[0].hypothesis.effect, 0.9999)
    start = Attribution(baseline, True, True, 0.0, (led,), led.candidates[0].fit, False)
    assert weighed_on_held_out(setup.problem, setup.held_out, start, Workers()) == (start, [])
    led = led_by(found, found.candidates[0].hypothesis.effect, 0.6)
    assert weighed_on_held_out(setup.problem, (), replace(start, rounds=(led,)), Workers())[1] == []


def test_laws_of_the_gear_are_not_weighed_so(friction):
    found = led_by(friction[3], "coulomb_friction", 0.6)
    assert [c.hypothesis.effect for c in rivals_of(found, ())] == ["stribeck_friction"]
    assert rivals_of(found, [("stribeck_friction", "elbow_joint")]) == []  # nor one that is there already
    own, other = found.candidates
    assert rivals_of(replace(found, candidates=(own, replace(other, fit=own.fit))), ()) == []  # or not in its own fit
    gear = [
        replace(c, hypothesis=backlash(2, "elbow_joint", 1e-3) if i == at else c.hypothesis)
        for at in (0, 1)
        for i, c in enumerate(found.candidates)
    ]
    assert rivals_of(replace(found, candidates=tuple(gear[:2])), ()) == []
    assert rivals_of(replace(found, candidates=tuple(gear[2:])), ()) == []


def test_a_rival_keeps_the_other_causes_of_the_final_model(friction):
    """Where it was fitted beside the same ones, as it was; else in the place of the cause that it contests."""
    _, _, _, found = friction
    own, rival = found.candidates
    assert with_rival(own.fit.model, own, rival) is rival.fit.model
    beside = Effect(replace(own.hypothesis, place="another"), own.fit.model.effects[0].p)
    model = replace(own.fit.model, effects=(*own.fit.model.effects, beside))
    placed = with_rival(model, own, rival)
    assert [e.hypothesis.key for e in placed.effects] == [beside.hypothesis.key, rival.hypothesis.key]
    assert placed.par is model.par
