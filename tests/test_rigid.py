"""Inertias of the links from motions: the regressor, consistency, and links that differ from their description."""

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.attribute import Attribution, attribute
from ident.chain import LinkChange, build_structure
from ident.dataset import Dataset, Segment
from ident.diagnosis import diagnose_fully
from ident.extended import predict
from ident.graybox import Parameters
from ident.held_out import with_held_out
from ident.hypotheses import catalogue
from ident.hypotheses.sensing import torque_offset
from ident.identification import identify, set_up
from ident.model import Effect, Model
from ident.parallel import Workers
from ident.position_lines import wave_numbers
from ident.problem import predictions
from ident.pruning import plainer
from ident.recursion import chain_of
from ident.rigid import _from_pseudo, _inertias, _pseudo, _root, carried_over, fit_rigid, regressor
from ident.rounds import left_share
from ident.seek import Sought, foretold, unresolved, with_inertias, worth_it
from ident.torque_fit import fit
from ident.trust import too_fast
from robot_assets.robot import Elasticity, load_robot
from sim import parse_effect
from sim.experiment import draw_drives
from tests.conftest import of_motions, quick_experiment, small_plan, through_files, through_postures

pytestmark = pytest.mark.xdist_group("rigid")  # one worker makes what they share

RATE = 250.0
CHANGED = {
    "forearm_link": LinkChange(1.4, (0.02, -0.01, 0.03), 1.3),
    "wrist_3_link": LinkChange(4.0, (0.0, 0.01, 0.04), 3.0),
}
COULOMB, OFFSET = np.array([8.0, 9.0, 5.0, 1.0, 0.8, 0.5]), np.array([0.5, -2.0, 1.0, 0.2, -0.1, 0.05])


def rigid_motion(robot, seed, seconds=20.0):
    """A recorded motion of a rigid arm whose links are not as described; torques by Pinocchio."""
    rng = np.random.default_rng(seed)
    t, q, v, acc = through_postures(rng, robot.n, RATE, seconds)
    structure, par = build_structure(robot, links=CHANGED), Parameters.nominal(robot)
    data = structure.model.createData()
    tau = np.array([pin.rnea(structure.model, data, *x) for x in zip(q, v, acc, strict=True)])
    tau += par.inertia * acc + 1.5 * par.viscous * v + COULOMB * np.sign(v) + OFFSET
    return t, q, tau + 0.02 * rng.normal(size=tau.shape)


def dataset_of(robot, *segments):
    return of_motions(robot, RATE, segments, q_std=1e-7, tau_std=0.02)


@pytest.fixture(scope="module")
def moved(ur10):
    segments = []
    for i, role in enumerate(("identification", "identification", "validation")):
        t, q, tau = rigid_motion(ur10, i)
        segments.append(Segment(name=f"m{i}", role=role, kind="trajectory", t=t, tau=tau, q=q))
    return dataset_of(ur10, *segments)


def test_the_regressor_is_that_of_pinocchio(ur10):
    model = build_structure(ur10).model
    q, v, a = np.random.default_rng(0).normal(size=(3, 20, 6))
    ours = regressor(chain_of(model), q, v, a, range(6))
    data = model.createData()
    theirs = np.array([pin.computeJointTorqueRegressor(model, data, *x) for x in zip(q, v, a, strict=True)])
    assert np.allclose(ours, theirs, atol=1e-9 * np.abs(theirs).max())


def test_pseudo_inertias_hold_the_ten_parameters(ur10):
    for body in list(build_structure(ur10).model.inertias)[1:]:
        p = body.toDynamicParameters()
        assert np.allclose(_from_pseudo(_pseudo(p)), p)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-2.0, 2.0), min_size=10, max_size=10))
def test_every_coordinate_is_a_body_that_can_be(x):
    box = pin.Inertia.FromBox(3.0, 0.1, 0.2, 0.4)
    root = _root(pin.Inertia(3.0, np.array([0.1, 0.0, 0.2]), box.inertia).toDynamicParameters())
    p, slope = _inertias(root[None], np.array(x))
    moments = np.linalg.eigvalsh(_pseudo(p[0]))
    assert p[0, 0] > 0 and moments[0] > -1e-12 * moments[-1]
    steps = 1e-6 * np.eye(10)
    change = [
        (_inertias(root[None], np.array(x) + e)[0] - _inertias(root[None], np.array(x) - e)[0])[0] / 2e-6 for e in steps
    ]
    assert np.allclose(slope[0], np.array(change).T, atol=1e-5 * max(1.0, np.abs(p).max()))


