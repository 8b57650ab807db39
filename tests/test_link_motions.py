"""Laws of the gear in motions, which link encoders show and the torque hardly does."""

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from ident.attribute import Search, elsewhere
from ident.baseline import fit_baseline
from ident.conclude import _late
from ident.coordinates import pack, unpack
from ident.derivatives import jacobian
from ident.diagnosis import diagnose, diagnose_fully
from ident.hypotheses import catalogue
from ident.identification import identify, set_up
from ident.left_out import carries_over, link_errors, with_error_as_noise
from ident.link_sensor import LinkDelay, comparable_links, find_link_delays, with_link_encoders
from ident.model import Effect, Model
from ident.parallel import Workers
from ident.problem import data_count, data_counts, predictions
from ident.refits import polish
from ident.seek import Sought, by_link_encoders, gone_on_with, seek
from ident.weights import make_weights
from sim.effects import parse_effect
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files

pytestmark = pytest.mark.xdist_group("link_motions")  # one worker makes what they share


def motions(robot, seed, hidden, folder):
    """Three motions of an arm with link encoders, the last held out."""
    plans = [
        small_plan(robot, seed + k, points=1, levels=(1.0,), validation_points=0, trajectory=True) for k in range(3)
    ]
    roles = ("identification", "identification", "validation")
    moves = tuple(
        replace(p.trajectories[0], name=f"motion-{k}", role=role)
        for k, (p, role) in enumerate(zip(plans, roles, strict=True))
    )
    drives = draw_drives(np.random.default_rng(seed), robot)
    plan = replace(plans[0], experiments=(), trajectories=moves)
    return through_files(quick_experiment(plan, hidden, seed=seed, drives=drives, link_encoders=True), folder)


@pytest.fixture(scope="module")
def still(ur10, tmp_path_factory):
    """Motions with nothing hidden."""
    return motions(ur10, 21, [], tmp_path_factory.mktemp("motions"))


@pytest.mark.parametrize(
    ("text", "figure", "value"),
    [
        pytest.param("hardening_stiffness@shoulder_lift_joint:cubic=3e10", "cubic", 3e10, marks=pytest.mark.slow),
        pytest.param("backlash@shoulder_pan_joint:gap=4e-4", "gap", 4e-4, marks=pytest.mark.slow),
    ],
)
def test_a_law_of_the_gear_is_named_by_link_encoders(ur10, tmp_path, text, figure, value):
    data = motions(ur10, 21, [parse_effect(text, ur10)], tmp_path)
    # What the law of a gap leaves, in which the link hangs free, others would share in further rounds.
    done = diagnose_fully(data, max_causes=1)
    (cause,) = [c for c in done.verdict.causes if c.probability > 0.5]
    assert f"{cause.effect}@{cause.joint}" == text.split(":")[0] and cause.probability > 0.8
    assert cause.parameters[figure].value == pytest.approx(value, rel=0.02)
    plot = done.evidence[done.verdict.causes.index(cause)]
    left = plot.y[np.argsort(plot.x)] - plot.model_y
    assert "link encoder" in plot.y_label and np.std(left) < 0.2 * np.std(plot.model_y)


@pytest.mark.slow
def test_link_encoders_with_nothing_hidden_bring_no_cause(still):
    verdict = diagnose(still)
    assert not verdict.causes and not verdict.discrepancy.detected


def linked(data, late=()):
    setup = set_up(data, fast=True)
    return replace(setup, problem=with_link_encoders(setup.problem, late))


def test_torque_and_links_are_weighed_under_the_noise_that_the_torque_has_shown(still, monkeypatch):
    setup = set_up(still)
    told = replace(
        setup.problem,
        q_std=2.0 * setup.problem.q_std,
        tau_std=0.1 * setup.problem.tau_std,
        sampling=replace(setup.problem.sampling, roll_off=1e-7),
    )
    first = SimpleNamespace(model=Model(told.structure, told.nominal), remainders=[None] * len(told.groups))
    monkeypatch.setattr("ident.seek.fit_baseline", lambda problem, say: None)
    monkeypatch.setattr("ident.seek.attribute", lambda problem, both, **how: problem)
    both = by_link_encoders(still, replace(setup, problem=told), first, 1, Workers())
    asked = both.result
    assert asked is both.setup.problem and asked.sampling == told.sampling and asked.groups[0].links
    assert np.array_equal(asked.q_std, told.q_std) and np.array_equal(asked.tau_std, told.tau_std)


