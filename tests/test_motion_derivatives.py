"""Along a motion what moves the links moves gravity and inertia: derivatives, responses and fits hold that."""

from dataclasses import replace

import numpy as np
import pytest

from ident.chain import build_structure
from ident.coordinates import pack, unpack
from ident.dataset import Dataset, Segment
from ident.derivatives import jacobian, without_friction
from ident.graybox import Parameters
from ident.hypotheses import catalogue
from ident.identification import guessed_noise, motion_band_hz, set_up
from ident.inverse import REMAINDER_STEPS
from ident.model import Effect, Model
from ident.problem import predictions
from ident.records import build_groups
from ident.screening import screen
from ident.torque_fit import fit
from tests.conftest import through_postures

RATE, SECONDS = 200.0, 20.0


def motion(robot, seed, tau_noise=0.02, hold="none"):
    """A recorded motion through many postures; its torque is noise alone."""
    rng = np.random.default_rng(seed)
    t, q, _, _ = through_postures(rng, robot.n, RATE, SECONDS)
    tau = tau_noise * rng.normal(size=q.shape)
    segment = Segment(name=f"m{seed}", role="identification", kind="trajectory", t=t, tau=tau, q=q)
    return Dataset(
        name="motion", robot=robot, sample_rate=RATE, joints=robot.joint_names, input_hold=hold,
        q_std=np.full(robot.n, 1e-6), tau_std=np.full(robot.n, 0.02), controller=None, segments=(segment,),
    )  # fmt: skip


@pytest.fixture(scope="module")
def moving(ur10):
    problem = set_up(motion(ur10, 1)).problem
    model = Model(problem.structure, problem.nominal)
    return problem, model, predictions(problem, model, [None], steps=None)


def anew(problem, model, near):
    """Outputs with the geometric remainder made anew."""
    (pred,) = predictions(problem, model, [near.solution.W], steps=REMAINDER_STEPS)
    return pred.outputs()


def test_softer_gears_move_gravity_and_inertia(moving):
    problem, model, (pred,) = moving
    group, n = problem.groups[0], problem.structure.n
    J, x = jacobian(problem, model, group, pred).dense(), pack(model)
    for j in range(n):
        step = 1e-3 * (np.arange(len(x)) == j)
        ends = [anew(problem, unpack(model, x + sign * step, np.inf), pred) for sign in (1.0, -1.0)]
        slope = group.observe((ends[0] - ends[1]) / 2e-3)
        assert np.linalg.norm(group.observe(J[..., j]) - slope) < 0.03 * np.linalg.norm(slope)


@pytest.mark.parametrize("effect", ["coulomb_friction", "load_dependent_friction"])
def test_what_moves_the_links_moves_friction_by_its_load_alone(moving, effect):
    """Differences leave out friction that sees its motor alone, and keep what grows with the load."""
    problem, model, _ = moving
    laws = [h for h in catalogue(problem.structure, motions_alone=True) if h.effect == effect]
    sizes = {"coulomb_friction": [20.0, 0.1, 1e-3], "load_dependent_friction": [0.3, 1e-3]}[effect]
    payload = next(h for h in catalogue(problem.structure) if h.effect == "payload")
    load = Effect(payload, payload.options["start"](np.array([2.0, 0.1, 0.0, 0.2])))
    full = replace(model, effects=(*(Effect(h, np.array(sizes)) for h in laws), load))
    (pred,) = predictions(problem, full, [None], steps=None)
    group, x = problem.groups[0], pack(full)
    J = group.observe_outputs(jacobian(problem, full, group, pred).dense())
    for c in (0, 1, 2, len(x) - 7):  # gears, and the mass
        step = 1e-3 * (np.arange(len(x)) == c)
        ends = [anew(problem, unpack(full, x + sign * step, np.inf), pred) for sign in (1.0, -1.0)]
        slope = group.observe((ends[0] - ends[1]) / 2e-3)
        assert np.linalg.norm(J[..., c] - slope) < 0.03 * np.linalg.norm(slope)


def test_friction_of_the_motor_is_left_out_where_nothing_but_its_motion_moves_it(moving):
    """Not beside a drive whose torque is no longer that of the motor, nor beside friction that sees the load."""
    problem, model, _ = moving
    named = {h.key: h for h in catalogue(problem.structure, motions_alone=True)}

    def left(*keys):
        effects = tuple(Effect(named[key], np.ones(len(named[key].parameters))) for key in keys)
        kept = without_friction(replace(model, effects=effects), problem.groups[0])
        return [e.hypothesis.key for e in kept.effects]

    rubs, ripple = ("coulomb_friction", "elbow_joint"), ("cogging", "elbow_joint")
    assert left(rubs, ripple) == [ripple]
    for beside in (("torque_saturation", "elbow_joint"), ("load_dependent_friction", "elbow_joint")):
        assert left(rubs, beside) == [rubs, beside]
    elsewhere = ("torque_saturation", "wrist_1_joint")
    assert left(rubs, elsewhere) == [elsewhere]
    assert without_friction(model, problem.groups[0]) is model


@pytest.fixture(scope="module")
def yielding(moving):
    """The problem as recorded with an element in a gear that yields and holds 0.6 of its limit where the motion begins,
    and that effect."""
    problem, model, _ = moving
    h = next(h for h in catalogue(problem.structure) if h.key == ("hysteresis", "shoulder_lift_joint"))
    p = np.array([model.par.stiffness[1], 40.0, 20.0, 0.0, 0.6])
    true = replace(model, effects=(Effect(h, p),))
    (pred,) = predictions(problem, true, [None], steps=None)
    group = problem.groups[0]
    return (
        replace(problem, groups=(replace(group, U=group.U + pred.U, U_periods=group.U_periods + pred.U[:, None]),)),
        true,
        pred,
    )


