"""Identification of drives that are off by up to a factor of two, from files."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.baseline import discrepancy_p_value, fit_baseline, implausible
from ident.chain import build_structure
from ident.coordinates import pack, unpack
from ident.costs import joint_costs
from ident.derivatives import jacobian
from ident.descent import SLIGHT
from ident.diagnosis import diagnose
from ident.estimate import ESTIMATORS, fit_frf
from ident.extended import predict
from ident.frf import estimate_frf
from ident.gain import segment_errors
from ident.graybox import Parameters, equilibrium, linearise, sampled_frf
from ident.held_out import with_held_out
from ident.hypotheses import catalogue
from ident.identification import identify, set_up
from ident.model import Effect, Model
from ident.problem import output_error, predictions
from ident.refits import reweighted
from ident.refuted import leave_one_out
from ident.screening import screen
from ident.torque_fit import fit
from ident.weights import make_weights
from robot_assets.robot import load_robot
from sim import parse_effect
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files

FIELDS = ("stiffness", "damping", "motor_inertia", "viscous_friction")


@pytest.fixture(scope="module")
def identified(identified):
    """What was set up, and the baseline."""
    return identified[1:]


def relative_errors(par, drives):
    truth = np.concatenate([drives[f] for f in FIELDS])
    return np.exp(par.to_log()) / truth - 1


def test_the_true_drives_are_found_with_honest_intervals(clean, identified):
    _, result = identified
    error = relative_errors(result.model.par, clean[1])
    std = np.sqrt(np.diag(result.covariance()))[:24]
    assert np.abs(error[:6]).max() < 0.005 and np.abs(error[12:18]).max() < 0.005
    assert np.abs(error[6:12]).max() < 0.05 and np.abs(error[18:]).max() < 0.05
    assert np.mean(np.abs(error) < 1.96 * std) >= 0.75
    assert 0.8 < result.chi2_per_dof < 1.25


def test_the_last_fit_is_under_the_noise_of_its_own_model(identified, monkeypatch):
    """Motors that begin at a tenth of their inertia pass on a tenth of the noise of the positions."""
    setup, right = identified
    problem = setup.problem
    par = replace(right.model.par, inertia=0.1 * right.model.par.inertia)
    lost = replace(right, model=replace(right.model, par=par), costs=1e6 * right.costs)
    monkeypatch.setattr("ident.baseline.anneal", lambda *args, **options: lost)
    found = fit_baseline(problem)
    own = make_weights(problem, predictions(problem, found.model, found.remainders), 0.0)
    assert reweighted(problem, found, own).costs == pytest.approx(found.costs, rel=0.02)
    assert found.model.par.inertia == pytest.approx(right.model.par.inertia, rel=0.01)


def test_held_out_data_are_predicted_to_the_noise(clean, identified):
    setup, result = identified
    for group in setup.held_out:
        pred = predict(result.model, group, setup.problem.sampling)
        e = group.observe(group.U - pred.U)
        share = np.sqrt(np.mean(np.abs(e) ** 2) / np.mean(np.abs(group.observe(group.U)[:, 1:]) ** 2))
        assert share < 0.02


@pytest.mark.slow
def test_a_held_out_segment_that_ran_away_tells_nothing(clean):
    """Its error would outweigh all others."""
    data = clean[0]
    lost = next(s.name for s in data.segments if s.role == "validation")
    segments = tuple(replace(s, tau=1e3 * s.tau) if s.name == lost else s for s in data.segments)
    setup, whole = set_up(replace(data, segments=segments)), set_up(data)
    assert setup.ran_away == (lost,) and not whole.ran_away
    told, all_of_them = ({n for g in x.held_out for n in g.segments} for x in (setup, whole))
    assert told == all_of_them - {lost} and told
    assert any(lost in note for note in diagnose(replace(data, segments=segments), max_causes=0).notes)


@pytest.mark.parametrize("kind", ["multisine", "trajectory"])
def test_held_out_data_change_nothing_of_what_is_fitted(kind):
    """Neither their noise, nor their band, nor steps of their encoder: of data whose noise is not given and does not
    show between periods."""
    robot = load_robot("twomass")
    plan = small_plan(robot, 3, points=1, levels=(10.0,), period=500, periods=2, trajectory=True)
    data = quick_experiment(plan, [], seed=3)
    told = tuple(s for s in data.segments if s.role == "identification") if kind == "multisine" else ()
    held_out = [s for s in data.segments if s.role == "validation"]
    if kind == "trajectory":
        told = tuple(replace(s, role="identification") for s in held_out if s.kind == kind)
    assert told and held_out

    def changed(s):
        rng = np.random.default_rng(0)
        lines = np.union1d(s.excited_lines, [200]) if s.kind == "multisine" else s.excited_lines
        q = np.round(s.q + 1e-4 * rng.normal(size=s.q.shape), 3)
        return replace(
            s, name=f"held-{s.name}", q=q, tau=5.0 * s.tau + rng.normal(size=s.tau.shape), excited_lines=lines
        )

    plain = replace(data, q_std=None, tau_std=None)
    a, b = (identify(replace(plain, segments=(*told, *more))) for more in ((), map(changed, held_out)))
    assert np.array_equal(a[0].problem.q_std, b[0].problem.q_std) and np.array_equal(
        a[0].problem.tau_std, b[0].problem.tau_std
    )
    assert [g.n_compared for g in a[0].problem.groups] == [g.n_compared for g in b[0].problem.groups]
    assert a[0].steps == b[0].steps and np.array_equal(pack(a[1].model), pack(b[1].model))


def test_what_rounding_leaves_of_records_without_noise_is_no_discrepancy():
    """Exact periods of the arm that is fitted, to the last digits but a few."""
    robot = load_robot("twomass")
    data = quick_experiment(
        small_plan(robot, 3, points=1, levels=(10.0,), period=500, periods=3), [], seed=3, noise=0.0
    )
    problem = set_up(data).problem
    preds = predictions(problem, Model(problem.structure, problem.nominal), [None] * len(problem.groups), steps=None)
    groups = []
    for g, p in zip(problem.groups, preds, strict=True):
        U = p.U * (1.0 + 1e-13 * np.random.default_rng(1).normal(size=p.U.shape))
        groups.append(replace(g, U=U, U_periods=U[:, None].repeat(2, 1), Q_periods=g.Q[:, None].repeat(2, 1)))
    exact = replace(problem, groups=tuple(groups))
    weights = make_weights(exact, preds, 0.0)
    assert np.sum(joint_costs(exact, preds, weights)) < 0.01 * exact.groups[0].n_compared


def test_nothing_hidden_nothing_named(clean):
    verdict = diagnose(clean[0])
    assert not verdict.discrepancy.detected and not verdict.causes
    assert verdict.unexplained_verdict == "noise floor reached"
    assert verdict.gain.after == verdict.gain.before


def test_the_p_value_is_that_of_chance(identified):
    assert discrepancy_p_value(identified[1]) > 1e-4 or identified[1].chi2_per_dof < 1.1


def test_measured_frfs_agree_with_the_true_arm(clean):
    data, drives = clean
    frf = estimate_frf(data)
    structure = build_structure(data.robot)
    par = Parameters.nominal(data.robot).with_log(np.log(np.concatenate([drives[f] for f in FIELDS])))
    for i in range(len(frf.operating_points)):
        lin = linearise(structure, equilibrium(structure, par, frf.q0[i]))
        G, _ = sampled_frf(structure, par, lin, frf.frequency, 1e-3, "zoh")
        error = np.abs(frf.G[i] - G) / np.abs(G).max(axis=(1, 2), keepdims=True)
        assert np.median(error) < 0.01


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_frf_estimator_finds_the_drives(clean, estimator):
    data, drives = clean
    result = fit_frf(
        build_structure(data.robot),
        estimate_frf(data),
        Parameters.nominal(data.robot),
        sample_time=1e-3,
        hold="zoh",
        estimator=estimator,
        starts=(Parameters.nominal(data.robot),),
    )
    error = np.abs(relative_errors(result.parameters, drives))
    limit = 0.02 if estimator in ("nls", "lls") else 0.005
    assert error[:6].max() < limit and error[12:18].max() < limit
    assert np.median(error) < 0.01


@pytest.mark.parametrize("estimator", ["h1", "jio", "ari", "har", "log"])
def test_the_five_averages_agree_on_quiet_data(clean, estimator):
    reference = estimate_frf(clean[0], estimator="ari")
    other = estimate_frf(clean[0], estimator=estimator)
    scale = np.abs(reference.G).max(axis=(2, 3), keepdims=True)
    assert np.median(np.abs(other.G - reference.G) / scale) < 0.01


@pytest.mark.slow
def test_a_ripple_that_is_fast_along_a_motion_does_not_fold_into_its_band(ur10):
    """The ripple passes at up to 40 Hz where the motion is compared below 3 Hz."""
    drives = draw_drives(np.random.default_rng(4), ur10)
    plan = small_plan(ur10, 4, points=1, levels=(1.0,), validation_points=0, trajectory=True)
    data = quick_experiment(
        plan,
        [parse_effect("cogging@elbow_joint:amplitude=4,periods_per_rev=606,phase=0.7", ur10)],
        seed=4,
        drives=drives,
    )
    setup = set_up(data)
    figures = {
        "stiffness": "stiffness",
        "damping": "damping",
        "inertia": "motor_inertia",
        "viscous": "viscous_friction",
    }
    par = replace(setup.problem.nominal, **{k: drives[v] for k, v in figures.items()})
    bare = Model(setup.problem.structure, par)
    (h,) = (h for h in catalogue(setup.problem.structure) if h.key == ("cogging", "elbow_joint"))
    values = {"sine": 4 * np.cos(0.7), "cosine": 4 * np.sin(0.7), "periods_per_rev": 606.0}
    rippled = replace(bare, effects=(Effect(h, np.array([values.get(q.name, 0.0) for q in h.parameters])),))
    (motion,) = (g for g in setup.held_out if g.window is not None)
    errors, _ = segment_errors(setup.problem, (motion,), bare, rippled)
    assert np.sqrt(errors.after[:, 2].mean()) < 0.2 * np.sqrt(errors.before[:, 2].mean())


def test_links_behind_gears_are_found_beside_elastic_hinges(tmp_path):
    """An arm with hinges has more link coordinates than joints: what pulls on a link sees the one that its joint
    drives."""
    irb = load_robot("irb")
    spring = parse_effect("gravity_spring@joint_2:stiffness=900,rest_angle=0.2", irb)
    data = quick_experiment(small_plan(irb, 3, levels=(0.5,), period=1000), [spring], seed=3)
    problem = set_up(through_files(data, tmp_path)).problem
    result = fit(problem, Model(problem.structure, problem.nominal))
    preds = predictions(problem, result.model, result.remainders)
    for pred in preds:
        motion = pred.motion()
        for j in range(irb.n):
            assert motion.q_link(j) == pytest.approx(motion.q(j) - motion.delta(j), abs=1e-4)
    best = screen(problem, result, preds, [h for h in catalogue(problem.structure) if h.effect == "gravity_spring"])[0]
    assert best.hypothesis.place == "joint_2"
    assert best.start[:2] == pytest.approx([900.0, 0.2], rel=0.1)


@pytest.fixture(scope="module")
def panda_problem(tmp_path_factory):
    panda = load_robot("panda")
    data = quick_experiment(small_plan(panda, 6, points=1, levels=(1.0,), validation_points=0), seed=6)
    return set_up(through_files(data, tmp_path_factory.mktemp("panda"))).problem


GEAR, LAG = ("hardening_stiffness", "panda_joint4"), ("torque_lag", "panda_joint4")


@pytest.mark.parametrize("keys", [(), (GEAR,), (GEAR, LAG), (("payload", "flange"),)])
def test_exact_columns_are_the_differences_of_what_a_model_predicts(panda_problem, keys):
    """Gears that give under gravity move the posture, and with it all torques of a motion: with the remainder held that
    is missed."""
    problem = panda_problem
    start = {
        "hardening_stiffness": [1e9],
        "torque_lag": [2e-3, 0.0],
        "payload": [2.0, 0.02, 0.0, 0.05, 0.01, 0.01, 0.01],
    }
    effects = tuple(Effect(h, np.array(start[h.effect])) for h in catalogue(problem.structure) if h.key in keys)
    model, group = Model(problem.structure, problem.nominal, effects), problem.groups[0]
    pred = predict(model, group, problem.sampling, steps=20)
    held, exact = (jacobian(problem, model, group, pred, exact=e).dense() for e in (False, True))
    x, n = pack(model), problem.structure.n
    missed, left = [], []
    steps = [(c, 1e-3) for c in range(2 * n)] + [(4 * n + 1, e.hypothesis.parameters[0].step) for e in effects[:1]]
    for c, step in steps:
        ends = []
        for sign in (1.0, -1.0):
            y = x.copy()
            y[c] += sign * step
            there = unpack(model, y, np.inf)
            ends.append(
                predict(there, group, problem.sampling, W=pred.solution.W, steps=20, torques=pred.solution.torques).U
            )
        slope = (ends[0] - ends[1])[:, : held.shape[1]] / (2 * step)
        for errors, columns in ((missed, held), (left, exact)):
            errors.append(np.linalg.norm(columns[..., c] - slope) / np.linalg.norm(slope))
    assert max(left) < 0.02 and max(left) < 0.2 * max(missed)


@pytest.mark.parametrize(
    ("key", "value", "exact"), [(GEAR, 1e9, True), (("coulomb_friction", "panda_joint4"), 0.5, False)]
)
def test_a_winner_beside_a_law_of_the_gear_is_fitted_by_exact_columns(panda_problem, key, value, exact):
    """And no other: the information that its deviations come from says which were used."""
    problem = panda_problem
    (h,) = (h for h in catalogue(problem.structure) if h.key == key)
    start = Model(
        problem.structure, problem.nominal, (Effect(h, np.array([value, 0.0, 1e-3, 0.0][: len(h.parameters)])),)
    )
    first = fit(problem, start, iterations=2)
    result = fit(problem, first.model, iterations=1, weights=first.weights, remainders=first.remainders, exact=True)
    preds = predictions(problem, result.model, result.remainders)
    of_columns = {}
    for e in (False, True):
        parts = [
            jacobian(problem, result.model, group, pred, exact=e).normal(weights, output_error(group, pred))[0]
            for group, pred, weights in zip(problem.groups, preds, result.weights.whiten, strict=True)
        ]
        of_columns[e] = sum(parts)
    size = np.sqrt(np.diag(result.information))
    off = {e: np.abs((result.information - H) / np.outer(size, size)).max() for e, H in of_columns.items()}
    assert off[exact] < 1e-3 < off[not exact]


def test_columns_beside_a_loop_serve_as_long_as_they_foretell_the_cost(panda_problem, monkeypatch):
    """Fewer of them lead to where new ones in every step lead; what has no loop gets new ones in every step."""
    problem, calls = panda_problem, []
    monkeypatch.setattr("ident.derivatives.jacobian", lambda *a, **k: calls.append(1) or jacobian(*a, **k))

    def fitted(key, value):
        (h,) = (h for h in catalogue(problem.structure) if h.key == key)
        calls.clear()
        result = fit(problem, Model(problem.structure, problem.nominal, (Effect(h, np.array(value)),)), iterations=20)
        return result, len(calls) / len(problem.groups)

    (kept, some), (_, plain) = fitted(GEAR, [1e9]), fitted(LAG, [2e-3, 0.0])
    monkeypatch.setattr("ident.torque_fit.SLIGHT", 0.0)
    monkeypatch.setattr("ident.descent.SLIGHT", 0.0)
    monkeypatch.setattr("ident.torque_fit.FORETOLD", 0.0)
    fresh, every = fitted(GEAR, [1e9])
    assert some < 0.8 * every
    assert kept.cost - fresh.cost < SLIGHT
    assert fitted(LAG, [2e-3, 0.0])[1] == plain


def test_the_baseline_is_weighted_by_the_noise_that_it_sees_itself(identified):
    """Costs under weights of a model on the way are those of another noise."""
    setup, result = identified[-2:]
    preds = predictions(setup.problem, result.model, result.remainders)
    own = joint_costs(setup.problem, preds, make_weights(setup.problem, preds, 0.0))
    assert joint_costs(setup.problem, preds, result.weights) == pytest.approx(own, rel=0.01)


def test_a_common_offset_in_time_is_a_delay_where_there_is_one_joint(clean):
    """That of its drive or its sensor, if the torque is held; where nothing is said of the hold half a sample may be
    due to that."""
    robot = load_robot("twomass")
    data = quick_experiment(small_plan(robot, 4, period=500), seed=4)
    assert data.input_hold == clean[0].input_hold == "zoh"
    assert not set_up(data).problem.free_timing
    assert set_up(replace(data, input_hold="none")).problem.free_timing and set_up(clean[0]).problem.free_timing


def test_what_is_left_out_is_a_posture_with_all_its_records(identified):
    """Records of one posture may differ in their periods, and are groups of their own."""
    setup, baseline = identified
    problem, found = setup.problem, SimpleNamespace(final=baseline)
    errors = leave_one_out(setup, problem.nominal, baseline, found, False)
    assert errors.segments == tuple(name for g in problem.groups for name in g.segments)
    one = replace(problem, groups=tuple(replace(g, operating_point="op01") for g in problem.groups))
    assert len(one.groups) > 1
    assert leave_one_out(replace(setup, problem=one), problem.nominal, baseline, found, False) is None


def test_the_end_of_a_motion_is_held_out_where_it_is_the_only_one_to_fit(clean):
    motion = next(s for s in clean[0].segments if s.kind == "trajectory")
    for role, names in (("identification", ["motion", "motion-end"]), ("validation", ["motion"])):
        alone = replace(clean[0], segments=(replace(motion, name="motion", role=role),))
        assert [s.name for s in with_held_out(alone).segments] == names


@pytest.mark.parametrize(("factor", "guessed", "expected"), [
    (2.0, False, False),
    (6.0, False, True),
    (6.0, True, False),  # the bodies tell a drive only so well
    (40.0, True, True),
])  # fmt: skip
def test_drives_are_implausible_far_from_what_is_known_of_them(identified, factor, guessed, expected):
    setup, result = identified
    problem, at = setup.problem, setup.problem.structure.robot.joint_names
    robot = replace(problem.structure.robot, guessed={"stiffness": at * guessed, "motor_inertia": ()})
    nominal = replace(problem.nominal, inertia=result.model.par.inertia * factor)
    known = replace(problem, structure=replace(problem.structure, robot=robot), nominal=nominal)
    assert implausible(known, result) == expected