def test_noise_that_only_the_torque_tells_is_no_cause_of_link_encoders_either(still, ur10, monkeypatch):
    """Of torque noise whose samples go together differences tell too little; the fast lines of motions show it then,
    and link encoders are asked again under that."""
    rng, segments = np.random.default_rng(7), []
    for segment in still.segments:
        white = 20.0 * ur10.array("tau_std") * rng.normal(size=segment.tau.shape)
        coloured = scipy.signal.lfilter([np.sqrt(1.0 - 0.9**2)], [1.0, -0.9], white, axis=0)
        segments.append(replace(segment, tau=segment.tau + coloured))
    data = replace(still, segments=tuple(segments), q_std=None, tau_std=None)
    setup, baseline = identify(data)
    asked = []

    def spied(dataset, setup, *rest):
        asked.append(by_link_encoders(dataset, setup, *rest))
        return asked[-1]

    monkeypatch.setattr("ident.seek.by_link_encoders", spied)
    found = seek(data, setup, baseline, 0, Workers())
    assert [x.result.detected for x in asked] == [True, False]
    assert not found.result.detected


def test_links_move_with_the_drives_as_the_jacobian_says(still):
    """To the change of the equilibrium, which moves the linear arm too and is left to the next step."""
    problem = linked(still).problem
    model, n = Model(problem.structure, problem.nominal), problem.structure.n
    preds = predictions(problem, model, [None] * len(problem.groups), steps=None)
    group, pred = problem.groups[0], preds[0]
    J, x = jacobian(problem, model, group, pred).dense()[:, :, n:], pack(model)
    for i in range(2 * n):  # springs and dampers of the gears
        ends = []
        for sign in (1.0, -1.0):
            moved = x.copy()
            moved[i] += sign * 1e-4
            there = predictions(problem, unpack(model, moved, np.inf), [p.solution.W for p in preds])
            ends.append(there[0].outputs()[..., n:])
        slope = (ends[0] - ends[1]) / 2e-4
        assert np.linalg.norm(J[..., i] - slope) < 1e-2 * np.linalg.norm(slope)
    assert not np.any(J[..., 2 * n : 4 * n]), "motors do not move the links along a given motion"


def test_the_zero_of_a_link_encoder_does_not_count_and_its_delay_is_taken_back(still):
    group = linked(still).problem.groups[0]
    moved = group.outputs.copy()
    moved[:, 0, -1] += 0.1
    seen, same = group.observe_outputs(moved), group.observe_outputs(group.outputs)
    assert np.abs(seen - same).max() < 1e-12 and np.abs(same[..., -1]).max() > 1e-3
    late = linked(still, (LinkDelay(2, 3e-3, 1e-5),)).problem.groups[0]
    assert late.Q_link[..., 2] == pytest.approx(group.Q_link[..., 2] * np.exp(3e-3j * group.omega))
    assert np.array_equal(late.Q_link[..., 3], group.Q_link[..., 3])


@pytest.mark.parametrize(("samples", "named", "clear"), [(0.005, False, None), (0.05, True, False), (0.5, True, True)])
def test_a_part_of_a_sample_by_which_a_link_encoder_is_late(still, samples, named, clear):
    """Too little of it has no name; a little is one with viscous friction of the link, which the verdict says."""
    problem, joint = set_up(still).problem, 2
    model, step = Model(problem.structure, problem.nominal), problem.sampling.sample_time
    preds = predictions(problem, model, [None] * len(problem.groups), steps=None)
    rng, groups = np.random.default_rng(5), []
    for group, pred in zip(problem.groups, preds, strict=True):
        links = pred.solution.Q_driven + 1e-9 * rng.normal(size=(*pred.U.shape, 2)) @ [1.0, 1.0j]
        links[..., joint] *= np.exp(-1j * group.omega * samples * step)
        groups.append(replace(group, Q_link=links))
    late = find_link_delays(groups, preds, step)
    assert [x.joint for x in late] == ([joint] if named else [])
    for x in late:
        assert x.delay == pytest.approx(samples * step, rel=0.05) and x.clear == clear
        cause = _late(x, "elbow_joint", False)
        assert (cause.probability > 0.9) == clear and cause.probability > 0.5
        assert ("friction of the link" in cause.evidence) == (not clear)


def test_link_encoders_count_at_their_joints(still):
    problem = linked(still).problem
    torque = replace(problem, groups=tuple(replace(g, links=()) for g in problem.groups))
    some = replace(problem, groups=tuple(replace(g, links=(1, 4)) for g in problem.groups))
    assert data_count(problem) == pytest.approx(2 * data_count(torque), rel=1e-6)
    assert data_counts(some) / data_counts(torque) == pytest.approx([1, 2, 1, 1, 2, 1])


@pytest.mark.slow
def test_multisines_are_compared_without_link_encoders(ur10, tmp_path):
    data = quick_experiment(small_plan(ur10, 13, points=1, levels=(1.0,)), [], seed=13, link_encoders=True)
    assert not comparable_links(set_up(through_files(data, tmp_path)).problem)


