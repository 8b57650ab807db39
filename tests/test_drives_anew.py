"""Drives that a missing cause has led away begin again beside it."""

from dataclasses import replace

import numpy as np
import pytest

from ident.baseline import FAINT, implausible
from ident.parallel import Workers
from ident.problem import predictions
from ident.refits import reweighted, with_drives_anew
from ident.rounds import begun_anew


@pytest.fixture(scope="module")
def led_away(identified):
    """The problem, its fit, and that with a gear and a motor that cannot be those of the elbow."""
    _, setup, result = identified
    problem, par = setup.problem, result.model.par
    at = np.arange(6) == 2
    there = replace(par, stiffness=np.where(at, 0.1, 1.0) * par.stiffness, inertia=np.where(at, 0.3, 1.0) * par.inertia)
    return problem, result, reweighted(problem, replace(result, model=replace(result.model, par=there)), result.weights)


def test_drives_that_cannot_be_those_of_the_arm_begin_again(led_away):
    problem, result, away = led_away
    assert away.chi2_per_dof > FAINT and implausible(problem, away)
    again = with_drives_anew(problem, away)
    assert again.chi2_per_dof < 1.2
    assert again.model.par.stiffness == pytest.approx(result.model.par.stiffness, rel=0.01)
    assert len(predictions(problem, again.model, again.remainders)) == len(problem.groups)


def test_drives_that_leave_little_or_may_be_those_of_the_arm_stay(led_away, monkeypatch):
    problem, result, away = led_away
    assert with_drives_anew(problem, result) is result
    monkeypatch.setattr("ident.refits.implausible", lambda problem, result: False)
    assert with_drives_anew(problem, away) is away


def test_a_fit_that_comes_to_nothing_better_stays(led_away, monkeypatch):
    problem, _, away = led_away
    for found in (None, away):
        monkeypatch.setattr("ident.refits.refit", lambda *args, found=found: found)
        assert with_drives_anew(problem, away) is away


def test_candidates_are_ranked_by_what_they_come_to_then(led_away, monkeypatch):
    problem, result, away = led_away
    worse = replace(away, costs=2.0 * away.costs)
    monkeypatch.setattr("ident.rounds.last_is_pointless", lambda fit: False)
    monkeypatch.setattr("ident.rounds.with_drives_anew", lambda problem, fit: result if fit is worse else fit)
    ranked = begun_anew(problem, [("a", away), ("b", worse)], Workers())
    assert [name for name, _ in ranked] == ["b", "a"] and ranked[0][1] is result
    monkeypatch.setattr("ident.rounds.last_is_pointless", lambda fit: fit is result)
    assert [name for name, _ in begun_anew(problem, [("a", away), ("b", worse)], Workers())] == ["a", "b"]
    late = begun_anew(problem, [("a", away), ("b", worse)], Workers(deadline=0.0))
    assert [fit for _, fit in late] == [away, worse]
