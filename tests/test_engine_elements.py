"""Effects as elements of a physics engine: friction by a soft constraint, which turns before the velocity does, or by
a bristle; lags that are stepped in time."""

from dataclasses import dataclass
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.hypotheses import catalogue
from ident.hypotheses.friction import dry
from ident.model import Effect
from ident.pruning import LED, SAMPLED, plainly_special, turns_within
from sim.effects.structure import add_spring
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files

STEP = 1e-4
HINGE = """
<mujoco>
  <option timestep="{step}" gravity="0 0 0"/>
  <worldbody><body><joint name="hinge" type="hinge" armature="0.3" frictionloss="{friction}"/>
  <geom size="0.01" mass="1e-6"/></body></worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


def hinge_of_mujoco(friction, torque):
    """Velocity, acceleration and friction of a hinge whose constraint is as soft as by default."""
    model = mujoco.MjModel.from_xml_string(HINGE.format(step=STEP, friction=friction))
    data, out = mujoco.MjData(model), []
    for u in torque:
        data.ctrl[:] = u
        mujoco.mj_forward(model, data)
        out.append((data.qvel[0], data.qacc[0], -data.qfrc_constraint[0]))
        mujoco.mj_step(model, data)
    return np.array(out).T


def test_the_turn_of_a_soft_constraint_is_that_of_mujoco():
    """``clip((v + lead v') / width)``: of a default ``solref`` of 0.02 s and ``solimp`` of 0.9 to 0.95 the lead is
    9.5 ms."""
    friction, period = 0.8, 2.0
    t = np.arange(round(3 * period / STEP)) * STEP
    torque = 2.0 * np.sin(2 * np.pi * t / period) + 1.2 * np.sin(2 * np.pi * 3 * t / period + 1.0)
    v, acceleration, found = (x[-round(period / STEP) :] for x in hinge_of_mujoco(friction, torque))
    lead = 0.95 * 0.02 / 2
    width = friction * (1 - 0.9) / 0.9 / 0.3 * lead
    assert found == pytest.approx(friction * np.clip((v + lead * acceleration) / width, -1.0, 1.0), abs=1e-3)
    motion = SimpleNamespace(
        v=lambda j: v[None], time_step=STEP, kept=lambda key, make: make(), told=(), group=SimpleNamespace(rest=None)
    )
    # Where it slips the acceleration steps, which differences of the velocity blur.
    led, plain = (np.mean(np.abs(dry(motion, 0, width, friction, lead=x)[0] - found)) for x in (lead, 0.0))
    assert led < 0.005 * friction and plain > 8.0 * led


@dataclass(frozen=True)
class SoftFriction:
    """A ``frictionloss`` of MuJoCo with a ``solref`` of its own, at a motor or, beside a spring, at a link."""

    place: str
    friction: float
    solref: float
    stiffness: float = 0.0

    def edit(self, spec, robot, drives):
        joint = spec.joint(f"{'link' if self.stiffness else 'motor'}:{self.place}")
        joint.frictionloss, joint.solref_friction = self.friction, [self.solref, 1.0]
        if self.stiffness:
            add_spring(joint, self.stiffness, 0.0)


@dataclass(frozen=True)
class Bristle:
    """The friction of a ``dcmotor`` of MuJoCo, LuGre's with a Stribeck dip, without windings or input."""

    place: str
    lugre: tuple[float, ...]

    def edit(self, spec, robot, drives):
        motor = spec.add_actuator(name="bristle", target=f"motor:{self.place}")
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        none = int(mujoco.mjtCtrlInput.mjINPUT_NONE)
        motor.set_to_dcmotor(motorconst=[0.0, 0.0], resistance=1.0, ctrlspec=none, lugre=list(self.lugre))


@dataclass(frozen=True)
class SteppedLag:
    """A first-order lag that is stepped ``every`` s, and delivers what it held before or after the step."""

    place: str
    time_constant: float
    every: float
    before: bool

    def deliver(self, run):
        steps, decay, held = round(self.every / run.step), np.exp(-self.every / self.time_constant), [0.0, 0.0]

        def step(u, k):
            if k % steps == 0:
                held[:] = held[1], decay * held[1] + (1.0 - decay) * u
            return held[0 if self.before else 1]

        return step


@pytest.mark.parametrize("before", [True, False])
def test_a_lag_that_is_stepped_in_time_is_measured(locked, tmp_path, before):
    """By half of a step it comes later or sooner: a quarter of its time constant here."""
    plan = small_plan(locked, 8, points=1, levels=(1.0,), period=2000)
    hidden = SteppedLag("elbow_joint", 2e-3, 1e-3, before)
    data = quick_experiment(plan, [hidden], seed=8, drives=draw_drives(np.random.default_rng(8), locked))
    verdict = diagnose(through_files(data, tmp_path))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.1] == [("torque_lag", "elbow_joint")]
    found = verdict.causes[0].parameters
    assert found["time_constant"].value == pytest.approx(2e-3, rel=0.03)
    assert found["stepped"].value == pytest.approx(0.25 if before else -0.25, abs=0.06)
    assert verdict.unexplained_verdict == "noise floor reached"


@pytest.mark.parametrize(
    ("stiffness", "damping", "within"),
    [
        (3e5, 0.0, {"static": 0.1}),  # it slips within the steps of time and the noise of the position
        (3e4, 30.0, {"static": 0.03, "stribeck_velocity": 0.1, "stiffness": 0.03}),
    ],
)
def test_a_bristle_whose_friction_falls_with_speed_is_a_stribeck_friction(locked, tmp_path, stiffness, damping, within):
    truth = {"stiffness": stiffness, "coulomb": 2.0, "static": 4.0, "stribeck_velocity": 0.03}
    plan = small_plan(locked, 8, points=1, levels=(1.0,), period=2000)
    data = quick_experiment(
        plan,
        [Bristle("elbow_joint", (stiffness, damping, 2.0, 4.0, 0.03))],
        seed=8,
        drives=draw_drives(np.random.default_rng(8), locked),
    )
    verdict = diagnose(through_files(data, tmp_path))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.1] == [
        ("stribeck_friction", "elbow_joint")
    ]
    assert verdict.causes[0].probability > 0.9
    for name, error in within.items():
        assert verdict.causes[0].parameters[name].value == pytest.approx(truth[name], rel=error)
    assert verdict.unexplained_verdict == "noise floor reached"


