"""Changes of the chain that are sought together with the drives."""

from dataclasses import replace

import numpy as np
import pytest

from ident.afresh import sought_afresh, starts
from ident.hypotheses import catalogue
from ident.identification import set_up
from ident.model import Model
from ident.parallel import Workers
from ident.torque_fit import anneal
from sim import parse_effect
from tests.conftest import quick_experiment, small_plan, through_files

MASS, COM = 15.0, (0.05, 0.1, 0.1)


@pytest.fixture(scope="module")
def loaded(ur10, tmp_path_factory):
    """Records of an arm with a heavy payload, and a problem whose drives are off by up to a factor of two."""
    hidden = parse_effect(f"payload@flange:mass={MASS},com_x={COM[0]},com_y={COM[1]},com_z={COM[2]}", ur10)
    data = quick_experiment(small_plan(ur10, 6, levels=(1.0,), period=1000), [hidden], seed=6)
    problem = set_up(through_files(data, tmp_path_factory.mktemp("loaded"))).problem
    rng, par = np.random.default_rng(3), problem.nominal
    off = {f: getattr(par, f) * 2.0 ** rng.uniform(-1.0, 1.0, 6) for f in ("stiffness", "inertia", "damping")}
    problem = replace(problem, nominal=replace(par, **off))
    return problem, anneal(problem, Model(problem.structure, problem.nominal)), catalogue(problem.structure)


def test_a_heavy_payload_is_found_with_drives_that_are_off(loaded):
    problem, result, hypotheses = loaded
    asked = [h for h in hypotheses if h.effect == "payload" or h.key == ("link_inertia", "upper_arm_link")]
    told = []
    found = sought_afresh(problem, result, asked, Workers(progress=told.append))
    assert [h.effect for h, _ in found] == ["payload"]
    assert found[0][1].model.effects[-1].p[:4] == pytest.approx([MASS, *COM], rel=0.02, abs=2e-3)
    assert found[0][1].chi2_per_dof < 2.0
    assert told == [
        "afresh: payload at flange",
        "afresh: link_inertia at upper_arm_link",
        "from there: payload at flange",
    ]


def test_nothing_is_fitted_where_no_change_tells(identified):
    _, setup, result = identified
    asked = [h for h in catalogue(setup.problem.structure) if h.effect == "payload"]
    assert sought_afresh(setup.problem, result, asked, Workers()) == []


def test_changes_begin_as_described_or_within_the_band(loaded):
    problem, _, hypotheses = loaded
    for h in hypotheses:
        if h.effect == "link_inertia":
            assert [p.tolist() for p in starts(problem, h)] == [[1.0, 0.0, 0.0, 0.0, 1.0]]
        elif h.effect == "payload":
            (p,) = starts(problem, h)
            assert 0.1 < p[0] < 5.0 and not p[1:4].any()
        elif h.effect == "base_elasticity":
            high, low = starts(problem, h)
            assert low[0] < 0.2 * high[0]
