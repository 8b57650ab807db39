"""Two causes at once, and a few records that stand for all."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.hypotheses import catalogue
from ident.identification import identify
from ident.model import Effect
from ident.pairs import beside_rivals
from ident.parallel import Workers
from ident.problem import data_counts
from ident.rounds import answers, weighed_round
from ident.strong import shows_softly, without_strong
from ident.thinning import ENOUGH, on_few, thinned
from ident.torque_fit import fit
from sim import parse_effect
from tests.conftest import quick_experiment, small_plan, through_files

pytestmark = pytest.mark.xdist_group("pairs")
HIDDEN = {"presliding_friction": "stiffness=6000,coulomb=5", "torque_constant": "scale=0.85"}


@pytest.fixture(scope="module")
def weak_bristle(locked, tmp_path_factory):
    """Problem, baseline and laws at the elbow, whose motor delivers too little and whose friction is a bristle."""
    hidden = [parse_effect(f"{name}@elbow_joint:{p}", locked) for name, p in HIDDEN.items()]
    data = quick_experiment(small_plan(locked, 3, points=3, levels=(1.0,)), hidden, seed=3)
    setup, baseline = identify(through_files(data, tmp_path_factory.mktemp("pair")))
    laws = {h.effect: h for h in reversed(catalogue(setup.problem.structure)) if h.place == "elbow_joint"}
    return setup.problem, baseline, laws


def named(problem, baseline, laws):
    """The model with dry friction, and the round that has named it before a bristle."""
    starts = {"coulomb_friction": [5.0, 0.0, 1e-2, 0.0], "presliding_friction": [6e3, 5.0, 1.0, 0.0]}
    effects = [Effect(laws[name], np.array(p)) for name, p in starts.items()]
    fits = [fit(problem, replace(baseline.model, effects=(e,)), weights=baseline.weights) for e in effects]
    found = weighed_round(baseline, [(e.hypothesis, r) for e, r in zip(effects, fits, strict=True)], (), {})
    ordered = sorted(found.candidates, key=lambda c: c.hypothesis.effect)  # dry friction first
    return ordered[0].fit, replace(found, candidates=tuple(ordered))


def test_a_rival_beside_a_second_cause_takes_the_place_of_what_did_best_alone(weak_bristle):
    problem, _, laws = weak_bristle
    current, last = named(*weak_bristle)
    asked = [laws[name] for name in ("torque_constant", "torque_lag", "presliding_friction")]
    rounds, found = beside_rivals(problem, current, [last], asked, Workers())
    assert [c.hypothesis.effect for c in rounds[0].candidates] == ["presliding_friction", "coulomb_friction"]
    assert found.candidates[0].hypothesis.effect == "torque_constant" and answers(found)
    bristle, constant = found.candidates[0].fit.model.effects
    assert bristle.value("coulomb") == pytest.approx(5.0, rel=0.02)
    assert constant.value("scale") == pytest.approx(0.85, rel=0.01)


def test_no_pair_is_taken_that_leaves_much(weak_bristle):
    problem, _, laws = weak_bristle
    current, last = named(*weak_bristle)
    assert beside_rivals(problem, current, [last], [laws["torque_lag"]], Workers()) is None
    assert beside_rivals(problem, current, [], [laws["torque_constant"]], Workers()) is None


def test_a_few_records_stand_for_all(identified):
    """As many of each level and experiment as before, and the model is as good as beside all of them."""
    _, setup, result = identified
    problem = setup.problem
    few = thinned(problem)
    records, kept = (sum(len(g.segments) for g in p.groups) for p in (problem, few))
    assert ENOUGH <= kept <= 0.6 * records
    rough = on_few(few, result, 0.0)
    assert np.sum(data_counts(few)) == rough.count < 0.6 * result.count
    assert rough.chi2_per_dof == pytest.approx(1.0, abs=0.15)
    assert thinned(few) is few or sum(len(g.segments) for g in few.groups) >= 2 * ENOUGH


def test_axes_that_are_excited_alone_keep_their_records(identified):
    """Of a single posture every second record would leave half of the joints at rest."""
    _, setup, _ = identified
    group = setup.problem.groups[0].pick(np.arange(6))
    alone = np.eye(6)[:, None] * group.Q
    problem = replace(setup.problem, groups=(replace(group, Q=alone),) * 3)
    assert thinned(problem).groups[0].segments == group.segments[::2]  # the next posture keeps the others
    rows = np.tile(np.arange(6), 3)
    posture = replace(problem, groups=(problem.groups[0].pick(rows),))
    assert thinned(posture) is posture


@pytest.mark.parametrize(
    ("without", "beside", "shows"),
    [
        ((2.0, 10.0), (2.0, 9.5), False),
        ((2.0, 10.0), (2.0, 5.0), True),
        ((2.0, 10.0), (1.2, 12.0), True),  # under weights that bear with more of it
        ((0.3, 10.0), (0.2, 9.5), False),  # where these bear with all of it they tell nothing
        ((0.3, 0.5), (0.3, 0.5), True),  # nor do any: no reason to give up
    ],
)
def test_strong_effects_go_on_where_softened_weights_see_them(without, beside, shows):
    """Costs over counts at the joint under two softened weights, without a strong effect and beside it."""
    stages, bare = (
        [SimpleNamespace(costs=np.array([100.0 * x]), counts=np.array([100.0])) for x in costs]
        for costs in (beside, without)
    )
    assert shows_softly(stages, bare, 0) is shows


def test_a_model_that_cannot_be_computed_from_the_guesses_has_none_to_compare_with(identified):
    _, setup, result = identified
    guesses = replace(setup.problem.nominal, stiffness=np.full(6, np.nan))
    assert without_strong(replace(setup.problem, nominal=guesses), replace(result, softer=())) == ()