def test_links_that_are_not_as_described_are_found(moved, ur10):
    problem = set_up(moved).problem
    found = fit_rigid(problem.structure, problem.nominal, problem.groups)
    assert np.all(found.left < 0.03 * np.array([g.U.std() for g in problem.groups]).max())
    # What the motions show is the torque along other motions, not each inertia by itself.
    truth = build_structure(ur10, links=CHANGED)
    q, v, a = np.random.default_rng(9).normal(size=(3, 200, 6))
    torques = []
    for structure in (build_structure(ur10), found.structure, truth):
        data = structure.model.createData()
        torques.append(np.array([pin.rnea(structure.model, data, *x) for x in zip(q, v, a, strict=True)]))
    described, fitted, true = torques
    true, fitted, described = (
        x + p * a
        for x, p in ((true, problem.nominal.inertia), (fitted, found.par.inertia), (described, problem.nominal.inertia))
    )
    error, gap = (np.sqrt(np.mean((x - true) ** 2, axis=0)) for x in (fitted, described))
    assert np.all(error[1:] < 0.1 * gap[1:])


def test_inertias_that_foretell_what_was_left_out_are_told_from_those_that_only_fit(moved, ur10):
    """Bodies as they are not, and as they are, along motions of 20 s; and torque that has another cause along 4 s."""

    def ratio(structure, problem, groups):
        return carried_over(structure, problem.nominal, groups)

    problem = set_up(moved).problem
    assert ratio(problem.structure, problem, problem.groups) < 0.1
    true = build_structure(ur10, links=CHANGED)
    assert ratio(true, problem, problem.groups[:1]) > 0.9
    t, q, tau = (x[:1000] for x in rigid_motion(ur10, 5))
    ripple = 3.0 * np.sin(40.0 * q + np.arange(6))
    short = dataset_of(ur10, Segment(name="m", role="identification", kind="trajectory", t=t, tau=tau + ripple, q=q))
    problem = set_up(short).problem
    assert ratio(true, problem, problem.groups) > 0.9


def test_a_hinge_across_a_joint_keeps_the_inertia_that_was_found(ur10):
    own = build_structure(ur10)
    heavy = {
        n: pin.Inertia(2 * own.model.inertias[i].mass, own.model.inertias[i].lever, own.model.inertias[i].inertia)
        for n, i in own.carriers.items()
    }
    hinge = Elasticity("bend", "elbow_joint", (1.0, 0.0, 0.0), 1e5, 10.0)
    masses = [
        sum(x.mass for x in list(build_structure(ur10, elasticities=h, inertias=heavy).model.inertias)[1:])
        for h in ((), (hinge,))
    ]
    assert masses == pytest.approx([2 * sum(x.mass for x in list(own.model.inertias)[1:])] * 2)


def test_links_as_described_stay_as_they_are(ur10):
    """Where one joint moves alone the rest of the arm is not shown."""
    t, q, _ = rigid_motion(ur10, 3)
    q = np.tile(q[:1], (len(t), 1))
    q[:, 0] += 0.3 * np.sin(t)
    acc = np.zeros_like(q)
    acc[:, 0] = -0.3 * np.sin(t)
    v = np.zeros_like(q)
    v[:, 0] = 0.3 * np.cos(t)
    structure, par = build_structure(ur10), Parameters.nominal(ur10)
    data = structure.model.createData()
    tau = (
        np.array([pin.rnea(structure.model, data, *x) for x in zip(q, v, acc, strict=True)])
        + par.inertia * acc
        + par.viscous * v
    )
    problem = set_up(
        dataset_of(ur10, Segment(name="m", role="identification", kind="trajectory", t=t, tau=tau, q=q))
    ).problem
    found = fit_rigid(problem.structure, problem.nominal, problem.groups)
    for i in range(1, 7):
        assert found.structure.model.inertias[i].mass == pytest.approx(structure.model.inertias[i].mass, rel=0.05)


def test_the_end_of_a_single_motion_is_held_out(ur10):
    t, q, tau = rigid_motion(ur10, 4)
    one = dataset_of(ur10, Segment(name="m", role="identification", kind="trajectory", t=t, tau=tau, q=q))
    first, end = with_held_out(one).segments
    assert (first.role, end.role) == ("identification", "validation")
    assert np.array_equal(np.concatenate([first.q, end.q]), q) and np.array_equal(np.concatenate([first.t, end.t]), t)
    assert end.n_samples == pytest.approx(len(t) / 3, abs=1)
    short = dataset_of(
        ur10, Segment(name="m", role="identification", kind="trajectory", t=t[:900], tau=tau[:900], q=q[:900])
    )
    assert with_held_out(short) is short