@pytest.mark.parametrize("effect", ["torque_constant", "torque_lag", "torque_delay", "sensor_lag", "sensor_delay"])
def test_filters_of_drives_and_sensors_leave_the_noise_of_all_outputs_a_covariance(still, effect):
    problem = linked(still).problem
    problem = replace(problem, q_std=np.full(6, 1e-5), tau_std=np.full(6, 0.05))
    h = next(h for h in catalogue(problem.structure) if (h.effect, h.place) == (effect, "elbow_joint"))
    model = Model(
        problem.structure, problem.nominal, (Effect(h, np.array([3.0 if effect == "torque_constant" else 5e-3])),)
    )
    weights = make_weights(problem, predictions(problem, model, [None] * len(problem.groups), steps=None), 0.0)
    assert all(np.linalg.eigvalsh(S).min() > 0.0 for S in weights.covariance)


def test_a_search_by_link_encoders_goes_on_in_the_time_that_is_left(monkeypatch):
    """It has half of the time, as the torque may be asked alone after it; where what it found stands there is more."""
    monkeypatch.setattr("ident.seek.attribute", lambda problem, baseline, known, **rest: (problem, baseline, known))
    setup = SimpleNamespace(problem="both")
    ended = Sought(setup, (), "first", "causes", None, late=True)
    assert gone_on_with(ended, 4, Workers()).result == ("both", "first", "causes")
    assert gone_on_with(replace(ended, late=False), 4, Workers()).result == "causes"
    assert gone_on_with(ended, 4, Workers(deadline=0.0)).result == "causes"


def test_a_search_before_that_for_inertias_goes_on_where_none_are_asked(monkeypatch):
    """It has half of the time too; where its causes leave next to nothing there is no other search after it."""
    nominal = SimpleNamespace(groups=(), nominal=None, tau_std=np.ones(1), motions_alone=True)
    setup = SimpleNamespace(problem=nominal)
    monkeypatch.setattr("ident.seek.by_link_encoders", lambda *args: None)
    monkeypatch.setattr("ident.seek.inertias_foretell", lambda setup: True)
    monkeypatch.setattr("ident.seek.unresolved", lambda result: False)
    monkeypatch.setattr("ident.seek.attribute", lambda problem, baseline, known, **rest: (baseline, known))

    def sought(dataset, setup, baseline, max_causes, workers, first):
        return setup, "first", "late causes" if first.late else "causes"

    monkeypatch.setattr("ident.seek.sought", sought)
    for seconds, expected in ((100.0, "causes"), (-1.0, "late causes")):
        found = seek(None, setup, "first", 4, Workers(deadline=time.monotonic() + seconds))
        assert found.result == expected and found.late == (seconds < 0.0)
    half_gone = Workers(deadline=time.monotonic() + 100.0)
    monkeypatch.setattr(Workers, "for_half", lambda self: replace(self, deadline=0.0))
    found = seek(None, setup, "first", 4, half_gone)
    assert found.result == ("first", "late causes") and not found.late


def test_what_link_encoders_alone_show_carries_over_to_parts_left_out(ur10, tmp_path):
    """An error of an encoder once a turn of the joint: the motor follows what it says, which its torque hardly shows."""
    hidden = parse_effect("encoder_eccentricity@elbow_joint:amplitude=1e-3,phase=0.4", ur10)
    problem = linked(motions(ur10, 21, [hidden], tmp_path)).problem
    joint = ur10.joint_names.index("elbow_joint")
    first = fit_baseline(problem, None)
    round_disc = next(h for h in catalogue(problem.structure, motions_alone=True) if h.key == hidden_key(hidden))
    wave = Effect(round_disc, 1e-3 * np.array([np.cos(0.4), np.sin(0.4)]))
    found = polish(problem, replace(first, model=replace(first.model, effects=(wave,))))
    assert first.costs[joint] > 10.0 * found.costs[joint]
    assert carries_over(problem, first, found, joint, Workers())
    pairs = [
        tuple(predictions(problem, x.model, x.remainders)[i] for x in (first, found))
        for i in range(len(problem.groups))
    ]
    errors = link_errors(problem, pairs)
    at = problem.groups[0].links.index(joint)
    assert np.all(errors.before[:, at] > 10.0 * errors.noise[:, at])
    assert np.mean(errors.noise[:, at]) < np.mean(errors.after[:, at]) < 1e-3 * np.mean(errors.before[:, at])
    # Given up, that is noise of the joint's link encoder, and of no other.
    loud = with_error_as_noise(problem, first, joint).groups[0].link_std / problem.groups[0].link_std
    assert loud[joint] > 3.0 and np.all(np.delete(loud, joint) == 1.0)


def hidden_key(effect):
    return effect.name, effect.place


def test_a_joint_that_was_given_up_ends_the_search_where_it_still_leaves_most():
    """It had been given up again and again until the time was over."""
    laws = tuple(SimpleNamespace(joint=j) for j in (0, 0, 1))
    search = Search(None, None, laws[2:], 0.0)
    assert elsewhere(search, 0).over
