"""Noise of the position, in both factors of the normal equations: taken off exactly, and no further than the data
bear."""

from dataclasses import replace

import numpy as np
import pytest

from ident.coordinates import coordinate_names, pack, unpack
from ident.costs import by_noise, fair_costs, joint_costs
from ident.derivatives import shared_information, shared_slope
from ident.errors_in_variables import MOST, information_left, trusted_share
from ident.extended import predict
from ident.hypotheses import catalogue
from ident.identification import identify, set_up
from ident.inverse import REMAINDER_STEPS
from ident.model import Effect, Model
from ident.problem import predictions
from ident.refits import refit
from ident.torque_fit import fit
from ident.weights import make_weights
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan

pytestmark = pytest.mark.xdist_group("errors_in_variables")  # one worker makes what they share

STEP = 1e-5


def with_effects(model, *named):
    """A model with effects, each by its name and parameters: of the catalogue at the elbow, and a payload."""
    laws = [h for h in catalogue(model.structure) if h.place in ("elbow_joint", "flange")]
    of = {(h.effect, len(h.parameters)): h for h in reversed(laws)}  # encoders at the joint
    return replace(model, effects=tuple(Effect(of[name, len(p)], np.array(p)) for name, *p in named))


ECCENTRIC, PAYLOAD = ("encoder_eccentricity", 0.1, 0.05), ("payload", 2.0, 0.02, 0.0, 0.05, 0.01, 0.01, 0.01)
MOVED = [
    (ECCENTRIC,),
    (("unknown:position_scale", 1.1),),
    (("gravity_spring", 500.0, 0.3),),
    (("gravity_spring", 500.0, 0.3, -1.0, 2.0),),
    (("dress_pack", 200.0, 1e-3, 1e-2, 0.0),),
    (PAYLOAD, ECCENTRIC),
]


@pytest.mark.parametrize("named", [(), *MOVED], ids=str)
def test_small_changes_of_the_position_are_passed_on_as_told(identified, named):
    """Also in the posture that an error of the encoder leads to, and with a spring to the link."""
    _, setup, result = identified
    model, rng = with_effects(result.model, *named), np.random.default_rng(0)
    for group in setup.problem.groups:
        K, change = group.n_compared, np.zeros_like(group.Q)
        change[:, 1:K] = 1e-6 * (rng.normal(size=change[:, 1:K].shape) + 1j * rng.normal(size=change[:, 1:K].shape))
        pred = predict(model, group, setup.problem.sampling)
        more, less = (
            predict(model, replace(group, Q=group.Q + x), setup.problem.sampling).U for x in (change, -change)
        )
        passed = np.einsum("lij,slj->sli", pred.sampled_impedance, change)
        power = [np.sum(np.abs(x[:, 1:K]) ** 2, axis=(0, 1)) for x in (0.5 * (more - less) - passed, passed)]
        assert np.all(power[0] < 0.06**2 * power[1])


@pytest.mark.parametrize(
    "named",
    [
        (),
        (("torque_lag", 1e-3, 0.0),),
        (("sensor_delay", 1e-3),),
        (("unknown:link_friction", 20.0),),
        (("torque_constant", 1.1),),
        *MOVED,
    ],
    ids=str,
)
def test_the_slope_of_what_noise_adds_is_its_derivative(identified, named):
    _, setup, result = identified
    problem, model = setup.problem, with_effects(result.model, *named)
    settled = predictions(problem, model, result.remainders, steps=REMAINDER_STEPS)
    remainders = [pred.solution.W for pred in settled]
    preds = predictions(problem, model, remainders)
    weights = make_weights(problem, preds, 0.0)
    slope, x = shared_slope(problem, model, preds, weights), pack(model)

    def cost(step):
        there = unpack(model, x + step, np.inf)
        return np.sum(by_noise(problem, predictions(problem, there, remainders), weights))

    size = np.ones(len(x))
    size[coordinate_names(model).index("timing")] = problem.sampling.sample_time
    each = STEP * np.diag(size)
    numeric = [(cost(step) - cost(-step)) / (2.0 * STEP) for step in each]
    # That softer gears sag is left out of the slope, and the steps of a load are coarse.
    close = 5e-2 if PAYLOAD in named else 1e-2 if named in MOVED else 5e-3
    assert -2.0 * slope * size == pytest.approx(numeric, rel=close, abs=2e-4 * np.abs(numeric).max())