@pytest.mark.slow
def test_friction_is_named_beside_links_that_differ_from_their_description(moved, tmp_path):
    """One round: without the inertias of the links friction would be judged beside wrong torques."""
    result = diagnose_fully(through_files(moved, tmp_path), max_causes=1)
    verdict = result.verdict
    named = {c.joint: c for c in verdict.causes if c.effect == "coulomb_friction" and c.probability > 0.5}
    assert set(named) == set(result.joints)
    for joint, torque, offset in zip(result.joints, COULOMB, OFFSET, strict=True):
        assert named[joint].parameters["torque"].value == pytest.approx(torque, rel=0.05)
        constant = (
            verdict.baseline[f"torque_offset.{joint}"].value + torque * named[joint].parameters["asymmetry"].value
        )
        assert constant == pytest.approx(offset, abs=0.1 + 0.02 * torque)
    assert verdict.gain.gap_closed > 0.95
    assert "inertias of 6 links" in verdict.notes[0] and verdict.baseline["mass.elbow_joint"].unit == "kg"
    assert set(result.inertias) and result.inertias["wrist_3_joint"].mass > 0


@pytest.mark.parametrize(("left", "sought"), [(0.5, True), (2.0, False)])
def test_inertias_that_do_worse_than_the_description_are_left_at_once(moved, monkeypatch, left, sought):
    """Where the first model with them leaves more than that without, causes are not sought beside them."""
    setup, first = identify(moved)
    found = Attribution(first, True, True, 0.0, (), first, True)
    worse = replace(first, costs=left * first.costs)
    asked = []
    monkeypatch.setattr("ident.seek.fit_baseline", lambda *args: worse)
    monkeypatch.setattr("ident.seek.attribute", lambda *args, **kwargs: asked.append(args[1]) or found)
    before = Sought(setup, setup.problem.groups, first, found, setup.problem.nominal)
    assert with_inertias(before, 1, Workers()) == before
    assert asked == [worse] * sought


@pytest.mark.parametrize(
    ("left", "left_out", "kept"),
    [
        (0.5, (0.0, np.inf), True),  # too short to leave anything out
        (0.8, (0.0, np.inf), False),
        (0.8, (0.6, 0.9), True),  # parts left out are surely better with them
        (0.8, (0.6, 1.1), False),
        (0.5, (0.6, 1.1), True),
        (0.5, (1.1, 1.3), False),  # surely worse
        (1.1, (0.6, 0.9), True),
        (1.1, (0.6, 1.1), False),
    ],
)
def test_inertias_are_kept_by_what_they_leave_of_motions_fitted_and_of_parts_left_out(left, left_out, kept):
    assert worth_it(left, left_out) is kept


@pytest.mark.parametrize(
    ("left", "unknown", "asked"), [(2e5, False, True), (40.0, False, False), (1.5, False, False), (1.5, True, True)]
)
def test_links_are_doubted_where_much_is_left(left, unknown, asked):
    """Over noise and over a discrepancy of a million times that: laws of causes have errors."""
    counts = np.full(2, 100.0)
    first, last = (
        SimpleNamespace(costs=x * counts, counts=counts, cost=2e2 * x, count=200.0, chi2_per_dof=x) for x in (1e6, left)
    )
    found = SimpleNamespace(
        baseline=first, final=last, detected=True, unknown=unknown, left_share=left_share(first, last)
    )
    assert unresolved(found) is asked


def test_parts_of_the_motions_that_are_left_out_say_whether_inertias_found_foretell(moved, ur10):
    """Bodies as they are found against bodies as described, which here they are not."""
    setup, first = identify(moved)
    structure = build_structure(ur10, links=CHANGED)
    right = replace(first, model=replace(first.model, structure=structure))
    least, most = foretold(setup.problem, first, right, Workers())
    assert 0.0 < least < most < 1.0  # friction is left to both


@pytest.mark.slow
def test_a_long_search_leaves_time_for_one_beside_inertias_found(moved, monkeypatch):
    ends = []

    def spied(*args, workers, **kwargs):
        ends.append(workers.deadline - began)
        return attribute(*args, workers=workers, **kwargs)

    monkeypatch.setattr("ident.seek.attribute", spied)
    began = time.monotonic()
    diagnose_fully(moved, max_causes=0, max_seconds=1000.0)
    assert ends == [pytest.approx(500.0, abs=20.0), pytest.approx(1000.0, abs=1.0)]


