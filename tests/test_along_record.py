"""Laws of the gear along the recorded torque: the linear limit, the laws themselves, and a gear that rattles."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.coordinates import pack, unpack
from ident.costs import joint_costs
from ident.derivatives import jacobian
from ident.extended import predict
from ident.follow_up import as_loops, from_other_motions
from ident.hypotheses import catalogue, kernels
from ident.hypotheses.yielding import elastoplastic
from ident.identification import set_up
from ident.model import Effect, Model, along_record, has_rough_law, is_along_record, joints_along_record
from ident.parallel import Workers
from ident.problem import predictions
from ident.strong import simulated
from ident.torque_fit import fit
from ident.weights import make_weights
from robot_assets.robot import load_robot
from sim import parse_effect
from tests.conftest import over_steps, quick_experiment, small_plan, through_files

pytestmark = pytest.mark.xdist_group("along_record")  # one worker makes what they share

LAWS = {
    kernels.CUBIC: (2e6, 0.0),
    kernels.BACKLASH: (3e-3, 0.0),
    kernels.SOFTENING: (2e3, 2e-3),
    kernels.HYSTERESIS: (4e3, 5.0),
}
STIFFNESS = 1e4


@pytest.fixture(scope="module")
def rattling(tmp_path_factory):
    """(problem, true model without the gap, hypothesis, gap): an axis without gravity in a dead band."""
    ur10, gap = load_robot("ur10"), 8e-4
    plan = small_plan(ur10, 4)
    data = quick_experiment(plan, [parse_effect(f"backlash@shoulder_pan_joint:gap={gap}", ur10)], seed=4)
    problem = set_up(through_files(data, tmp_path_factory.mktemp("rattling"))).problem
    backlash = next(h for h in catalogue(problem.structure) if h.key == ("backlash", "shoulder_pan_joint"))
    return problem, Model(problem.structure, problem.nominal), backlash, gap


def cost_of(problem, model):
    preds = predictions(problem, model, [None] * len(problem.groups), None)
    return joint_costs(problem, preds, make_weights(problem, preds, 0.0)), preds


@pytest.mark.parametrize("code", LAWS)
@given(st.integers(0, 2**31), st.floats(-30.0, 30.0), st.floats(1e-4, 1e-2))
@settings(max_examples=30, deadline=None)
def test_the_mean_torque_is_met_and_the_law_is_the_law(code, seed, mean, size):
    """Mean of ``k x + h`` is what was asked; without memory ``h`` follows from ``k x + h`` by the law's own form."""
    a, b = LAWS[code]
    rng, k = np.random.default_rng(seed), STIFFNESS
    law = kernels.Law(code, a, b, k)
    x = np.fft.irfft(np.r_[0.0, rng.normal(size=5) + 1j * rng.normal(size=5)], 400)[None]
    x *= size / np.abs(x).max()
    h = kernels.along_deflection(*law.shape, x, np.array([mean]), 60)
    # The offset is the one at which the law gives this torque: here found again from the law at a point.
    low, high = -1.0, 1.0
    for _ in range(80):
        offset = 0.5 * (low + high)
        there = kernels.along_deflection(*law.shape, x + offset, np.array([0.0]), 0)
        low, high = (low, offset) if np.mean(k * (x + offset) + there) > mean else (offset, high)
    assert h == pytest.approx(there, abs=1e-6 * k * size + 1e-6)
    if code == kernels.BACKLASH:
        assert np.mean(k * (x + offset) + h) == pytest.approx(mean, abs=1e-6) or np.abs(x + offset).max() <= 0.5 * a
    if code in (kernels.BACKLASH, kernels.SOFTENING):
        slope, half = (-k, 0.5 * a) if code == kernels.BACKLASH else (a - k, b)
        expected = over_steps(lambda x: slope * np.clip(x + offset, -half, half), x)
        assert h == pytest.approx(expected, abs=kernels.RESOLVED * abs(slope) * half + 1e-5)
    if code == kernels.HYSTERESIS:
        assert h == pytest.approx(elastoplastic(x + offset, a, b), abs=1e-6)
    if code == kernels.CUBIC:
        assert h == pytest.approx(a * (x + offset) ** 3, abs=1e-6)