@pytest.mark.parametrize(
    ("hidden", "name", "size"),
    [
        (SoftFriction("elbow_joint", 6.0, 0.02), "coulomb_friction", "torque"),
        (SoftFriction("elbow_joint", 6.0, 0.004), "coulomb_friction", "torque"),
        (SoftFriction("elbow_joint", 2.0, 0.02, 10.0), "dress_pack", "friction"),
    ],
)
def test_a_friction_that_is_a_soft_constraint_is_named_and_measured(locked, tmp_path, hidden, name, size):
    plan = small_plan(locked, 8, points=1, levels=(1.0,), period=2000)
    data = quick_experiment(plan, [hidden], seed=8, drives=draw_drives(np.random.default_rng(8), locked))
    verdict = diagnose(through_files(data, tmp_path))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.1] == [(name, "elbow_joint")]
    assert verdict.causes[0].probability > 0.9
    assert verdict.causes[0].parameters[size].value == pytest.approx(hidden.friction, rel=0.05)
    assert verdict.unexplained_verdict == "noise floor reached"


def test_a_dip_within_velocities_that_pass_in_a_fraction_of_a_sample_or_by_which_a_friction_leads_is_none(identified):
    """Between samples nothing tells its size, and a soft constraint takes what is asked of it there, whatever that
    is."""
    _, setup, result = identified
    dip = next(
        h
        for h in catalogue(setup.problem.structure)
        if h.effect == "stribeck_friction" and any(q.name == "lead" for q in h.parameters)
    )

    def special(width, lead):
        return plainly_special(setup.problem, result.model, Effect(dip, np.array([2.0, 4.0, width, 1e-3, 2.0, lead])))

    sample = setup.problem.sampling.sample_time
    lead = 4.0 * sample
    led, sampled = (
        turns_within(setup.problem, Effect(dip, np.array([2.0, 4.0, 0.1, 1e-3, 2.0, x]))) for x in (lead, 0)
    )
    accelerations = [
        np.sqrt(np.mean(g.to_time(-(g.omega[:, None] ** 2) * g.signal_share * g.Q)[..., dip.joint] ** 2))
        for g in setup.problem.groups
    ]
    assert led == pytest.approx([LED * lead * a for a in accelerations], rel=1e-6)
    assert sampled == pytest.approx([SAMPLED * sample * a for a in accelerations], rel=1e-6)
    assert special(0.5 * min(led), lead) and special(0.5 * min(sampled), 0.0)
    assert not special(2.0 * max(led), lead) and not special(2.0 * max(sampled), 0.0)