@pytest.fixture(scope="module")
def noisy(ur10):
    """(problem, true parameters) at ten times the noise of the arm."""
    drives = draw_drives(np.random.default_rng(6), ur10)
    problem = set_up(quick_experiment(small_plan(ur10, 6, periods=4), seed=6, drives=drives, noise=10.0)).problem
    names = {"stiffness": "stiffness", "damping": "damping", "inertia": "motor_inertia", "viscous": "viscous_friction"}
    return problem, replace(problem.nominal, **{mine: drives[its] for mine, its in names.items()})


def test_noise_of_the_position_moves_no_parameter(noisy, monkeypatch):
    """At ten times the noise of the arm errors are as large as their deviations say; of plain least squares, twice
    that."""
    problem, truth = noisy

    def off():
        found = fit(problem, Model(problem.structure, truth), iterations=40)
        found = fit(problem, found.model, iterations=40)
        error = found.model.par.to_log() - truth.to_log()
        return error / np.sqrt(np.diag(found.covariance()))[: len(error)]

    assert np.sqrt(np.mean(off() ** 2)) < 1.3 and np.abs(off()).max() < 4.0
    for module in ("torque_fit", "weights", "costs"):
        monkeypatch.setattr(f"ident.{module}.has_scatter", lambda *args: False)
    assert np.sqrt(np.mean(off() ** 2)) > 2.0 and np.abs(off()).max() > 5.0


@pytest.mark.slow
def test_noise_of_the_position_moves_no_parameter_in_a_single_period(ur10, monkeypatch):
    """The same where the end of a transient alone tells of the noise."""
    drives = draw_drives(np.random.default_rng(6), ur10)
    data = quick_experiment(small_plan(ur10, 6, periods=2), seed=6, drives=drives, noise=10.0)
    data = replace(data, q_std=None, tau_std=None)
    names = ("stiffness", "damping", "motor_inertia", "viscous_friction")
    truth = np.log(np.concatenate([drives[name] for name in names]))

    def off():
        setup, found = identify(data)
        assert all(g.U_periods.shape[1] == 1 for g in setup.problem.groups)
        return (found.model.par.to_log() - truth) / np.sqrt(np.diag(found.covariance()))[: len(truth)]

    assert np.sqrt(np.mean(off() ** 2)) < 1.3 and np.abs(off()).max() < 4.0
    monkeypatch.setattr("ident.identification.with_known_noise", lambda problem: problem)
    assert np.sqrt(np.mean(off() ** 2)) > 2.0


@pytest.mark.parametrize("factor, periods", [(0.5, 4), (2.0, 4), (0.5, 1), (2.0, 1)])
def test_the_noise_that_a_model_passes_on_counts_neither_for_nor_against_it(clean, factor, periods):
    """Of a stiffer and of a softer gear that is what they are off by without noise, and of plain sums of squares far
    from it.

    By the scatter between periods, or the noise that is known of one.
    """
    problem, j = set_up(clean[0]).problem, 3
    group, rng = next(g for g in problem.groups if g.window is None), np.random.default_rng(1)
    truth = Model(problem.structure, problem.nominal)
    stiffness = np.where(np.arange(problem.structure.n) == j, factor, 1.0) * truth.par.stiffness
    wrong = replace(truth, par=replace(truth.par, stiffness=stiffness))
    quiet = replace(group, Q=np.concatenate([group.Q[:, :1], 1e-3 * group.Q[:, 1:]], axis=1))
    draw = rng.normal(size=(4, len(quiet.Q), periods, *quiet.Q.shape[1:])) * (np.arange(quiet.Q.shape[1]) > 0)[:, None]
    U, U_wrong = (predict(m, quiet, problem.sampling, steps=REMAINDER_STEPS).U for m in (truth, wrong))
    Q = quiet.Q[:, None] + 1e-6 * (draw[0] + 1j * draw[1])
    U_periods = U[:, None] + 1e-4 * (draw[2] + 1j * draw[3])
    noisy = replace(quiet, Q=Q.mean(axis=1), U=U_periods.mean(axis=1), Q_periods=Q, U_periods=U_periods)
    problem = replace(problem, groups=(noisy,), scatter_share=1.0)
    if periods == 1:
        line, unit = (2e-8, 2e-12), np.ones(problem.structure.n)
        tau_std, q_std = (np.sqrt(x * problem.samples(noisy)) * unit for x in line)
        noisy = replace(noisy, known_noise=tuple(x * unit for x in line))
        problem = replace(problem, groups=(noisy,), tau_std=tau_std, q_std=q_std)
    preds = [predictions(problem, m, [None], REMAINDER_STEPS) for m in (truth, wrong)]
    weights = make_weights(problem, preds[0], 0.0)
    off = float(np.sum(np.abs(weights.apply(0, (U - U_wrong)[:, : group.n_compared])) ** 2))
    plain, fair = (
        float(np.diff([np.sum(of(p)) for p in preds])[0])
        for of in (lambda p: joint_costs(problem, p, weights), lambda p: fair_costs(problem, p, weights))
    )
    chance = 3.0 * 2.0 * np.sqrt(off) + 3.0 * np.sqrt(2.0 * np.sum(weights.by_noise))
    assert abs(fair - off) < chance < 0.3 * abs(plain - off)


