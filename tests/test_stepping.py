"""Records of a simulation with a coarse time step: its error is known, and is no cause."""

from types import SimpleNamespace

import numpy as np
import pytest

from ident.chain import build_structure
from ident.diagnosis import diagnose
from ident.graybox import Parameters, equilibrium, impedance, linearise
from ident.identification import identify
from ident.roll_off import told_by_most
from ident.stepping import shown_steps, told_by
from ident.time_steps import TimeSteps, differences
from sim import parse_effect
from sim.experiment import draw_drives
from tests.conftest import quick_experiment, small_plan, through_files


@pytest.mark.parametrize("dampers", ["implicit", "explicit", "apart"])
def test_the_impedance_is_that_of_an_arm_stepped_by_semi_implicit_euler(locked, dampers):
    structure, par = build_structure(locked), Parameters.nominal(locked)
    lin = linearise(structure, equilibrium(structure, par, np.array([0.3, -0.8, 0.9])))
    n, h = structure.n, 1e-3
    K = np.block(
        [[np.diag(par.stiffness), -np.diag(par.stiffness)], [-np.diag(par.stiffness), np.diag(par.stiffness) + lin.Kg]]
    )
    d = np.diag(par.damping)
    D = np.block([[d + np.diag(par.viscous), -d], [-d, d]])
    M = np.block([[np.diag(par.inertia), np.zeros((n, n))], [np.zeros((n, n)), lin.M]])
    seen_ahead = {"implicit": D, "explicit": 0.0 * D, "apart": np.diag(np.diag(D))}[dampers]  # after the step
    ahead = M + h * seen_ahead
    of_rate, of_place = np.eye(2 * n) - h * np.linalg.solve(ahead, D), -h * np.linalg.solve(ahead, K)
    A = np.block([[np.eye(2 * n) + h * of_place, h * of_rate], [of_place, of_rate]])
    pushed = h * np.linalg.solve(ahead, np.eye(2 * n)[:, :n])
    B = np.concatenate([h * pushed, pushed])
    s = 2j * np.pi * np.array([1.0, 7.0, 20.0, 60.0])
    Z = impedance(structure, par, lin, s, TimeSteps(h, dampers))[0]
    for w, found in zip(s, Z, strict=True):
        per_torque = np.linalg.solve(np.exp(w * h) * np.eye(4 * n) - A, B)[:n]
        assert found @ per_torque == pytest.approx(np.eye(n), abs=1e-8)


def test_small_steps_are_continuous_time():
    s = 2j * np.pi * np.linspace(0.0, 80.0, 9)
    for steps in (TimeSteps(1e-9, "implicit"), TimeSteps(1e-9, "explicit"), None):
        rate, square = differences(s, steps)
        assert rate == pytest.approx(s, rel=1e-6) and square == pytest.approx(s**2, rel=1e-6)


def recorded(robot, folder, effects=(), **stepped):
    """Records of an arm with drives off nominal, under a time step and an integrator."""
    drives = draw_drives(np.random.default_rng(7), robot)
    plan = small_plan(robot, 7, levels=(1.0,), period=1000)
    return through_files(quick_experiment(plan, effects, seed=7, drives=drives, **stepped), folder)


@pytest.mark.parametrize(
    ("integrator", "timestep", "steps"),
    [
        ("EULER", 5e-4, TimeSteps(5e-4, "explicit")),  # gears are tendons, whose damping MuJoCo takes so
        ("IMPLICITFAST", 1e-3, TimeSteps(1e-3, "apart")),
        ("RK4", 1e-3, None),
    ],
)
def test_the_time_step_of_a_simulation_is_found_where_it_shows(locked, tmp_path, integrator, timestep, steps):
    setup, baseline = identify(recorded(locked, tmp_path, timestep=timestep, integrator=integrator))
    assert {g.steps for g in (*setup.problem.groups, *setup.held_out)} == {steps}
    assert baseline.chi2_per_dof < 1.1
    assert shown_steps(setup.problem, baseline) is None


@pytest.mark.parametrize(("left", "told"), [(1.08, True), (1.5, False)])
def test_what_joints_share_need_not_explain_noise_that_is_known_too_small(left, told):
    """Of a tenth more than noise as it is known, it explains a little at all joints; of more that has other causes, too
    little."""
    counts = np.full(6, 1e4)
    before = SimpleNamespace(costs=left * counts, counts=counts)
    assert told_by_most(before, SimpleNamespace(costs=left * counts - 50.0, counts=counts)) == told
    assert not told_by_most(before, before)


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ([2.0, 2.0, 2.0, 1.0, 9.0], [1.0, 1.0, 1.0, 0.9, 8.9], True),  # a cause at the last joint
        (
            [0.7, 0.7, 0.7, 1.9, 4.9],
            [0.5, 0.5, 0.5, 1.8, 3.6],
            False,
        ),  # noise that is known too large hides what is left
    ],
)
def test_steps_are_told_by_joints_that_leave_more_than_noise_without_them(before, after, told):
    counts = np.full(5, 1e4)
    fits = [SimpleNamespace(costs=counts * x, counts=counts) for x in (before, after)]
    assert told_by(*fits) is told


@pytest.mark.slow
def test_a_cause_in_records_of_coarse_steps_is_named_alone(locked, tmp_path):
    hidden = parse_effect("coulomb_friction@elbow_joint:torque=3", locked)
    verdict = diagnose(recorded(locked, tmp_path, [hidden], timestep=1e-3, integrator="IMPLICITFAST"))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [("coulomb_friction", "elbow_joint")]
    assert verdict.causes[0].parameters["torque"].value == pytest.approx(3.0, rel=0.05)
    assert any("time steps of 1 ms" in note for note in verdict.notes)
