"""The linear gray-box against closed forms, finite differences and exact sampling."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg

from ident.chain import LinkChange, build_structure
from ident.graybox import (
    STIFF,
    Parameters,
    alias_response,
    equilibrium,
    hold_response,
    linearise,
    sampled_frf,
    stiff_gear_images,
)
from ident.hypotheses import catalogue
from ident.inverse import make_plane, true_position
from robot_assets.robot import Elasticity, load_robot

Q0 = np.array([0.2, -1.2, 0.9, 0.1, 0.5, 0.3])


def test_derivatives_match_finite_differences(ur10):
    structure, par = build_structure(ur10), Parameters.nominal(ur10)
    lin = linearise(structure, equilibrium(structure, par, Q0))
    f = np.geomspace(0.5, 80, 30)
    _, dG = sampled_frf(structure, par, lin, f, 1e-3, "zoh", derivatives=True)
    x = par.to_log()
    for c in range(len(x)):
        h = 1e-5
        pair = []
        for sign in (1, -1):
            moved = x.copy()
            moved[c] += sign * h
            pair.append(sampled_frf(structure, par.with_log(moved), lin, f, 1e-3, "zoh")[0])
        difference = (pair[0] - pair[1]) / (2 * h)
        assert np.abs(difference - dG[..., c]).max() < 1e-6 * np.abs(dG[..., c]).max()


def test_equilibrium_balances_springs_and_gravity(ur10):
    structure, par = build_structure(ur10), Parameters.nominal(ur10)
    q = equilibrium(structure, par, Q0)
    lin = linearise(structure, q)
    assert np.allclose(par.stiffness * (Q0 - q), lin.g, rtol=1e-9, atol=1e-9)
    soft = replace(par, stiffness=par.stiffness / 2)
    assert np.abs(equilibrium(structure, soft, Q0) - Q0).max() > 1.9 * np.abs(q - Q0).max()


def test_two_masses_have_the_textbook_resonances():
    robot = load_robot("twomass")
    structure, par = build_structure(robot), Parameters.nominal(robot)
    par = replace(par, damping=np.array([1e-6]), viscous=np.array([1e-6]))
    lin = linearise(structure, equilibrium(structure, par, np.zeros(1)))
    k, J_m, J_l = par.stiffness[0], par.inertia[0], lin.M[0, 0]
    f = np.arange(20.0, 120.0, 0.005)
    G = np.abs(sampled_frf(structure, par, lin, f, 1e-5, "none")[0][:, 0, 0])
    assert f[np.argmin(G)] == pytest.approx(np.sqrt(k / J_l) / 2 / np.pi, abs=0.02)
    assert f[np.argmax(G)] == pytest.approx(np.sqrt(k * (1 / J_m + 1 / J_l)) / 2 / np.pi, abs=0.02)


@pytest.mark.parametrize("stiffer", [1.0, 100.0, 1e3, 1e6])
def test_sampling_is_exact(ur10, stiffer):
    """Against the matrix exponential of the state-space form under a zero-order hold, also where gears are so stiff that
    what a motor feels between samples is the arm."""
    structure, par = build_structure(ur10), Parameters.nominal(ur10)
    par = replace(par, stiffness=stiffer * par.stiffness, damping=np.sqrt(stiffer) * par.damping)
    lin = linearise(structure, equilibrium(structure, par, Q0))
    n, T = 6, 1e-3
    K, D = np.diag(par.stiffness), np.diag(par.damping)
    M = scipy.linalg.block_diag(np.diag(par.inertia), lin.M)
    Kt = np.block([[K, -K], [-K, K + lin.Kg]])
    Dt = np.block([[D + np.diag(par.viscous), -D], [-D, D]])
    Mi = np.linalg.inv(M)
    A = np.block([[np.zeros((12, 12)), np.eye(12)], [-Mi @ Kt, -Mi @ Dt]])
    B = np.vstack([np.zeros((12, 6)), Mi[:, :6]])
    E = scipy.linalg.expm(np.block([[A, B], [np.zeros((6, 30))]]) * T)
    f = np.array([0.5, 3.0, 11.0, 40.0, 70.0, 120.0])
    for fk, G in zip(f, sampled_frf(structure, par, lin, f, T, "zoh")[0], strict=True):
        w = 2 * np.pi * fk
        exact = np.linalg.solve(np.exp(1j * w * T) * np.eye(24) - E[:24, :24], E[:24, 24:])[:n] * -(w**2)
        assert np.abs(G - exact).max() < 2e-5 * np.abs(exact).max()


def test_motion_is_told_from_images_as_the_response_has_them(identified):
    """``true_position`` takes away what ``sampled_frf`` adds to the response in the band, on stiff gears too; with
    filters what of them passes the drive of one joint and the sensor of another."""
    problem = identified[1].problem
    structure, sampling, group = problem.structure, problem.sampling, problem.groups[0]
    for stiffer in (1.0, 1e4):
        par = replace(problem.nominal, stiffness=stiffer * problem.nominal.stiffness)
        plane = make_plane(structure, par, group, sampling)
        omega = group.omega[1:]
        G = sampled_frf(structure, par, plane.lin, omega / 2 / np.pi, sampling.sample_time, "zoh")[0]
        band = hold_response(omega, sampling.sample_time, "zoh")[:, None, None] * np.linalg.inv(plane.Z[1:])
        images = np.einsum("lij,slj->sli", -G / omega[:, None, None] ** 2 - band, group.U[:, 1:])
        found = (group.Q - true_position(structure, par, plane, group, sampling))[:, 1:]
        assert np.abs(found - images).max() < 1e-6 * np.abs(images).max()
    gains = np.arange(1.0, 7.0), np.arange(2.0, 8.0)
    filtered = true_position(
        structure,
        par,
        plane,
        group,
        sampling,
        lambda s: (np.tile(gains[0], (len(s), 1)), np.tile(gains[1], (len(s), 1))),
    )
    share = np.einsum("lij,slj->sli", -G / omega[:, None, None] ** 2 - band, group.U[:, 1:] / gains[0]) / gains[1]
    # Of bare motors behind filters eight images are summed, not all.
    assert np.abs((group.Q - filtered)[:, 1:] - share).max() < 2e-3 * np.abs(share).max()


def test_images_of_a_gear_that_grows_stiff_come_by_and_by(ur10):
    structure, par, T = build_structure(ur10), Parameters.nominal(ur10), 8e-3
    lin = linearise(structure, equilibrium(structure, par, Q0))
    gears = np.max(np.sqrt(par.stiffness / par.inertia)) * T / 2 / np.pi
    omega = 2 * np.pi * np.linspace(1.0, 40.0, 20)

    def at(ratio):
        by = (ratio * STIFF / gears) ** 2
        return stiff_gear_images(structure, replace(par, stiffness=by * par.stiffness), lin, omega, T, "zoh")

    assert at(0.99) is None
    assert 0.0 < np.abs(at(1.001)).max() < 2e-3 * np.abs(at(2.0)).max()
    assert np.abs(at(2.001) - at(1.999)).max() < 0.05 * np.abs(at(2.0)).max()


def test_a_stiff_hinge_changes_nothing_and_a_soft_one_adds_a_resonance(ur10):
    par, f = Parameters.nominal(ur10), np.geomspace(1, 60, 200)

    def response(stiffness):
        hinge = Elasticity("extra", "shoulder_lift_joint", (1.0, 0.0, 0.0), stiffness, 1e-3 * stiffness)
        structure = build_structure(ur10, elasticities=(hinge,))
        p = replace(par, elastic_stiffness=np.array([stiffness]), elastic_damping=np.array([1e-3 * stiffness]))
        return sampled_frf(structure, p, linearise(structure, equilibrium(structure, p, Q0)), f, 1e-3, "zoh")[0]

    structure = build_structure(ur10)
    rigid = sampled_frf(structure, par, linearise(structure, equilibrium(structure, par, Q0)), f, 1e-3, "zoh")[0]
    assert np.abs(response(1e11) - rigid).max() < 1e-4 * np.abs(rigid).max()
    assert np.abs(response(2e4) - rigid).max() > 0.05 * np.abs(rigid).max()


def test_a_hinge_before_a_joint_turns_with_its_carrier(ur10):
    """About the joint's own axis it is the joint again; about another it does not turn with the joint, one after it
    does."""

    def hinge(axis, before):
        return Elasticity("h", "elbow_joint", axis, 1e4, 10.0, before)

    def inertia(axis, before, elbow):
        structure = build_structure(ur10, elasticities=(hinge(axis, before),))
        q = np.zeros(structure.n_coordinates)
        q[structure.driven] = [0.1, -1.0, elbow, 0.3, 0.2, 0.1]
        M = linearise(structure, q).M
        return M, structure.elastic[0], structure.driven[2]

    own = (0.0, 1.0, 0.0)
    for before in (False, True):
        M, h, j = inertia(own, before, 0.7)
        assert M[h] @ M[h] == pytest.approx(M[j] @ M[j], rel=1e-9)
        assert M[h, h] == pytest.approx(M[j, j], rel=1e-12)
    # The wrist alone turns about the elbow's x axis through its own offset; seen from the upper arm that axis stands
    # still.
    after, before = ([inertia((1.0, 0.0, 0.0), side, elbow) for elbow in (0.2, 1.2)] for side in (False, True))
    a, b = ([M[h, h] for M, h, _ in runs] for runs in (after, before))
    assert a[0] == pytest.approx(a[1], rel=1e-9)
    assert abs(b[0] / b[1] - 1) > 0.1


def test_the_body_of_a_link_is_changed_with_its_load_or_without(ur10):
    """The ur10's last link carries the load that its robot.toml names."""
    joint, placement = build_structure(ur10).bodies["wrist_3_link"]
    load = ur10.loads[0]

    def body(structure):
        return structure.model.inertias[joint]

    both, bare = body(build_structure(ur10)), body(build_structure(replace(ur10, loads=())))
    change = LinkChange(0.9, (0.01, 0.0, 0.0), 0.8)
    whole = body(build_structure(ur10, links={"wrist_3_link": replace(change, with_load=True)}))
    alone = body(build_structure(ur10, links={"wrist_3_link": change}))
    assert whole.isApprox(change.of(both), 1e-9)
    assert alone.isApprox(
        change.of(bare) + placement.act(pin.Inertia(load.mass, np.array(load.com), np.array(load.inertia))), 1e-9
    )
    assert whole.mass == pytest.approx(0.9 * both.mass) and alone.mass == pytest.approx(0.9 * bare.mass + load.mass)
    links = [h for h in catalogue(build_structure(ur10)) if h.key == ("link_inertia", "wrist_3_link")]
    assert [h.options["with_load"] for h in links] == [False, True]
    known = build_structure(ur10, inertias={"wrist_3_joint": both})  # what was found holds the load
    assert sum(h.key == ("link_inertia", "wrist_3_link") for h in catalogue(known)) == 1


def test_images_of_a_held_torque_pass_the_drive_first():
    """A current loop of a millisecond lets little of them pass: sampled motion of a bare motor behind it, in closed
    form."""
    T, inertia, lag = 1e-3, 0.7, 1e-3
    omega = 2 * np.pi * np.array([0.0, 5.0, 40.0, 150.0])
    found = alias_response(omega, T, "zoh", lambda s: 1.0 / (1.0 + lag * s)[:, None])[1:, 0]
    # States: angle, velocity, torque of the loop; stepped exactly over a held sample.
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0 / inertia], [0.0, 0.0, -1.0 / lag]])
    held = scipy.linalg.expm(T * np.block([[A, np.array([[0.0], [0.0], [1.0 / lag]])], [np.zeros((1, 4))]]))
    for w, images in zip(omega[1:], found, strict=True):
        z = np.exp(1j * w * T)
        whole = np.linalg.solve(z * np.eye(3) - held[:3, :3], held[:3, 3])[0]
        band = hold_response(np.array([w]), T, "zoh")[0] / (inertia * (1j * w) ** 2 * (1.0 + 1j * w * lag))
        assert images / inertia == pytest.approx(whole - band, rel=5e-3)