@pytest.mark.slow
def test_a_law_that_is_nothing_leaves_what_the_loop_leaves(clean):
    """The residual along the record is that of the linear gear where the dead band has no width, but for the geometry
    along a slightly other motion of the links."""
    data, drives = clean
    problem = set_up(data).problem
    names = {"stiffness": "stiffness", "damping": "damping", "inertia": "motor_inertia", "viscous": "viscous_friction"}
    model = Model(problem.structure, replace(problem.nominal, **{k: drives[v] for k, v in names.items()}))
    backlash = next(h for h in catalogue(problem.structure) if h.key == ("backlash", "shoulder_pan_joint"))
    nothing = Effect(backlash, np.array([1e-9, 0.0]))
    (_, loop), (_, along) = (
        cost_of(problem, replace(model, effects=(replace(nothing, hypothesis=h),)))
        for h in (backlash, along_record(backlash))
    )
    for a, b, group in zip(loop, along, problem.groups, strict=True):
        if group.window is None:
            left = [(group.U - x.U)[:, 1 : group.n_compared, 0] for x in (a, b)]
            assert np.linalg.norm(left[0] - left[1]) < 0.05 * np.linalg.norm(left[0])


@pytest.mark.slow
def test_a_gear_that_rattles_is_explained_along_its_record_alone(rattling):
    """At the true parameters the loop ends in other steady states than the recording; the width is found along it."""
    problem, model, backlash, gap = rattling
    along, count = along_record(backlash), sum(g.n_compared * 2 * len(g.segments) for g in problem.groups)
    of_loop, of_record = (
        cost_of(problem, replace(model, effects=(Effect(h, np.array([gap, 0.0])),)))[0] for h in (backlash, along)
    )
    assert of_record.max() < 5.0 * count and of_loop[0] > 1e3 * count
    start = replace(model, effects=(Effect(along, np.array([0.7 * gap, 0.0])),))
    result = fit(problem, start, iterations=15)
    assert result.model.effects[0].p[0] == pytest.approx(gap, rel=0.02)
    kept, _ = simulated(problem, along, result)
    assert is_along_record(kept)


def test_the_deflection_along_a_record_is_found_beside_a_strong_damper(rattling, monkeypatch):
    """At high frequency the damper is stiffer than the spring; ten times as many steps hardly change it."""
    problem, model, backlash, gap = rattling
    par = replace(model.par, damping=30.0 * model.par.damping)
    group = problem.groups[0]
    assert group.omega[-1] * par.damping[0] > 2.0 * par.stiffness[0]
    model = replace(model, par=par, effects=(Effect(along_record(backlash), np.array([gap, 0.0])),))
    few = predict(model, group, problem.sampling).outputs()[..., 0]
    monkeypatch.setattr("ident.reactions.RECORD_STEPS", 200)
    many = predict(model, group, problem.sampling).outputs()[..., 0]
    assert np.linalg.norm(few - many) < 0.02 * np.linalg.norm(many)


def test_columns_beside_a_gear_along_its_record_are_the_differences(rattling):
    """Of the gear, its motor, the timing and friction at the same joint, whose torque the record holds already."""
    problem, model, backlash, gap = rattling
    friction = next(h for h in catalogue(problem.structure) if h.key == ("coulomb_friction", "shoulder_pan_joint"))
    effects = (Effect(along_record(backlash), np.array([gap, 0.0])), Effect(friction, np.array([2.0, 0.1, 5e-3, 0.0])))
    model, group, n = replace(model, effects=effects), problem.groups[0], problem.structure.n
    pred = predict(model, group, problem.sampling)
    J, x = jacobian(problem, model, group, pred).dense(), pack(model)
    m = len(model.par.to_log())
    for c, step in ((0, 1e-4), (n, 1e-4), (2 * n, 1e-5), (3 * n, 1e-4), (m, 1e-6), (m + 1, 1e-4), (m + 3, 1e-4)):
        ends = []
        for sign in (1.0, -1.0):
            y = x.copy()
            y[c] += sign * step
            ends.append(predict(unpack(model, y, np.inf), group, problem.sampling, W=pred.solution.W).U)
        slope = (ends[0] - ends[1])[:, : J.shape[1]] / (2 * step)
        assert np.linalg.norm(J[..., c] - slope) < 0.1 * np.linalg.norm(slope), c


