"""Effects that raise the noise of all lines by less than its estimate errs: seen by their own response, and not by chance."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.attribute import SEEN, SHADOW, attribute, chance_of, clearest, seen
from ident.baseline import DETECTION_EXCESS
from ident.diagnose import diagnose, identify
from ident.evidence import LAW_ERROR, TEMPER, Candidate, model_error, weigh
from ident.extended import Effect, along_record
from ident.hypotheses import catalogue
from ident.search import hopeful
from sim import parse_effect, run_experiment
from sim.experiment import draw_drives
from tests.conftest import small_plan, through_files

SIZES = {  # of effects that leave less than a tenth more than noise
    "cogging@wrist_3_joint:amplitude=0.002,periods_per_rev=202,phase=0.3": ("cogging", "wrist_3_joint", "amplitude", 0.002),
    "coulomb_friction@wrist_2_joint:torque=0.004": ("coulomb_friction", "wrist_2_joint", "torque", 0.004),
}


@pytest.fixture(scope="module")
def identified(clean):
    return identify(clean[0])


@pytest.fixture(scope="module")
def hypotheses(identified):
    return catalogue(identified[0].problem.structure)


@pytest.mark.parametrize("faint", SIZES)
@pytest.mark.parametrize("beside", [(), ("torque_delay@elbow_joint:delay=0.001",)])
def test_an_effect_within_the_error_of_the_noise_is_found(ur10, tmp_path, faint, beside):
    """Alone, and beside another one that is not faint."""
    hidden = [parse_effect(text, ur10) for text in (*beside, faint)]
    data = run_experiment(small_plan(ur10, 31), hidden, seed=31, drives=draw_drives(np.random.default_rng(31), ur10))
    verdict = diagnose(through_files(data, tmp_path))
    effect, joint, name, value = SIZES[faint]
    sure = {(c.effect, c.joint): c for c in verdict.causes if c.probability > 0.5}
    assert set(sure) == {(e.name, e.place) for e in hidden}
    assert sure[effect, joint].parameters[name].value == pytest.approx(value, rel=0.15)
    assert verdict.discrepancy.detected and verdict.unexplained_verdict == "noise floor reached"
    if not beside:
        assert verdict.discrepancy.chi2_per_dof < DETECTION_EXCESS and verdict.discrepancy.p_value < 1e-6


def test_noise_alone_shows_nothing_by_far(identified, hypotheses):
    setup, baseline = identified
    best = clearest(setup.problem, baseline, hypotheses)
    assert 0.0 < best.gain < 0.6 * SEEN and not seen(best, baseline)
    assert chance_of(best, hypotheses) > 1e-3
    found = attribute(setup.problem, baseline)
    assert not found.detected and not found.rounds


def test_what_causes_may_leave_as_errors_of_their_laws_is_not_looked_at(identified, hypotheses):
    setup, baseline = identified
    best = clearest(setup.problem, baseline, hypotheses)
    told = np.zeros(6)
    told[best.hypothesis.joint] = 1.01 * best.gain / SHADOW
    other = clearest(setup.problem, baseline, hypotheses, told)
    assert other.hypothesis.joint != best.hypothesis.joint and other.gain < best.gain


def test_nothing_faint_is_sought_beside_a_law_along_the_record(identified, hypotheses):
    setup, baseline = identified
    h = along_record(next(h for h in hypotheses if h.effect == "backlash"))
    model = replace(baseline.model, effects=(Effect(h, np.array([1e-4])),))
    assert clearest(setup.problem, replace(baseline, model=model), hypotheses) is None
    assert not seen(None, baseline)


@pytest.mark.parametrize(("left", "fall", "expected"), [
    (900.0, 1e6, 0.0),  # noise
    (1050.0, 1e6, 50.0),  # all of it may be an error of a strong law
    (1050.0, 300.0, 3.0),  # and next to none of it one of a faint law
    (1600.0, 1e6, 600.0),
    (1600.0, 200.0, 202.0),  # more than the law explains
    (1600.0, -5.0, 0.0),
])  # fmt: skip
def test_errors_of_a_law_are_a_share_of_what_it_explains(left, fall, expected):
    assert LAW_ERROR == 0.01 and DETECTION_EXCESS == 1.10
    assert model_error(left, 1000.0, fall) == pytest.approx(expected)


def test_faint_candidates_are_told_apart_by_what_they_explain(hypotheses):
    """Of two that explain 600 and 500 of the noise of a joint that counts 2 % too much, the former."""
    h = next(h for h in hypotheses if h.effect == "torque_delay")

    def one(cost: float) -> Candidate:
        model = SimpleNamespace(
            effects=(SimpleNamespace(hypothesis=h, p=np.array([1e-4])),), par=SimpleNamespace(stiffness=np.ones(6))
        )
        return Candidate(h, SimpleNamespace(model=model, information=np.eye(4), cost=cost), 0.0)

    faint, of_all = (weigh([one(17900.0), one(18000.0)], x)[0].probability for x in (model_error(17900.0, 17550.0, 600.0), 350.0))
    assert faint == pytest.approx(1.0 / (1.0 + np.exp(-50.0 / (TEMPER + 0.3))), abs=1e-9)
    assert of_all < 0.95


def test_the_special_case_of_a_law_that_goes_on_goes_on_too(hypotheses):
    """Coulomb friction is behind all laws that hold it, by what these have beyond it: noise, perhaps."""
    at = [h for h in hypotheses if h.place == "elbow_joint"]
    named = {h.effect: h for h in at}
    order = ("friction_drift", "unknown:position_friction", "presliding_friction", "cogging", "coulomb_friction", "torque_lag")
    found = [(named[effect], SimpleNamespace(cost=1001.0 + 10.0 * i, count=1000, converged=False)) for i, effect in enumerate(order)]
    assert [h.effect for h, _ in hopeful(found)] == [*order[:3], "coulomb_friction"]
    others = [(named[effect], r) for effect, (_, r) in zip(("cogging", "torque_delay", "backlash"), found, strict=False)]
    assert [h.effect for h, _ in hopeful([*others, *found[4:]])] == ["cogging", "torque_delay", "backlash"]