@pytest.mark.slow
def test_a_payload_in_motions_alone_is_still_named(ur10, tmp_path):
    """Freed inertias would hide it: they are asked only where the catalogue leaves much.

    Beside it the noise is far less than was guessed: sought anew beside that noise it would not be found.
    """
    hidden = parse_effect("payload@flange:mass=4,com_x=0.02,com_y=0.03,com_z=0.1", ur10)
    drives = draw_drives(np.random.default_rng(2), ur10)
    plans = [replace(small_plan(ur10, seed, points=1, trajectory=True), experiments=()) for seed in (21, 22)]
    parts = [
        quick_experiment(plan, [hidden], seed=seed, drives=drives) for plan, seed in zip(plans, (21, 22), strict=True)
    ]
    roles = ("identification", "validation")
    motions = [replace(d.segments[0], name=f"m{i}", role=r) for i, (d, r) in enumerate(zip(parts, roles, strict=True))]
    data = replace(parts[0], segments=tuple(motions))
    verdict = diagnose_fully(through_files(data, tmp_path)).verdict
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [("payload", "flange")]
    assert not verdict.notes


def test_friction_whose_yielding_no_motion_shows_is_plain_friction(ur10, moved):
    """Samples far apart do not show how a bristle yields that slips within a thousandth of them."""
    problem = set_up(moved).problem
    problem = replace(problem, structure=build_structure(ur10, links=CHANGED))
    known = catalogue(problem.structure)
    of = {h.key: h for h in known}
    bristles = tuple(
        Effect(of["presliding_friction", name], np.array([1e8, torque, 1.0, 0.0]))
        for name, torque in zip(ur10.joint_names, COULOMB, strict=True)
    )
    offsets = tuple(Effect(torque_offset(j, name), OFFSET[j : j + 1]) for j, name in enumerate(ur10.joint_names))
    fitted = fit(problem, Model(problem.structure, problem.nominal, (*offsets, *bristles)), iterations=20)
    found = plainer(problem, fitted, known, set())
    named = found.model.effects[len(offsets) :]
    assert {e.hypothesis.effect for e in named} == {"coulomb_friction"} and len(named) == ur10.n
    assert [e.value("torque") for e in named] == pytest.approx(COULOMB, rel=0.05)
    assert plainer(problem, fitted, known, {e.hypothesis.key for e in bristles}) is fitted


def test_a_ripple_that_a_motion_runs_over_is_not_trusted(moved):
    """Where the motion is faster than the compared band can follow, all but a turn or two of a ripple is out of it."""
    problem = set_up(moved).problem
    of = {h.key: h for h in catalogue(problem.structure)}
    preds = [predict(Model(problem.structure, problem.nominal), g, problem.sampling) for g in problem.groups]
    ripple = of["cogging", "wrist_3_joint"]
    slow, fast = (too_fast(problem, preds, Effect(ripple, np.array([1.0, k, 0.0]))) for k in (5.0, 20000.0))
    assert fast and not slow
    rub = Effect(of["coulomb_friction", "wrist_3_joint"], np.array([1.0, 0.0, 1e-3, 0.0]))
    assert not too_fast(problem, preds, rub)


def test_a_ripple_is_sought_along_what_was_recorded_and_in_the_compared_band():
    """628 periods a metre: a slow sweep shows them, fast moves do not, and the return that closes a motion is none of
    both."""
    robot = load_robot("emps")
    rng = np.random.default_rng(5)
    t = np.arange(int(20 * RATE)) / RATE
    segments = []
    for i, period in enumerate((16.0, 3.0, 4.0)):
        w, size = 2 * np.pi / period, 0.1
        q, v, a = size * np.sin(w * t), size * w * np.cos(w * t), -size * w**2 * np.sin(w * t)
        mass = robot.array("motor_inertia")[0] + 50.0
        tau = (
            mass * a
            + robot.array("viscous_friction")[0] * v
            + 8.0 * np.sin(628.0 * q + 0.7)
            + 0.5 * rng.normal(size=t.size)
        )
        segments.append(
            Segment(
                f"m{i}",
                "trajectory",
                "identification",
                t,
                tau[:, None],
                q[:, None] + 1e-6 * rng.normal(size=(t.size, 1)),
            )
        )
    data = Dataset(
        "sweep", robot, RATE, robot.joint_names, "zoh", np.array([1e-6]), np.array([0.5]), None, tuple(segments)
    )
    setup, result = identify(data)
    preds = predictions(setup.problem, result.model, result.remainders)
    found = wave_numbers(setup.problem, preds, 0)
    assert min(abs(n - 628.0) for n in found) < 3.0, found
