"""Effects that raise the noise of all lines by less than its estimate errs: seen by their own response, and not by
chance."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from ident.attribute import LEFT_TO_DECOYS, Attribution, attribute
from ident.baseline import DETECTION_EXCESS, discrepancy_p_value
from ident.diagnosis import diagnose
from ident.evidence import LAW_ERROR, TEMPER, TEMPER_OF_NOISE, Candidate, model_error, weigh
from ident.faint import (
    LEAST_LATE,
    LINEAR,
    ROUGH,
    SEEN,
    SHADOW,
    beyond_noise_of_positions,
    by_noise_alone,
    faint_scores,
    hidden,
    in_signal,
    left_by_laws,
    of_timing,
    seen,
    with_other_scatter,
)
from ident.hypotheses import catalogue
from ident.model import Effect, along_record, as_loop
from ident.noise import NO_CHANCE, TOGETHER, drifting, line_coherence
from ident.notes import drift_note
from ident.problem import predictions
from ident.refits import refit
from ident.refuted import without_denied
from ident.rounds import Round, temper_of, told_share, weighed_round
from ident.screening import Score, most_explained, screen
from ident.search import hopeful
from ident.seek import explained
from ident.trust import denied
from ident.verdict import UNKNOWN
from sim import parse_effect
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files

COGGING = "cogging@wrist_3_joint:amplitude=0.002,periods_per_rev=202,phase=0.3"
COULOMB = "coulomb_friction@wrist_2_joint:torque=0.004"
SIZES = {COGGING: ("amplitude", 0.002), COULOMB: ("torque", 0.004)}  # that leave less than a tenth more than noise
DELAY = "torque_delay@elbow_joint:delay=0.001"


@pytest.fixture(scope="module")
def hypotheses(identified):
    return catalogue(identified[1].problem.structure)


@pytest.mark.parametrize(("faint", "beside"), [
    (COGGING, ()),
    (COULOMB, (DELAY,)),
    (COULOMB, ()),
    (COGGING, (DELAY,)),
])  # fmt: skip
@pytest.mark.slow
def test_an_effect_within_the_error_of_the_noise_is_found(ur10, tmp_path, faint, beside):
    """Alone, and beside another one that is not faint."""
    effects = [parse_effect(text, ur10) for text in (*beside, faint)]
    data = quick_experiment(
        small_plan(ur10, 31, levels=(1.0,)),
        effects,
        seed=31,
        drives=draw_drives(np.random.default_rng(31), ur10),
    )
    verdict = diagnose(through_files(data, tmp_path))
    name, value = SIZES[faint]
    sure = {(c.effect, c.joint): c for c in verdict.causes if c.probability > 0.5}
    assert set(sure) == {(e.name, e.place) for e in effects}
    assert sure[effects[-1].name, effects[-1].place].parameters[name].value == pytest.approx(value, rel=0.15)
    assert verdict.discrepancy.detected and verdict.unexplained_verdict == "noise floor reached"
    if not beside:
        assert verdict.discrepancy.chi2_per_dof < DETECTION_EXCESS and verdict.discrepancy.p_value < 1e-6


@pytest.mark.slow
def test_noise_alone_shows_nothing_by_far(identified, hypotheses):
    _, setup, baseline = identified
    scores = faint_scores(setup.problem, baseline, hypotheses, np.zeros(6))
    assert 0.0 < scores[0].gain < 0.6 * SEEN and seen(scores, baseline) is None
    assert hidden(setup.problem, baseline, hypotheses, np.zeros(6)) == ((), 1.0)
    found = attribute(setup.problem, baseline)
    assert not found.detected and not found.rounds and found.p_value > 1e-3


@pytest.mark.slow
def test_what_laws_already_found_may_leave_is_not_looked_at(identified, hypotheses):
    """At their joints; of what changes the chain, and shows at all of them, what the strongest may leave."""
    _, setup, baseline = identified
    every = faint_scores(setup.problem, baseline, hypotheses, np.zeros(6))
    joint = next(s for s in every if not s.hypothesis.on_chain).hypothesis.joint
    told = np.zeros(6)
    told[joint] = 5.0 / SHADOW
    left = faint_scores(setup.problem, baseline, hypotheses, told)

    def small(scores: list) -> set[int]:
        """Joints, and -1 for the chain, of what explains no more than that."""
        return {-1 if s.hypothesis.on_chain else s.hypothesis.joint for s in scores if s.gain <= 5.0}

    assert small(every) == {-1, *range(6)} and small(left) == set(range(6)) - {joint}


@pytest.mark.parametrize(("effect", "place", "left", "share"), [
    ("sensor_delay", "wrist_1_joint", 1.0, 1e-4),  # noise at its own joint: its law has no error that others could show
    ("sensor_delay", "wrist_1_joint", 1.3, 4e-4),
    ("sensor_delay", "wrist_1_joint", 5.0, SHADOW),
    ("payload", "flange", 1.0, SHADOW),  # a change of the chain has no joint of its own
])  # fmt: skip
def test_errors_of_a_law_show_at_its_own_joint_first(identified, hypotheses, effect, place, left, share):
    *_, baseline = identified
    h = next(h for h in hypotheses if h.key == (effect, place))
    costs = baseline.counts * np.where(np.arange(6) == h.joint, left, 1.0)
    model = replace(baseline.model, effects=(Effect(h, np.ones(len(h.parameters))),))
    told = np.full(6, 1e3 * baseline.counts[h.joint])
    allowed = left_by_laws(replace(baseline, model=model, costs=costs), told) / told
    assert allowed[h.joint] == SHADOW
    assert np.delete(allowed, h.joint) == pytest.approx(share)
    assert left_by_laws(replace(baseline, costs=costs), told) == pytest.approx(SHADOW * told)


@pytest.mark.parametrize(
    ("effect", "samples", "expected"),
    [
        ("torque_delay", 0.5 * LEAST_LATE, True),
        ("sensor_lag", 0.5 * LEAST_LATE, True),
        ("torque_delay", 2.0 * LEAST_LATE, False),
        ("coulomb_friction", 0.5 * LEAST_LATE, False),
    ],
)
def test_a_delay_within_the_error_of_the_timing_is_none(hypotheses, effect, samples, expected):
    h = next(h for h in hypotheses if h.effect == effect)
    score = Score(h, 100.0, 1, np.array([samples * 1e-3]), np.ones(1), ())
    assert of_timing(score, 1e-3) is expected
    assert not of_timing(replace(score, start=None), 1e-3)


@pytest.mark.slow
def test_a_noisier_joint_shows_less(identified, hypotheses):
    _, setup, baseline = identified
    scores = faint_scores(setup.problem, baseline, hypotheses, np.zeros(6))
    first = next(s for s in scores if not s.hypothesis.on_chain)
    loud = [replace(first, gain=1.2 * SEEN)]
    assert seen(loud, baseline) is loud[0]
    costs = baseline.counts.copy()
    costs[first.hypothesis.joint] *= 1.3
    assert seen(loud, replace(baseline, costs=costs)) is None


def test_several_draws_are_held_against_all_hypotheses_as_each_of_them_alone(identified, hypotheses):
    """At the wave numbers that each of them shows too."""
    _, setup, current = identified
    rng, preds = np.random.default_rng(3), predictions(setup.problem, current.model, current.remainders)
    others = [
        replace(
            setup.problem,
            groups=tuple(with_other_scatter(g, p, rng) for g, p in zip(setup.problem.groups, preds, strict=True)),
        )
        for _ in range(3)
    ]
    hinges, laws = ([h for h in hypotheses if ("hinge" in h.options) is hinge] for hinge in (True, False))
    for some in (hinges, [h for h in laws if not h.repeats], [h for h in laws if h.repeats]):
        each = [screen(other, current, preds, some)[0].gain for other in others]
        together = most_explained(setup.problem, current, preds, some, others)
        assert np.all(together >= (1.0 - 1e-6) * np.array(each))
        if not some[0].repeats:
            assert together == pytest.approx(each, rel=1e-6)


def test_noise_whose_lines_go_together_shows_nothing(identified, hypotheses):
    """A recorder of the torque whose clock is off by another 30 microseconds in each record and period: a few numbers
    explain much of it."""
    _, setup, baseline = identified
    rng = np.random.default_rng(5)

    def recorded(group):
        late = 3e-5 * rng.normal(size=(*group.U_periods.shape[:2], 1, 1))
        U_periods = group.U_periods * np.exp(-1j * group.omega[:, None] * late)
        return replace(group, U_periods=U_periods, U=U_periods.mean(axis=1))

    problem = replace(setup.problem, groups=tuple(map(recorded, setup.problem.groups)))
    some = [h for h in hypotheses if "friction" in h.effect and h.joint < 3]
    assert seen(faint_scores(problem, baseline, some, np.zeros(6)), baseline) is not None
    assert by_noise_alone(setup.problem, baseline, some) < SEEN < by_noise_alone(problem, baseline, some)
    assert hidden(problem, baseline, some, np.zeros(6)) == ((), 1.0)


def test_linear_hypotheses_are_seen_at_lines_that_hold_signal(identified, hypotheses):
    """At others the arm answers noise alone; what is not linear shows there."""
    _, setup, baseline = identified
    preds = predictions(setup.problem, baseline.model, baseline.remainders)
    linear, other = (next(h for h in hypotheses if h.effect == x) for x in ("unknown:position_scale", "cogging"))
    scores = [Score(h, SEEN + 10.0, 1, None, np.zeros(1), ()) for h in (linear, other)]
    first, last = in_signal(setup.problem, baseline, preds, scores)
    assert first == scores[1] and last.hypothesis is linear and last.gain < 0.5 * SEEN
    silent = [replace(s, gain=SEEN - 1.0) for s in scores]
    assert in_signal(setup.problem, baseline, preds, silent) == silent


def single(group):
    """A group as of one period."""
    return replace(group, U_periods=group.U_periods[:, :1], Q_periods=group.Q_periods[:, :1])


def test_nothing_faint_is_sought_beside_link_encoders(identified, hypotheses):
    _, setup, baseline = identified
    problem = setup.problem
    linked = replace(problem, groups=(replace(problem.groups[0], links=(1,)), *problem.groups[1:]))
    assert faint_scores(linked, baseline, hypotheses, np.zeros(6)) == []


@pytest.mark.parametrize(("still", "found"), [(True, False), (False, True)])
def test_the_noise_of_a_joint_that_hardly_moves_is_no_answer_of_it(identified, hypotheses, still, found):
    """A damper at the link: with its own noise for its motion it explains the noise that this leaves in the torque; in
    motion, what it does."""
    _, setup, baseline = identified
    j, rng = 3, np.random.default_rng(1)
    drag = next(h for h in hypotheses if h.effect == "unknown:link_friction" and h.joint == j)
    groups = []
    for group in setup.problem.groups:
        Q = group.Q.copy()
        Q[:, 1:, j] *= not still
        group = single(
            replace(group, Q=Q, white_noise=group.white_noise * np.where(still & (np.arange(6) == j), 1e4, 1.0))
        )
        noise = (rng.normal(size=(2, *Q.shape)) * np.sqrt(0.5 * group.position_noise))[:, :, :, j]
        noise[:, :, 0] = 0.0
        Q[..., j] += (noise[0] + 1j * noise[1]) * still
        groups.append(replace(group, Q=Q))
    problem = replace(setup.problem, groups=tuple(groups))
    effect = () if still else (Effect(drag, np.array([0.3])),)
    true = replace(baseline.model, effects=effect)
    preds = predictions(problem, true, baseline.remainders)
    passed = [
        np.einsum("li,sl->sli", p.sampled_impedance[..., j], g.Q[..., j]) * still
        for g, p in zip(problem.groups, preds, strict=True)
    ]
    for U in passed:
        U[:, 0] = 0.0
    problem = replace(
        problem, groups=tuple(replace(g, U=p.U - U) for g, p, U in zip(groups, preds, passed, strict=True))
    )
    quiet = replace(baseline, costs=baseline.counts.astype(float))
    scores = faint_scores(problem, quiet, [drag], np.zeros(6))
    assert seen(scores, quiet) is not None
    assert (beyond_noise_of_positions(problem, quiet, scores)[0] is not None) is found


@pytest.mark.slow
@pytest.mark.parametrize(("size", "colour", "found"), [(0.0, 1.0, False), (0.01, 1.0, True), (0.0, 20.0, False)])
def test_of_single_periods_phases_tell_what_noise_explains(identified, hypotheses, size, colour, found):
    """Noise, an effect within it, and noise that rises towards the low lines of a joint, of which a few numbers explain
    much."""
    _, setup, baseline = identified
    problem, j, rng = setup.problem, 3, np.random.default_rng(2)
    few = [h for h in hypotheses if h.joint == j and not h.on_chain]
    friction = next(h for h in few if h.effect == "coulomb_friction")
    true = replace(baseline.model, effects=(Effect(friction, np.array([size, 0.0, 5e-3])),) if size else ())
    preds = [predictions(problem, m, baseline.remainders) for m in (baseline.model, true)]
    groups = []
    for group, before, after in zip(problem.groups, *preds, strict=True):
        noise = np.zeros_like(group.U)
        std = np.sqrt(problem.tau_std[j] ** 2 / problem.samples(group))
        low = 1.0 / (1.0 + (np.arange(noise.shape[1]) / 20.0) ** 2)
        noise[..., j] = (
            (colour - 1.0) * std * low * (rng.normal(size=noise.shape[:2]) + 1j * rng.normal(size=noise.shape[:2]))
        )
        groups.append(single(replace(group, U=group.U + after.U - before.U + noise)))
    problem = replace(problem, groups=tuple(groups))
    quiet = replace(baseline, costs=baseline.counts.astype(float))
    asked, chance = hidden(problem, quiet, few, np.zeros(6))
    assert bool(asked) is found and (chance < 1e-6) is found
    if colour > 1.0:
        assert seen(faint_scores(problem, quiet, few, np.zeros(6)), quiet) is not None
    if found:
        assert friction in asked


@pytest.mark.slow
def test_coloured_noise_of_single_periods_is_no_discrepancy_and_an_effect_beside_it_is(locked, tmp_path):
    """Noise that is neither given nor repeated is guessed as white, from differences of samples that hardly show
    coloured noise."""
    hidden = parse_effect("payload@flange:mass=0.5,com_x=0.02,com_y=0.03,com_z=0.08", locked)

    def recorded(effects, folder):
        data = quick_experiment(
            small_plan(locked, 5, points=1, levels=(1.0,), periods=2, validation_points=0),
            effects,
            seed=5,
            noise=0.0,
        )
        rng = np.random.default_rng(7)

        def coloured(x, std):
            return (
                x
                + lfilter([np.sqrt(1 - 0.6**2)], [1.0, -0.6], std * rng.normal(size=(500 + len(x), len(std))), axis=0)[
                    500:
                ]
            )

        segments = (
            replace(s, q=coloured(s.q, locked.array("q_std")), tau=coloured(s.tau, locked.array("tau_std")))
            for s in data.segments
        )
        return through_files(replace(data, segments=tuple(segments), q_std=None, tau_std=None), folder)

    verdict = diagnose(recorded([], tmp_path / "none"), max_causes=1)
    assert not verdict.discrepancy.detected and verdict.causes == ()
    cause, *others = diagnose(recorded([hidden], tmp_path / "load"), max_causes=1).causes
    assert (cause.effect, others) == ("payload", []) and cause.parameters["mass"].value == pytest.approx(0.5, rel=0.02)


def test_lines_go_together_where_noise_drifts_and_nowhere_else():
    """White, coloured, walking and drifting noise in records of 3 periods, cut without a window."""
    rng, S, P, N, alpha = np.random.default_rng(4), 6, 3, 900, 0.8
    white = rng.normal(size=(S, 2 * P * N))
    coloured, walking = lfilter([1.0], [1.0, -alpha], white), np.cumsum(white, axis=1)
    samples = np.stack([white, coloured, walking, np.cumsum(walking, axis=1)], axis=-1)[:, -P * N :]
    lines = np.fft.rfft(samples.reshape(S, P, N, 4), axis=2)[:, :, 1:200]
    together, count = line_coherence([lines[:3], lines[3:]])
    assert np.sum(count) == S * (P - 1) * 198
    assert np.all(together[:, :2] * np.sqrt(count)[:, None] < NO_CHANCE)
    assert np.all(together[:-1, 2] > 0.15) and np.all(together[:-1, 2] < TOGETHER)
    assert np.all(together[:-1, 3] > TOGETHER) and np.all((together[:, 3] * np.sqrt(count))[:-1] > NO_CHANCE)


def test_nothing_faint_is_sought_beside_a_drift_and_the_verdict_tells_it(identified, hypotheses):
    _, setup, baseline = identified
    problem, j = setup.problem, 2
    assert not np.any(drifting(problem.groups)) and drift_note(problem) == ()

    def drifted(group, rng):
        """With a torque that drifts at a joint beside the noise: a step where each period ends, in its lines."""
        S, P, L, _ = group.U_periods.shape
        saw = 1.0 / (1j * np.maximum(np.arange(L), 1))
        step = 300.0 * np.sqrt(problem.tau_std[j] ** 2 / problem.samples(group)) * rng.normal(size=(S, P, 1))
        U = group.U_periods.copy()
        U[..., j] += step * saw
        return replace(group, U_periods=U)

    rng = np.random.default_rng(1)
    problem = replace(problem, groups=tuple(drifted(g, rng) for g in problem.groups))
    assert np.flatnonzero(drifting(problem.groups)).tolist() == [j]
    asked = {s.hypothesis.joint for s in faint_scores(problem, baseline, hypotheses, np.zeros(6))}
    assert asked and j not in asked and -1 not in asked
    (note,) = drift_note(problem)
    assert problem.structure.robot.joint_names[j] in note


@pytest.mark.slow
def test_a_law_along_the_record_hides_more_and_its_joint(identified, hypotheses):
    _, setup, baseline = identified
    h = along_record(next(h for h in hypotheses if h.key == ("backlash", "elbow_joint")))
    model = replace(baseline.model, effects=(Effect(h, np.array([1e-7, 0.0])),))
    along = replace(baseline, model=model)
    scores = faint_scores(setup.problem, along, hypotheses, np.zeros(6))
    assert {s.hypothesis.joint for s in scores if not s.hypothesis.on_chain} == set(range(6)) - {h.joint}
    for factor, expected in ((1.2, False), (1.2 * ROUGH, True)):
        loud = [replace(scores[0], gain=factor * SEEN)]
        assert (seen(loud, along) is not None) is expected and seen(loud, baseline) is loud[0]
        # As a loop too, under which single records may be in another steady motion than the model.
        bent = replace(along, model=replace(model, effects=(Effect(as_loop(h), model.effects[0].p),)))
        assert (seen(loud, bent) is not None) is expected


def test_a_decoy_that_outdoes_a_faint_name_belies_no_other(identified):
    """What a round explains, as a share of the discrepancy, decides whether its decoy counts."""
    *_, baseline = identified
    loud = replace(baseline, costs=10.0 * baseline.costs)

    def explaining(fall: float) -> Round:
        after = replace(loud, costs=loud.costs - fall / 6.0)
        return Round(loud, (Candidate(None, after, 0.0),), (), 1.0, 1.0)

    assert told_share(loud, explaining(100.0)) < LEFT_TO_DECOYS < told_share(loud, explaining(loud.cost / 20.0))
    assert told_share(baseline, explaining(100.0)) > 1.0


@pytest.mark.parametrize(("left", "fall", "expected"), [
    (900.0, 1e6, 0.0),  # noise
    (1050.0, 1e6, 50.0),  # all of it may be an error of a strong law
    (1050.0, 300.0, 3.0),  # and next to none of it one of a faint law
    (1600.0, 1e6, 600.0),
    (1600.0, 200.0, 502.0),
    (1600.0, -5.0, 600.0),  # what it explains is not known
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
        return Candidate(h, SimpleNamespace(model=model, information=np.eye(4), costs=np.array([cost])), 0.0)

    faint, of_all = (
        weigh([one(17900.0), one(18000.0)], np.array([x]), np.array([600.0]))[0].probability
        for x in (model_error(17900.0, 17550.0, 600.0), 350.0)
    )
    assert faint == pytest.approx(1.0 / (1.0 + np.exp(-50.0 / (TEMPER + 0.3))), abs=1e-9)
    assert of_all < 0.95


def test_beside_noise_alone_differences_count_for_more(hypotheses):
    """No law has an error there that neighbouring lines could share."""
    h = next(h for h in hypotheses if h.effect == "torque_delay")
    model = SimpleNamespace(
        effects=(SimpleNamespace(hypothesis=h, p=np.array([1e-4])),), par=SimpleNamespace(stiffness=np.ones(6))
    )
    two = [
        Candidate(h, SimpleNamespace(model=model, information=np.eye(4), costs=np.array([cost])), 0.0)
        for cost in (1000.0, 1012.0)
    ]
    for temper in (TEMPER, TEMPER_OF_NOISE):
        assert weigh(two, np.zeros(1), np.ones(1), temper)[0].probability == pytest.approx(
            1.0 / (1.0 + np.exp(-6.0 / temper)), abs=1e-9
        )


def test_a_round_within_the_noise_is_weighed_so(identified, hypotheses):
    """By what the model without a new cause leaves, in the round and when its causes meet again."""
    *_, baseline = identified
    (h, other) = [h for h in hypotheses if h.effect == "torque_delay"][:2]
    quiet, loud = (replace(baseline, costs=x * baseline.counts) for x in (0.9, 1.2))
    assert (temper_of(quiet), temper_of(loud)) == (TEMPER_OF_NOISE, TEMPER)

    def fitted(h, cost: float):
        model = replace(baseline.model, effects=(Effect(h, np.array([1e-4])),))
        return replace(
            baseline, model=model, costs=quiet.costs - cost / 6.0, information=np.eye(len(baseline.information) + 1)
        )

    ranked = [(h, fitted(h, 212.0)), (other, fitted(other, 200.0))]
    for before, temper in ((quiet, TEMPER_OF_NOISE), (loud, TEMPER)):
        found = weighed_round(before, ranked, (), {})
        assert found.candidates[0].probability == pytest.approx(1.0 / (1.0 + np.exp(-6.0 / temper)), rel=1e-3)


def test_a_diagnosis_asks_held_out_data_about_its_causes(clean, identified, hypotheses, monkeypatch):
    _, setup, baseline = identified
    h = next(h for h in hypotheses if h.key == ("torque_delay", "elbow_joint"))
    model = replace(baseline.model, effects=(Effect(h, np.array([1e-3])),))
    final = refit(setup.problem, model, baseline.weights, baseline.remainders)
    found = Round(baseline, (Candidate(h, final, 0.0, 1.0),), (), 1.0, 1.0)
    asked = []

    def deny(problem, groups, of):
        asked.append((groups, of))
        return True

    monkeypatch.setattr("ident.diagnosis.identify", lambda *args, **rest: (setup, baseline))
    monkeypatch.setattr(
        "ident.seek.attribute",
        lambda *args, **rest: Attribution(baseline, True, True, 0.0, (found,), final, False),
    )
    monkeypatch.setattr("ident.diagnosis.denied", deny)
    verdict = diagnose(clean[0])
    assert asked == [(setup.held_out, found)]
    assert verdict.causes[0].probability < 0.5 and verdict.unexplained_verdict == UNKNOWN


def test_denied_causes_are_taken_back_where_others_stand(identified, hypotheses):
    """The last that stands stays, as something was seen."""
    _, setup, baseline = identified
    late, off = (
        next(h for h in hypotheses if h.key == (name, "elbow_joint"))
        for name in ("torque_delay", "encoder_eccentricity")
    )
    effects = (Effect(late, np.array([1e-5])), Effect(off, np.array([1e-4, 0.0])))
    final = refit(setup.problem, replace(baseline.model, effects=effects), baseline.weights, baseline.remainders)
    rounds = tuple(Round(baseline, (Candidate(h, final, 0.0, 1.0),), (), 1.0, 1.0) for h in (late, off))
    found = Attribution(baseline, True, False, 0.0, rounds, final, False)
    left, (line,) = without_denied(setup.problem, found, {off.key})
    assert [e.hypothesis for e in left.final.model.effects] == [late] and left.rounds == rounds[:1]
    assert "encoder_eccentricity at elbow_joint" in line
    first, (line,) = without_denied(
        setup.problem, found, {late.key, off.key}
    )  # of two that are denied the one that was found first stays
    assert first.rounds == rounds[:1] and "encoder_eccentricity" in line
    alone = replace(found, rounds=rounds[1:], final=replace(final, model=replace(final.model, effects=effects[1:])))
    assert without_denied(setup.problem, alone, {off.key}) == (alone, [])


@pytest.mark.parametrize("clear", [True, False])
def test_refuted_causes_leave_an_unknown_one_only_of_a_discrepancy_that_is_seen_without_them(identified, clear):
    """Where they alone had shown one there is none."""
    baseline = identified[2]
    found = Attribution(
        baseline, True, clear, 1e-30, (SimpleNamespace(),), replace(baseline, costs=0.0 * baseline.costs), False
    )
    left = found.without_causes()
    assert (left.detected, left.unknown) == (clear, clear)
    assert left.rounds == () and left.final is baseline
    assert left.p_value == discrepancy_p_value(baseline)


@pytest.mark.parametrize(("wrong", "right", "expected"), [
    (3e-3, 0.0, True),  # held-out data do not show what it foretells
    (0.0, 3e-3, False),  # they do
    (1e-6, 0.0, False),  # nothing that they could show
])  # fmt: skip
def test_held_out_data_deny_a_faint_cause_that_does_not_show_there(identified, hypotheses, wrong, right, expected):
    """Only of a cause that was found within the noise, and by periodic data."""
    _, setup, baseline = identified
    h = next(h for h in hypotheses if h.key == ("encoder_eccentricity", "elbow_joint"))
    before, after = (
        replace(baseline, model=replace(baseline.model, effects=(Effect(h, np.array([size, size])),) if size else ()))
        for size in (right, wrong)
    )
    found = Round(before, (Candidate(h, after, 0.0, 1.0),), (), 1.0, 1.0)
    assert any(g.window is None for g in setup.held_out)
    assert denied(setup.problem, setup.held_out, found) == expected
    assert denied(setup.problem, tuple(single(g) for g in setup.held_out), found) == expected
    motions = tuple(g for g in setup.held_out if g.window is not None)
    assert not denied(setup.problem, motions, found)
    assert not denied(setup.problem, setup.held_out, replace(found, before=replace(before, costs=10.0 * before.costs)))


def test_the_special_case_of_a_law_that_goes_on_goes_on_too(hypotheses):
    """Coulomb friction is behind all laws that hold it, by what these have beyond it: noise, perhaps."""
    at = [h for h in hypotheses if h.place == "elbow_joint"]
    named = {h.effect: h for h in at}
    order = (
        "friction_drift",
        "unknown:position_friction",
        "presliding_friction",
        "cogging",
        "coulomb_friction",
        "torque_lag",
    )
    found = [
        (named[effect], SimpleNamespace(cost=1001.0 + 10.0 * i, count=1000, converged=False))
        for i, effect in enumerate(order)
    ]
    assert [h.effect for h, _ in hopeful(found)] == [*order[:4], "coulomb_friction"]  # a decoy takes no place
    others = [
        (named[effect], r) for effect, (_, r) in zip(("cogging", "torque_delay", "backlash"), found, strict=False)
    ]
    assert [h.effect for h, _ in hopeful([*others, *found[4:]])] == ["cogging", "torque_delay", "backlash"]


def heard(monkeypatch, scores: list, result: Round) -> list:
    """Hypotheses that each round asks, where noise hides ``scores`` and rounds end as ``result``."""
    asked = []
    monkeypatch.setattr("ident.faint.faint_scores", lambda *args: scores)

    def once(problem, current, hypotheses, *rest):
        asked.append(hypotheses)
        return result

    monkeypatch.setattr("ident.attribute.attribute_once", once)
    return asked


@pytest.mark.slow
def test_a_faint_round_asks_what_a_linear_step_puts_near_the_clearest(identified, hypotheses, monkeypatch):
    """And where nothing answers there, there is no discrepancy."""
    _, setup, baseline = identified
    first = faint_scores(setup.problem, baseline, hypotheses, np.zeros(6))[0]
    gains = (1000.0, 1.1 * LINEAR * 1000.0, 0.9 * LINEAR * 1000.0)
    scores = [replace(first, hypothesis=h, gain=gain) for h, gain in zip(hypotheses, gains, strict=False)]
    asked = heard(monkeypatch, scores, Round(baseline, (), (), 1.0, 0.0))
    found = attribute(setup.problem, baseline)
    assert asked == [hypotheses[:2]]
    assert not found.detected and found.p_value == pytest.approx(discrepancy_p_value(baseline))


@pytest.mark.parametrize("effect", ["torque_constant", "torque_delay"])
def test_earlier_causes_are_weighed_again_before_more_is_sought(identified, hypotheses, monkeypatch, effect):
    """All but the one just found, unless that has a wider form; and the model is pruned where another cause has taken
    the place of one of them."""
    _, setup, baseline = identified
    order, left = [], iter([h for h in hypotheses if h.effect == effect][:3])
    loud = replace(baseline, costs=100.0 * baseline.costs)

    def once(problem, current, *rest):
        h = next(left, None)
        if h is None:
            return Round(current, (), (), 1.0, 0.0)
        model = replace(current.model, effects=(*current.model.effects, Effect(h, np.array([1e-4]))))
        return Round(
            current, (Candidate(h, replace(current, model=model, costs=0.5 * current.costs), 0.0, 1.0),), (), 1.0, 1.0
        )

    def rematched(problem, current, rounds, workers):
        order.append([r.candidates[0].hypothesis.place for r in rounds])
        return replace(current), list(rounds)

    def pruned(problem, current):
        order.append(len(current.model.effects))
        return current

    monkeypatch.setattr("ident.attribute.attribute_once", once)
    monkeypatch.setattr("ident.attribute.polish", lambda problem, result: result)
    monkeypatch.setattr("ident.attribute.plainer", lambda problem, current, *rest: current)
    monkeypatch.setattr("ident.attribute.companions", lambda problem, current, *rest: (current, []))
    monkeypatch.setattr("ident.attribute.without_shadows", lambda problem, current, *rest: current)
    monkeypatch.setattr("ident.contests.rematched", rematched)
    for module in ("attribute", "contests"):
        monkeypatch.setattr(f"ident.{module}.pruned", pruned)
    attribute(setup.problem, loud)
    a, b, c = setup.problem.structure.robot.joint_names[:3]
    if effect == "torque_delay":
        assert order == [1, [a], 1, 2, [b], 2, [a], 2, 3, [c], 3, [a, b], 3, [a, b, c], 3]
    else:
        assert order == [1, 2, [a], 2, 3, [a, b], 3, [a, b, c], 3]


def test_loops_are_tried_once_before_more_is_sought(identified, monkeypatch):
    _, setup, baseline = identified
    order = []

    def loops(problem, current, workers):
        order.append("loops")
        return current

    monkeypatch.setattr("ident.attribute.as_loops", loops)
    monkeypatch.setattr("ident.attribute.hidden", lambda *args: (order.append("hidden") or (), 1.0))
    attribute(setup.problem, baseline)
    assert order == ["loops", "hidden"]


def test_link_encoders_that_show_no_cause_explain_nothing():
    settled = SimpleNamespace(detected=True, unknown=False, left_share=0.0, rounds=())
    assert not explained(settled)
    settled.rounds = (object(),)
    assert explained(settled)