def test_a_drive_with_an_effect_is_predicted_by_the_loop(rattling):
    """Its record is not the torque of the motor; that of another joint does not matter."""
    problem, model, backlash, gap = rattling
    named = {h.key: h for h in catalogue(problem.structure)}
    along = Effect(along_record(backlash), np.array([gap, 0.0]))
    for joint, expected in (("shoulder_pan_joint", set()), ("elbow_joint", {0})):
        constant = Effect(named["torque_constant", joint], np.array([0.9]))
        assert joints_along_record(replace(model, effects=(along, constant)), problem.groups[0]) == expected


@pytest.mark.slow
@pytest.mark.parametrize("cubic", [2e8, 4e9])
def test_a_gear_with_one_steady_motion_ends_as_a_loop(tmp_path, cubic):
    """A hardening spring is simulated in the end, one that bends its resonance over too."""
    ur10 = load_robot("ur10")
    hidden = [parse_effect(f"hardening_stiffness@elbow_joint:cubic={cubic}", ur10)]
    problem = set_up(through_files(quick_experiment(small_plan(ur10, 8), hidden, seed=8), tmp_path)).problem
    h = along_record(next(h for h in catalogue(problem.structure) if h.key == ("hardening_stiffness", "elbow_joint")))
    start = Model(problem.structure, problem.nominal, (Effect(h, np.array([0.7 * cubic])),))
    along = fit(problem, start, iterations=15)
    found, result = simulated(problem, h, along)
    assert not is_along_record(found)
    assert result.model.effects[0].p[0] == pytest.approx(cubic, rel=0.01)
    assert result.chi2_per_dof < 1.1
    # From a size that the noise along the record has blurred, too.
    far = replace(along, model=replace(along.model, effects=(Effect(h, np.array([0.6 * cubic])),)))
    (law,) = as_loops(problem, far, Workers()).model.effects
    assert not is_along_record(law.hypothesis) and law.p[0] == pytest.approx(cubic, rel=0.01)


def test_a_law_is_begun_from_other_sizes_where_it_leaves_more_than_noise(identified, monkeypatch):
    """Between two sizes at which a record changes to another motion the cost has a minimum each: the best of them
    stays."""
    _, setup, result = identified
    problem, k = setup.problem, setup.problem.nominal.stiffness[2]
    h = next(h for h in catalogue(problem.structure) if h.key == ("softening_stiffness", "elbow_joint"))
    par = replace(result.model.par, stiffness=problem.nominal.stiffness)
    model = replace(result.model, par=par, effects=(Effect(h, np.array([0.7 * k, 1e-4])),))
    tried = []

    def fitted(problem, model, weights, remainders):
        tried.append(model.effects[0].p)
        return replace(result, model=model, costs=result.counts * (1.2 if model.effects[0].p[1] > 1e-4 else 1.0))

    monkeypatch.setattr("ident.follow_up.refit", fitted)
    monkeypatch.setattr("ident.follow_up.polish", lambda problem, found: found)
    quiet, loud = (replace(result, model=model, costs=x * result.counts) for x in (1.05, 1.5))
    assert from_other_motions(problem, quiet, Workers()) is quiet and not tried
    found = from_other_motions(problem, loud, Workers())
    assert len(tried) == 2 and found.model.effects[0].p[1] < 1e-4 and found.cost < loud.cost
    # What the gear carries less beyond the transition is the same in all of them.
    assert [(k - low) * b for low, b in tried] == pytest.approx([0.3 * k * 1e-4] * 2, rel=1e-9)
    along = replace(loud, model=replace(model, effects=(Effect(along_record(h), model.effects[0].p),)))
    assert from_other_motions(problem, along, Workers()) is along


def test_a_law_is_rough_along_the_record_or_with_several_steady_motions(identified):
    _, setup, result = identified
    named = {h.key: h for h in catalogue(setup.problem.structure)}
    for effect, p, rough in (("backlash", [1e-4, 0.0], True), ("hysteresis", [1e3, 1.0, 5.0, 0.0], False)):
        h = named[effect, "elbow_joint"]
        assert has_rough_law(replace(result.model, effects=(Effect(h, np.array(p)),))) is rough
        assert has_rough_law(replace(result.model, effects=(Effect(along_record(h), np.array(p)),)))
