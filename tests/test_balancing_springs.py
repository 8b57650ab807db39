"""Springs between two points of a machine, against their energy and in motions that go far."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.chain import build_structure
from ident.dataset import Segment
from ident.diagnosis import diagnose
from ident.hypotheses.link_springs import spring_between_points
from robot_assets.robot import load_robot
from tests.conftest import of_motions, through_files, through_postures

NEAR, FAR, FREE = 0.12, 0.5, 0.23  # m, of the points from the axis, and the length at which the spring is slack
Q = np.linspace(-2.5, 2.5, 101)


def torque(spring, x):
    """Of a spring, N/m, at the angle ``x`` from its shortest: the slope of its energy."""
    length = np.sqrt(NEAR**2 + FAR**2 - 2.0 * NEAR * FAR * np.cos(x))
    return spring * (length - FREE) * NEAR * FAR * np.sin(x) / length


def shape(spring):
    """Parameters of the law of that spring, but for its rest."""
    shortest = FAR - NEAR
    taut = 1.0 - FREE / shortest
    stiffness = spring * NEAR * FAR * taut
    return stiffness, 1.0 - 1.0 / taut, 2.0 * NEAR * FAR / shortest**2


def of(p, q):
    return spring_between_points(0, "axis").law(np.array(p), SimpleNamespace(q_link=lambda j: q), 0, 1.0)


def test_the_torque_is_the_slope_of_the_energy():
    stiffness, share, stretch = shape(3e3)
    assert of([stiffness, 0.3, share, stretch], Q) == pytest.approx(torque(3e3, Q - 0.3), abs=1e-9)


def test_a_gas_spring_pushes_alike_at_any_length():
    force, length = 200.0, np.sqrt(NEAR**2 + FAR**2 - 2.0 * NEAR * FAR * np.cos(Q))
    _, _, stretch = shape(1.0)
    stiffness = force * NEAR * FAR / (FAR - NEAR)
    assert of([stiffness, 0.0, 1.0, stretch], Q) == pytest.approx(force * NEAR * FAR * np.sin(Q) / length, abs=1e-9)


@given(share=st.floats(-4.0, 1.0), stretch=st.floats(0.01, 100.0), rest=st.floats(-3.0, 3.0))
def test_the_slope_is_that_of_the_torque(share, stretch, rest):
    p, step = [1.0, rest, share, stretch], 1e-6
    slope = spring_between_points(0, "axis").options["slope"](p, Q)
    assert slope == pytest.approx((of(p, Q + step) - of(p, Q - step)) / (2.0 * step), abs=1e-6)


def test_a_spring_between_two_points_is_no_ripple_in_motions_that_go_far(tmp_path):
    """A wave of whatever length draws nearly the same over a part of a turn."""
    robot, rng = load_robot("twomass"), np.random.default_rng(4)
    drive, spring = robot.joints[0], 3e3
    inertia = drive.motor_inertia + float(build_structure(robot).model.inertias[1].inertia[2, 2])
    segments = []
    for k in range(3):
        t, q, v, a = through_postures(rng, 1, 500.0, 20.0)
        load = inertia * a + drive.viscous_friction * v + torque(spring, q - 0.2)
        tau = load + 0.05 * rng.standard_normal(q.shape)
        q = q + torque(spring, q - 0.2) / drive.stiffness + 1e-6 * rng.standard_normal(q.shape)
        segments.append(
            Segment(
                name=f"motion-{k}",
                role="validation" if k == 2 else "identification",
                kind="trajectory",
                t=t,
                q=q,
                tau=tau,
            )
        )
    verdict = diagnose(through_files(of_motions(robot, 500.0, segments), tmp_path))
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [("gravity_spring", "drive")]
    found = verdict.causes[0].parameters
    assert found["stiffness"].value == pytest.approx(shape(spring)[0], rel=0.02)
    assert found["rest_angle"].value == pytest.approx(0.2, abs=0.01)
