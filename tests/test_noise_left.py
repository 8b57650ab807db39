"""Noise of the torque where no period repeats: differences of samples tell what circulates in the loop too; a residual
is never less than noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal

from ident.attribute import attribute
from ident.baseline import fit_baseline
from ident.contests import nearly_settled
from ident.diagnosis import diagnose
from ident.hypotheses import catalogue
from ident.hypotheses.sensing import torque_offset
from ident.identification import (
    identify,
    set_up,
    under_noise_beside_causes,
    with_noise_of_fast_lines,
    with_noise_that_is_left,
)
from ident.model import Effect
from ident.noise import DOUBT, alike_at_all_lines, torque_noise_left
from ident.notes import noise_note
from ident.parallel import Workers
from ident.problem import predictions
from ident.refits import reweighted, under_own_noise
from ident.seek import louder, sought
from ident.weights import make_weights
from sim import parse_effect
from tests.conftest import quick_experiment, small_plan, through_files

pytestmark = pytest.mark.xdist_group("noise_left")  # one worker makes what they share


def spectra(rng, power, records=3):
    """(S, K, n) lines of noise of a power (K, n)."""
    shape = (records, *power.shape)
    return np.sqrt(power / 2) * (rng.normal(size=shape) + 1j * rng.normal(size=shape))


def room_for(torque, position, lacks=0.0):
    """Found power (seeds, n) of torque noise assumed to be 1, beside that of the positions (K, n)."""
    share, found = 1.0 / (1.0 + position), []
    for seed in range(20):
        Z = spectra(np.random.default_rng(seed), (torque + position) * share)
        Z[:, 1::8] += np.sqrt(lacks * share[1::8])  # what a model lacks is in few lines
        found.append(torque_noise_left([Z], [share]))
    return np.array(found)


@pytest.mark.parametrize("torque", [0.01, 0.3, 1.0])
@pytest.mark.parametrize("lacks", [0.0, 300.0])
def test_the_power_of_the_torque_noise_is_found_beside_that_of_the_positions(torque, lacks):
    # Noise of the positions rises with frequency; that of the torque was assumed to be 1.
    found = room_for(torque, np.linspace(1e-3, 3.0, 401)[:, None] ** 2 * np.ones(2), lacks)
    # Where the noise of a band is not even, a quantile tells too little; the doubt makes up for that.
    assert np.all(DOUBT * found > 0.9 * torque)
    # A bound: with an eighth of the lines away the quantile is a higher one of what is noise there.
    assert np.median(found) < (3.0 if lacks else 1.2) * torque


def test_noise_of_positions_that_rises_steeply_within_a_band_does_not_hide_that_of_the_torque():
    found = room_for(0.02, np.geomspace(1e-3, 1e3, 161)[:, None] * np.ones(2))
    assert np.all(DOUBT * found > 0.9 * 0.02)
    assert np.median(found) < 2.0 * 0.02


def test_few_lines_tell_nothing_of_the_noise():
    share = np.full((8, 2), 0.5)
    assert np.array_equal(torque_noise_left([spectra(np.random.default_rng(0), 0.1 * share)], [share]), np.ones(2))


@pytest.mark.parametrize("lacks", ["nothing", "excited lines", "odd lines", "even lines", "noise as given"])
def test_what_is_alike_at_all_lines_and_joints_is_noise(lacks):
    rng = np.random.default_rng(6)
    Z = spectra(rng, np.full((301, 3), 5.0), records=4)
    excited = np.zeros((4, 301), bool)
    excited[:, 1:200:4] = True
    also = {
        "nothing": np.s_[:0],
        "excited lines": np.s_[:, 1:200:4],
        "odd lines": np.s_[:, 1::2],
        "even lines": np.s_[:, 2::2],
        "noise as given": np.s_[..., :2],
    }[lacks]
    Z[also] *= np.sqrt(0.2 if lacks == "noise as given" else 2.0)
    groups = [SimpleNamespace(excited=excited)]
    found = alike_at_all_lines(groups, [Z])
    assert found == pytest.approx(np.full(3, 2.5), rel=0.1) if lacks == "nothing" else found is None
    assert alike_at_all_lines(groups, [Z[..., :1]]) is None  # a single joint has none beside it
    if lacks in ("excited lines", "odd lines", "even lines"):  # at one joint alone, which the others speak for
        Z[also][..., :2] /= np.sqrt(2.0)
        Z[also][..., 2] *= 10.0
        assert alike_at_all_lines(groups, [Z]) == pytest.approx(np.full(3, 2.5), rel=0.1)
    assert np.array_equal(excited.sum(axis=1), np.full(4, 50))  # as it was


def coloured_single_periods(robot, folder, hidden=(), joints=slice(None)):
    """Single periods, whose torque has noise of a pole at 0.7 and says of it what its samples have."""
    plan = small_plan(robot, 33, points=2, periods=2, transient_periods=1)
    data = through_files(quick_experiment(plan, hidden, seed=33), folder)
    given = 3.0 * robot.array("tau_std")
    rng = np.random.default_rng(8)

    def single(s):
        last = s.part(slice(-s.period, None))
        steps = rng.normal(size=last["tau"].shape) * np.sqrt(1.0 - 0.7**2) * given
        last["tau"] = last["tau"].copy()
        last["tau"][:, joints] += scipy.signal.lfilter([1.0], [1.0, -0.7], steps, axis=0)[:, joints]
        return replace(s, periods=1, transient_periods=0, **last)

    return replace(data, segments=tuple(single(s) for s in data.segments), q_std=robot.array("q_std"), tau_std=given)


@pytest.mark.parametrize("joints", [slice(None), slice(2, 3)])
def test_noise_that_is_given_says_nothing_of_its_colour(locked, tmp_path, joints):
    """Single periods show no scatter. Noise whose samples go together has several times its power in the band."""
    data = coloured_single_periods(locked, tmp_path, joints=joints)
    setup, first = identify(data)
    if joints == slice(2, 3):
        assert np.array_equal(setup.problem.tau_std, data.tau_std) and not setup.problem.noise_denied
    else:
        assert np.all(setup.problem.tau_std > 1.2 * data.tau_std) and setup.problem.noise_denied
        assert 0.9 < first.chi2_per_dof < 1.1


def test_colour_of_noise_that_a_cause_hid_is_seen_beside_it(locked, tmp_path):
    """The first model lacks more at excited lines than at others; beside what it lacks all are left alike."""
    data = coloured_single_periods(locked, tmp_path)
    told, first = identify(data)
    problem = replace(told.problem, tau_std=data.tau_std, q_std=data.q_std)
    nothing = Effect(torque_offset(0, "shoulder_pan_joint"), np.zeros(1))
    fit = under_own_noise(problem, replace(first, model=replace(first.model, effects=(nothing,))))
    assert fit.chi2_per_dof > 1.3
    noisy = louder(data, problem, fit)
    assert noisy.noise_denied and np.all(noisy.tau_std > 1.2 * data.tau_std)
    assert under_own_noise(noisy, fit).chi2_per_dof == pytest.approx(1.0, abs=0.1)
    lacking = [replace(g, U=g.U + 9.0 * data.tau_std * g.excited[..., None] / np.sqrt(300)) for g in problem.groups]
    worse = replace(problem, groups=tuple(lacking))
    assert louder(data, worse, under_own_noise(worse, fit)) is worse
    unsaid = replace(data, tau_std=None)
    assert louder(unsaid, problem, fit) is problem  # a guess is judged by all lines as it is raised


@pytest.fixture(scope="module")
def motions(ur10, tmp_path_factory):
    """Two motions of an arm with a little Coulomb friction, without words on noise."""
    plan = small_plan(ur10, 31, points=1, trajectory=True)
    (motion,) = plan.trajectories
    named = tuple(
        replace(motion, name=name, role=role) for name, role in (("m1", "identification"), ("m2", "validation"))
    )
    hidden = parse_effect("coulomb_friction@elbow_joint:torque=0.5", ur10)
    data = quick_experiment(replace(plan, experiments=(), trajectories=named), [hidden], seed=31)
    return replace(through_files(data, tmp_path_factory.mktemp("motions")), q_std=None, tau_std=None)


def test_a_guess_far_above_what_motions_leave_is_lowered_to_that(motions, ur10):
    """Fourth differences of a torque that moves an arm are more than those of its sensor; what a model leaves in the
    band is not."""
    guessed, (setup, _), true = set_up(motions).problem.tau_std, identify(motions), ur10.array("tau_std")
    assert np.all(guessed[:3] > 8.0 * true[:3])
    assert np.all(guessed[:2] > 8.0 * setup.problem.tau_std[:2])
    assert np.all(setup.problem.tau_std[:2] < 2.0 * true[:2])
    assert np.all(setup.problem.tau_std > 0.8 * true)


def test_noise_that_is_given_stays(motions, ur10):
    given = replace(motions, tau_std=30.0 * ur10.array("tau_std"))
    assert np.array_equal(identify(given)[0].problem.tau_std, given.tau_std)


@pytest.mark.slow
def test_causes_are_sought_again_where_they_hid_how_little_noise_there_is(motions):
    told: list[str] = []
    verdict = diagnose(motions, progress=told.append)
    assert "less noise" in told
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [("coulomb_friction", "elbow_joint")]
    # Under the noise that the baseline leaves room for the floor is more than twice what is left.
    elbow = verdict.gain.by_joint["elbow_joint"]
    assert elbow.noise_floor < 2.0 * elbow.after


def test_noise_of_the_torque_is_found_where_that_of_positions_reaches_all_joints(locked, tmp_path_factory):
    """One period of a multisine: noise of the positions is correlated over the torques of the joints, and most of it at
    high lines."""
    plan = small_plan(locked, 32, points=2, periods=2, transient_periods=1)
    data = replace(
        through_files(quick_experiment(plan, seed=32), tmp_path_factory.mktemp("one")), q_std=None, tau_std=None
    )
    last = [replace(s, periods=1, transient_periods=0, **s.part(slice(-s.period, None))) for s in data.segments]
    data = replace(data, segments=tuple(last))  # the transient tells it otherwise
    true = locked.array("tau_std")
    problem = replace(set_up(data).problem, tau_std=10.0 * true)
    lowered = with_noise_that_is_left(data, problem, fit_baseline(problem))
    found = lowered.tau_std
    assert lowered.noise_left and not problem.noise_left
    assert np.all(found > 0.8 * true)
    assert np.all(found < 2.5 * true)


@pytest.mark.parametrize(("left", "chi2", "expected"), [(True, 1.0, True), (False, 1.0, False), (True, 10.0, False)])
def test_a_law_is_widened_where_the_noise_is_what_it_has_left(identified, left, chi2, expected):
    """An error of the law is in that noise, and all is within it."""
    _, setup, baseline = identified
    problem, fit = replace(setup.problem, noise_left=left), replace(baseline, costs=chi2 * baseline.counts)
    assert nearly_settled(problem, fit, catalogue(problem.structure)[0]) is expected


def test_causes_are_sought_again_with_the_time_of_the_whole_search(monkeypatch):
    """The first search has half of it where inertias are sought too."""
    first, whole, given = Workers(), Workers(), []
    monkeypatch.setattr("ident.seek.beside_steps", lambda *args: given.append(args[-1]) or (None, None, None))
    monkeypatch.setattr("ident.seek.under_noise_seen", lambda *args: given.append(args[-1]) or (None, None, None))
    monkeypatch.setattr("ident.seek.beside_steady_records", lambda *args: given.append(args[-1]))
    sought(None, None, None, 4, whole, first)
    assert [w is first for w in given] == [True, False, False] and given[1] is given[2] is whole


@pytest.mark.parametrize("coloured", [pytest.param(False, marks=pytest.mark.slow), True])
def test_noise_that_was_raised_for_a_cause_is_let_go_once_that_is_known(
    locked, tmp_path_factory, monkeypatch, coloured
):
    """A ripple shows at lines that nothing excites as at the others; what is still left there beside it is noise."""
    plan = small_plan(locked, 35, points=2, periods=2, transient_periods=1)
    data = replace(
        through_files(quick_experiment(plan, seed=35), tmp_path_factory.mktemp("raised")), q_std=None, tau_std=None
    )
    last = [replace(s, periods=1, transient_periods=0, **s.part(slice(-s.period, None))) for s in data.segments]
    data = replace(data, segments=tuple(last))
    setup, told = identify(data)  # the model with what was found
    guess = set_up(data).problem
    raised = replace(setup.problem, q_std=3.0 * guess.q_std, tau_std=3.0 * guess.tau_std)
    if coloured:
        told = replace(told, costs=2.0 * told.counts)
        monkeypatch.setattr("ident.identification.under_own_noise", lambda problem, result: result)
        monkeypatch.setattr("ident.identification.unexcited_noise", lambda groups, whitened: 9.0)
    other, first = under_noise_beside_causes(data, replace(setup, problem=raised), told)
    assert other.problem.q_std == pytest.approx((3.0 if coloured else 1.0) * guess.q_std)
    if not coloured:
        own = make_weights(other.problem, predictions(other.problem, first.model, first.remainders), 0.0)
        assert reweighted(other.problem, first, own).costs == pytest.approx(first.costs, rel=0.02)


@pytest.mark.parametrize(
    ("joints", "given"),
    [(slice(None), False), (slice(2, 3), False), (slice(None), True), (slice(1, None), True)],
)
def test_noise_of_which_neighbouring_samples_go_together_is_no_cause(locked, tmp_path, monkeypatch, joints, given):
    """Of all joints alike it is seen at the fast lines of motions. At one joint alone it may as well be a cause, and at
    all but one where its size is given."""
    plan = small_plan(locked, 32, points=1, trajectory=True)
    (motion,) = plan.trajectories
    data = quick_experiment(replace(plan, experiments=(), trajectories=(motion,)), seed=32)
    data = replace(through_files(data, tmp_path), q_std=None, tau_std=None)
    (segment,) = data.segments
    steps = np.random.default_rng(5).normal(size=segment.tau.shape) * 20.0 * locked.array("tau_std")
    pole = 0.7 if given else 0.9
    coloured = scipy.signal.lfilter([1.0], [1.0, -pole], steps, axis=0) * np.sqrt(1.0 - pole**2)
    tau = segment.tau.copy()
    tau[:, joints] += coloured[:, joints]
    noisy = replace(segment, name="m1", role="identification", tau=tau)
    held_out = replace(noisy, name="m2", role="validation")
    tau_std = np.hypot(20.0, 1.0) * locked.array("tau_std") if given else None
    data = replace(data, segments=(noisy, held_out), tau_std=tau_std)
    setup, first = identify(data)
    raised = with_noise_of_fast_lines(data, setup.problem, first)
    assert first.chi2_per_dof > 1.5
    if joints != slice(None):
        assert raised is setup.problem
        return
    assert np.all(raised.tau_std > setup.problem.tau_std)
    ended = []

    def told(problem, baseline, until=None, **kwargs):
        ended.append(until is not None and until(baseline))
        return attribute(problem, baseline, until=until, **kwargs)

    monkeypatch.setattr("ident.seek.attribute", told)
    _, _, result = sought(data, setup, first, 0, Workers())
    assert ended == [True, False] and not result.detected
    notes = noise_note(raised, locked.array("tau_std"))
    assert bool(notes) == given == raised.noise_denied and all("not for a cause" in x for x in notes)
    assert noise_note(replace(setup.problem, tau_std=9.0 * setup.problem.tau_std), locked.array("tau_std")) == ()