def test_what_an_element_holds_where_a_motion_begins_is_felt(yielding):
    """As one step of the remainder tells it: the element yields a little elsewhere, which the next ones add."""
    problem, true, pred = yielding
    group, step = problem.groups[0], 0.02
    J = jacobian(problem, true, group, pred).dense()[..., -1]
    ends = [
        anew(problem, replace(true, effects=(replace(e, p=e.p + sign * step * np.eye(5)[-1]),)), pred)
        for e in true.effects
        for sign in (1.0, -1.0)
    ]
    slope = group.observe((ends[0] - ends[1]) / (2.0 * step))
    assert np.linalg.norm(slope) > 0.0
    assert np.linalg.norm(group.observe(J) - slope) < 0.25 * np.linalg.norm(slope)


def test_a_fit_finds_what_an_element_holds_where_a_motion_begins(yielding):
    """From none of it. It ends a little short of the minimum, where the data would tell it within 0.02."""
    problem, true, _ = yielding
    effect = true.effects[0]
    begun = replace(effect, p=np.array([0.7, 0.8, 1.0, 1.0, 0.0]) * effect.p)
    found = fit(problem, replace(true, effects=(begun,)), iterations=20)
    assert found.chi2_per_dof < 1.2
    assert found.model.effects[0].value("yield_torque") == pytest.approx(40.0, rel=0.05)
    assert found.model.effects[0].value("start") == pytest.approx(0.6, abs=0.15)


@pytest.fixture(scope="module")
def eccentric(moving):
    """The problem as recorded by an encoder that errs by 10 mrad once a turn, and that effect."""
    problem, model, _ = moving
    hidden = next(h for h in catalogue(problem.structure) if h.key == ("encoder_eccentricity", "wrist_1_joint"))
    true = replace(model, effects=(Effect(hidden, np.array([8e-3, -6e-3])),))
    (pred,) = predictions(problem, true, [None], steps=None)
    group = problem.groups[0]
    return replace(
        problem, groups=(replace(group, U=group.U + pred.U, U_periods=group.U_periods + pred.U[:, None]),)
    ), true


def test_a_fit_of_a_position_error_ends_where_it_is(eccentric):
    problem, true = eccentric
    effect = true.effects[0]
    found = fit(problem, replace(true, effects=(replace(effect, p=0.5 * effect.p),)), iterations=8)
    assert found.model.effects[0].p == pytest.approx(effect.p, abs=1e-4)
    assert found.chi2_per_dof < 1.2
    again = fit(problem, found.model, remainders=found.remainders, iterations=20)
    assert again.cost < found.cost + 1.0


def test_a_position_error_is_screened_with_what_it_moves(eccentric):
    """At its own joint first, and with a start that is nearly right: gravity and inertia beside a constant posture
    would not do."""
    problem, true = eccentric
    baseline = fit(problem, replace(true, effects=()), iterations=1, hold=1e6)
    preds = predictions(problem, baseline.model, baseline.remainders)
    turning = [h for h in catalogue(problem.structure) if h.effect == "encoder_eccentricity"]
    best = screen(problem, baseline, preds, turning)[0]
    assert best.hypothesis.place == "wrist_1_joint"
    assert best.start == pytest.approx(true.effects[0].p, rel=0.1)


@pytest.mark.parametrize(("hold", "folded"), [("none", 0.2), ("zoh", 0.2), ("none", 0.02)])
def test_torque_of_a_faster_loop_that_folds_into_a_log_is_noise(ur10, hold, folded):
    """Ten times the noise that is given circulates between the samples: of a torque that is held it is a torque as any
    other."""
    data = motion(ur10, 2, folded, hold)
    loud = hold == "none" and folded > 0.1
    assert set_up(data).problem.tau_std == pytest.approx(np.full(ur10.n, folded if loud else 0.02), rel=0.1)
    assert guessed_noise(data) == [False, loud]


@pytest.mark.parametrize("band_hz", [1.6, 8.0])
def test_the_ends_of_a_motion_are_tapered_by_the_width_of_the_band(ur10, band_hz):
    (group,) = build_groups(motion(ur10, 3), motion_band_hz=band_hz)
    t = np.arange(group.n_time) * group.period_time / group.n_time
    rising = t[np.argmax(group.window > 0.999)]
    assert rising == pytest.approx(max(0.5, 2.0 / band_hz), abs=0.06)


def test_the_band_of_motions_is_that_of_the_fitted_ones(ur10):
    """Held-out motions that go to where the arm swings slowest do not narrow it; fitted ones do."""
    (bent,) = motion(ur10, 2).segments
    bent = replace(bent, q=bent.q + np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]))
    data = motion(ur10, 3)

    def band(*segments):
        return motion_band_hz(replace(data, segments=segments), build_structure(ur10), Parameters.nominal(ur10))

    (stretched,) = data.segments
    alone, other = band(stretched), band(bent)
    low, high = (stretched, bent) if alone < other else (bent, stretched)
    assert band(low) < 0.98 * band(high)
    assert band(high, replace(low, name="held out", role="validation")) == band(high)
    assert band(high, replace(low, name="fitted")) == band(low)