def test_no_more_is_taken_off_than_leaves_information(identified):
    _, setup, result = identified
    problem = setup.problem
    preds = predictions(problem, result.model, result.remainders)
    taken_by_noise = shared_information(problem, result.model, preds, result.weights)
    H, q = result.information, len(taken_by_noise)
    assert trusted_share(H, taken_by_noise) == 1.0
    root = np.linalg.cholesky(H)
    padded = np.zeros_like(H)
    padded[:q, :q] = taken_by_noise
    largest = np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, padded).T)).max()
    assert trusted_share(H, 2.0 / largest * taken_by_noise) == 0.0
    for factor in (0.5 / largest, 1.0 / largest, 1.4 / largest):
        taken = trusted_share(H, factor * taken_by_noise) * factor * taken_by_noise
        left = H.copy()
        left[:q, :q] -= taken
        ratio = np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, left).T))
        assert ratio.min() > 1.0 - MOST - 1e-6
        kept = information_left(H, taken)
        assert np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, H - kept).T)).min() > -1e-6
    unfelt = H * np.outer(np.arange(len(H)) > 0, np.arange(len(H)) > 0)
    assert not np.any(information_left(unfelt, 0.0 * taken_by_noise)[0])
    assert information_left(H, 0.0 * taken_by_noise) == pytest.approx(H, rel=1e-6, abs=1e-6 * np.abs(H).max())


def test_an_effect_that_the_data_do_not_feel_is_no_candidate(identified):
    _, setup, result = identified
    h = next(
        h for h in catalogue(setup.problem.structure) if (h.effect, h.place) == ("torque_saturation", "elbow_joint")
    )
    model = replace(result.model, effects=(Effect(h, np.array([1e6, 0.03])),))
    assert refit(setup.problem, model, result.weights, result.remainders, 1) is None


@pytest.mark.parametrize("law", [ECCENTRIC, ("unknown:position_scale", 1.1), ("sensor_lag", 1e-3, 0.0)])
def test_an_encoder_passes_on_the_noise_that_its_law_is_not_shown(identified, law):
    """With its slope, as the noise of the model has it. Where it did not another inertia would leave less of it, and
    noise alone would name an encoder out of centre."""
    _, setup, first = identified
    problem, group = setup.problem, setup.problem.groups[0]
    model = with_effects(first.model, law)
    j = model.effects[-1].hypothesis.joint
    hidden = np.all(group.signal_share[..., j] == 0.0, axis=0)
    assert 10 < hidden.sum() < len(hidden)
    less = replace(group, Q=group.Q * ~(hidden[:, None] & (np.arange(problem.structure.n) == j)))
    whole, silent = (predict(model, g, problem.sampling, W=first.remainders[0], steps=0) for g in (group, less))
    expected = np.einsum("li,sl->sli", whole.sampled_impedance[..., j], group.Q[..., j])
    found = whole.outputs() - silent.outputs()
    assert np.abs(found - expected)[:, hidden].max() < 0.02 * np.abs(expected[:, hidden]).max()
    assert np.abs(found[:, ~hidden]).max() < 0.02 * np.abs(found[:, hidden]).max()


@pytest.mark.parametrize(("told", "taken"), [(1.0, 1.0), (0.7, 0.0)])
def test_of_gears_with_laws_noise_is_taken_off_as_a_whole_or_not_at_all(identified, monkeypatch, told, taken):
    """It is told as of linear ones: where it is more than there can be a gear that hardens much had ended 2 % off, with
    a twentieth of its deviation."""
    _, setup, best = identified
    gear = next(h for h in catalogue(setup.problem.structure) if h.key == ("hardening_stiffness", "elbow_joint"))
    monkeypatch.setattr("ident.torque_fit.trusted_share", lambda *args: told)
    hard = replace(best.model, effects=(Effect(gear, np.array([1e6])),))
    shares = [fit(setup.problem, m, iterations=1, remainders=best.remainders).share for m in (best.model, hard)]
    assert shares == [told, taken]
