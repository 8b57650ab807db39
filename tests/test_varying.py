"""Links linearised along a motion."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from ident.chain import build_structure
from ident.graybox import damping_diagonal, linearise, stiffness_diagonal
from ident.group import to_time
from ident.identification import set_up
from ident.inverse import inverse_dynamics
from ident.model import Model
from ident.recursion import chain_of
from ident.varying import BOUNDED, FOURTH_ORDER, along, factorised, march, slopes
from robot_assets.robot import load_robot


@pytest.mark.parametrize("name", ["ur10", "twomass"])
def test_slopes_are_those_of_inverse_dynamics(name):
    model = build_structure(load_robot(name)).model
    rng = np.random.default_rng(3)
    motion = rng.normal(size=(3, 2, 5, model.nq))
    M, C, K = slopes(chain_of(model), *motion)
    data = model.createData()
    for at in np.ndindex(2, 5):
        by_q, by_v, by_a = pin.computeRNEADerivatives(model, data, *(x[at] for x in motion))
        by_a = np.triu(by_a) + np.triu(by_a, 1).T
        for found, expected in ((K, by_q), (C, by_v), (M, by_a)):
            np.testing.assert_allclose(found[at], expected, rtol=0, atol=1e-4 * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize(("beta", "steps"), [(BOUNDED, 20000), (FOURTH_ORDER, 20000)])
def test_a_march_ends_where_the_matrix_exponential_does(beta, steps):
    """Two masses on springs, from any state, after so many steps that these hardly matter."""
    M, C, K = np.diag([2.0, 0.5]), np.array([[0.3, -0.1], [-0.1, 0.2]]), np.array([[90.0, -20.0], [-20.0, 40.0]])
    time = 1.3
    h = time / steps
    factors = factorised(M + 0.5 * h * C + beta * h * h * K)
    along_time = [np.tile(x, (steps, 1, 1)) for x in (factors, C, K)]
    state, load = np.array([0.1, -0.2, 0.7, 0.4]), np.array([3.0, -1.0])
    a = np.linalg.solve(M, load - C @ state[2:] - K @ state[:2])
    path = np.empty((steps, 2))
    end = march(*along_time, h, beta, state, a, np.tile(load, (steps, 1)), path)

    at_rest = np.linalg.solve(K, load)
    moves = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    values, vectors = np.linalg.eig(moves)
    swing = state - np.concatenate([at_rest, np.zeros(2)])
    swing = (vectors @ (np.exp(values * time) * np.linalg.solve(vectors, swing))).real
    np.testing.assert_allclose(end, swing + np.concatenate([at_rest, np.zeros(2)]), atol=1e-6)
    np.testing.assert_array_equal(path[-1], end[:2])


@pytest.fixture(scope="module")
def light(clean):
    """A group, its arm on gears that hardly damp, and how those are linearised."""
    problem = set_up(clean[0]).problem
    group = next(g for g in problem.groups if g.window is None)
    model = Model(problem.structure, replace(problem.nominal, damping=0.1 * problem.nominal.damping))
    structure, par = model.built
    return structure, group, stiffness_diagonal(structure, par), damping_diagonal(structure, par)


def test_near_the_posture_at_rest_a_step_is_the_change_itself(light):
    structure, group, spring, damper = light
    q = group.posture
    lin = linearise(structure, q)
    still = np.zeros((1, len(group.omega), len(q)), complex)
    still[:, 0] = q
    near = along(chain_of(structure.model), spring, damper, (lin.M, lin.Kg), group, np.arange(1), still)
    rng = np.random.default_rng(4)
    change = rng.normal(size=(2, *still.shape[1:])) + 1j * rng.normal(size=(2, *still.shape[1:]))
    change[:, 0] = change[:, 0].real
    np.testing.assert_allclose(near.step(change, np.array([0, 0])), change, atol=1e-5 * np.abs(change).max())


def test_a_step_answers_a_small_torque_along_a_large_motion(light):
    """Inverse dynamics of the motion that is moved by the step takes up the torque; with the arm at rest it does not."""
    structure, group, spring, damper = light
    chain = chain_of(structure.model)
    lin = linearise(structure, group.posture)
    s = 1j * group.omega[:, None]
    lines = len(group.omega)
    motion = np.zeros((1, lines, structure.n_coordinates), complex)
    motion[:, 0] = group.posture
    rng = np.random.default_rng(5)
    motion[:, 1:4] = 0.15 * np.exp(2j * np.pi * rng.random((3, structure.n_coordinates)))
    near = along(chain, spring, damper, (lin.M, lin.Kg), group, np.arange(1), motion)

    def torque(Q_a):
        q, v, a = (to_time(s**k * Q_a, len(near.factors[0])) for k in range(3))
        return inverse_dynamics(structure, q, v, a) + v * damper + q * spring

    change = np.zeros_like(motion)
    change[:, 5:60] = 1e-3 * rng.normal(size=(55, structure.n_coordinates))
    at_rest = s[..., None] ** 2 * lin.M + s[..., None] * np.diag(damper) + np.diag(spring) + lin.Kg

    def left(step):
        moved = -np.linalg.solve(at_rest, step[..., None])[..., 0]
        short = torque(motion + moved) - torque(motion) + to_time(change, len(near.factors[0]))
        return np.sqrt(np.mean(short**2) / np.mean(to_time(change, len(near.factors[0])) ** 2))

    assert left(near.step(change, np.arange(1))) < 0.02 < 0.2 < left(change)
