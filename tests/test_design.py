"""Optimal designs against textbook cases; information against FRF covariance; plans that run."""

import json

import numpy as np
import pytest

from ident.candidates import build_body, configuration, draw_candidates, flange_height
from ident.chain import build_structure
from ident.cli import main
from ident.design import (
    apportion,
    criterion_loss,
    design_experiment,
    design_plan,
    optimal_weights,
    random_losses,
    round_weights,
)
from ident.excitation import LOOP_HZ, Excitation, operating_points
from ident.graybox import Parameters, impedance, sampled_frf
from ident.information import LOOP_DAMPING, conditions, information, linearised
from ident.plan_file import plan_from_toml, plan_to_toml
from robot_assets.errors import DataError
from robot_assets.robot import load_robot

AXIS = np.linspace(-1, 1, 41)


def quadratic(x=AXIS):
    """Information of one measurement of a parabola at each x, (Q, 3, 3)."""
    rows = np.stack([np.ones_like(x), x, x**2], axis=1)
    return rows[:, :, None] * rows[:, None, :]


@pytest.mark.parametrize(
    ("criterion", "ends", "middle"), [("D", 1 / 3, 1 / 3), ("A", 1 / 4, 1 / 2), ("E", 1 / 5, 3 / 5)]
)
def test_parabola_is_measured_where_the_textbook_says(criterion, ends, middle):
    """Pukelsheim 1993, ch. 9: weight on -1, 0 and 1 alone."""
    best = optimal_weights(quadratic(), criterion=criterion, tolerance=1e-6)
    assert best.gap < 1e-6
    assert best.weights[[0, 20, 40]] == pytest.approx([ends, middle, ends], abs=2e-3)
    assert best.weights.sum() == pytest.approx(1.0)


def test_equivalence_theorem():
    """At the D-optimum no candidate's ``tr(M^-1 H_i)`` exceeds p, and it is p where weight lies."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(300, 5, 2)) * np.geomspace(1, 1e4, 5)[:, None]
    H = half @ np.swapaxes(half, 1, 2)
    best = optimal_weights(H, tolerance=1e-5)
    d = np.einsum("ij,qji->q", np.linalg.inv(np.tensordot(best.weights, H, 1)), H)
    assert d.max() <= 5 * (1 + 1e-5)
    assert np.allclose(d[best.weights > 1e-3], 5, rtol=1e-3)
    assert best.gap == pytest.approx(d.max() / 5 - 1, abs=1e-9)


@pytest.mark.parametrize("criterion", ["D", "A", "E"])
def test_the_gap_bounds_what_other_weights_gain(criterion):
    rng = np.random.default_rng(1)
    half = rng.normal(size=(2, 200, 4, 3))
    H = half @ np.swapaxes(half, -1, -2)
    best = optimal_weights(H, criterion=criterion, tolerance=1e-4)
    assert best.gap < 1e-4
    loss = criterion_loss(np.tensordot(H, best.weights, (1, 0)), criterion)
    allowed = best.gap * (4 if criterion == "D" else 1)
    for sharp in (0.3, 1.0, 3.0):
        for _ in range(100):
            w = rng.dirichlet(np.full(200, 0.05)) * 0.5 + best.weights * sharp
            assert criterion_loss(np.tensordot(H, w / w.sum(), (1, 0)), criterion) > loss - allowed


def test_a_design_for_two_draws_serves_both():
    """The average over a prior: worse than each own optimum, better than the other's."""
    rng = np.random.default_rng(2)
    half = rng.normal(size=(2, 150, 3, 2))
    H = half @ np.swapaxes(half, -1, -2)
    both = optimal_weights(H).weights

    def loss(w, d):
        return -np.linalg.slogdet(np.tensordot(w, H[d], 1))[1]

    own = [optimal_weights(H[d]).weights for d in (0, 1)]
    assert loss(own[0], 0) < loss(both, 0) < loss(own[1], 0)
    assert loss(both, 0) + loss(both, 1) < min(sum(loss(w, d) for d in (0, 1)) for w in own)


@pytest.mark.parametrize(
    ("weights", "points", "expected"),
    [
        ([0.5, 0.3, 0.2], 10, [5, 3, 2]),
        ([1 / 6, 1 / 3, 1 / 2, 0.0], 4, [1, 1, 2, 0]),
        ([0.4, 0.35, 0.25], 2, [1, 1, 0]),
        ([1.0, 0.0], 3, [3, 0]),
    ],
)
def test_apportionment(weights, points, expected):
    assert apportion(np.array(weights), points).tolist() == expected


@pytest.mark.parametrize("points", [3, 4, 7])
def test_rounding_ends_where_no_exchange_helps(points):
    H = quadratic()
    chosen = round_weights(H, optimal_weights(H).weights, points)
    loss = criterion_loss(H[None][:, chosen].sum(axis=1), "D")
    assert len(chosen) == points
    for k in range(points):
        rest = H[np.delete(chosen, k)].sum(axis=0)
        assert np.all(criterion_loss(rest[None, None] + H[None], "D") > loss - 1e-9)


def test_what_no_candidate_shows_is_refused():
    H = quadratic()
    H[:, 1], H[:, :, 1] = 0, 0
    with pytest.raises(DataError, match="nothing seen of 1"):
        optimal_weights(H)
    with pytest.raises(DataError, match="criterion"):
        optimal_weights(quadratic(), criterion="G")


EXCITATION = Excitation(1000.0, 2000, 3, 1, np.arange(3, 120, 12), np.arange(0))


@pytest.mark.parametrize("name", ["irb", "ur10", "twomass"])
def test_information_is_that_of_the_frf(name):
    """``2 Re Psi^H Lambda^-1 Psi`` with the derivatives of the FRF and its covariance (theory.md 4)."""
    robot = load_robot(name)
    structure, par, n = build_structure(robot), Parameters.nominal(robot), robot.n
    lins = linearised(structure, par, operating_points(robot, 9, np.random.default_rng(0)))
    given = conditions(structure, EXCITATION, lins, par, realizations=2)
    H = information(structure, par, lins, given)[-1]
    s = 2j * np.pi * given.frequency
    G, dG = sampled_frf(structure, par, lins[-1], given.frequency, 1e-3, "none", derivatives=True)
    Z, _, _ = impedance(structure, par, lins[-1], s)
    inertia = par.inertia + np.diag(lins[-1].M)[structure.driven]
    w = 2 * np.pi * LOOP_HZ
    expected = np.zeros_like(H)
    for f in range(len(s)):
        loop = np.diag(inertia * (w**2 + 2 * LOOP_DAMPING * w * s[f]))
        R = np.diag(0.5 * np.sqrt(n) * given.amplitude[f])
        U = Z[f] @ np.linalg.solve(Z[f] + loop, R)
        Phi = G[f] @ np.diag(given.tau_std**2) @ G[f].conj().T + np.abs(s[f]) ** 4 * np.diag(given.q_std**2)
        covariance = np.kron(np.linalg.inv(U @ U.conj().T).conj(), Phi / given.samples)
        Psi = np.swapaxes(dG[f, ..., :-1], 0, 1).reshape(n * n, -1)
        expected += 2 * (Psi.conj().T @ np.linalg.solve(covariance, Psi)).real
    size = np.sqrt(np.diag(expected))
    assert np.abs((H - expected) / np.outer(size, size)).max() < 1e-9
    assert given.samples == 2 * 2 * 2000


@pytest.mark.parametrize("name", ["irb", "ur10", "panda"])
def test_candidates_stay_in_range_and_above_the_base(name):
    robot = load_robot(name)
    drawn = draw_candidates(robot, 60, np.random.default_rng(0))
    body = build_body(robot, np.random.default_rng(0))
    data = body.model.createData()
    assert drawn.q.shape == (60, robot.n) and drawn.note == ""
    assert np.all(drawn.q > robot.q_min) and np.all(drawn.q < robot.q_max)
    assert all(flange_height(body, data, configuration(body, q)) >= 0 for q in drawn.q)


def test_a_folded_arm_is_refused(ur10):
    """Elbow bent back until the forearm lies in the upper arm."""
    import pinocchio as pin

    body = build_body(ur10, np.random.default_rng(0))
    data, touch = body.model.createData(), body.geometry.createData()

    def collides(q):
        return pin.computeCollisions(body.model, data, body.geometry, touch, configuration(body, np.array(q)), True)

    assert collides([0, -1.5, 3.1, 0, 0, 0])
    assert not collides([0, -1.5, 0.3, 0, 0, 0])


def test_no_collision_geometry_is_said():
    assert "not checked" in draw_candidates(load_robot("twomass"), 5, np.random.default_rng(0)).note


@pytest.mark.parametrize(
    ("name", "criterion", "least"), [("irb", "D", 3.0), ("ur10", "D", 3.0), ("ur10", "A", 1.3), ("irb", "E", 1.3)]
)
def test_a_design_beats_random_choices(name, criterion, least):
    design = design_experiment(load_robot(name), points=8, candidates=150, criterion=criterion, seed=1, per_decade=20)
    assert design.weights.gap < 1e-3
    assert design.ratio > least
    assert design.loss < design.random_loss.min()
    assert 0.6 < design.efficiency <= 1 + 1e-9
    assert design.postures.shape == (8, 6) and design.std.shape == (len(design.names),)


def test_random_losses_are_those_of_their_sums():
    H = quadratic()
    losses = random_losses(H, 5, "A", np.random.default_rng(3), count=4)
    rng = np.random.default_rng(3)
    for loss in losses:
        pick = rng.choice(len(H), 5, replace=False)
        assert loss == pytest.approx(np.log(np.trace(np.linalg.inv(H[pick].sum(axis=0)))))


@pytest.mark.slow
def test_the_plan_holds_the_points_and_survives_its_file(ur10, tmp_path):
    design = design_experiment(ur10, points=3, candidates=60, draws=2, seed=4, realizations=2, period=2000)
    plan = design_plan(design, levels=(1.0, 0.5))
    plan_to_toml(plan, tmp_path / "plan.toml")
    read = plan_from_toml(tmp_path / "plan.toml")
    measured = {e.operating_point: e for e in read.experiments}
    assert len(measured) == 4 and len(read.experiments) == 3 * 2 * 2 * 6 + 2 * 6
    assert np.allclose([e.q0 for e in measured.values()][:3], design.postures)
    assert [e.role for e in measured.values()] == 3 * ["identification"] + ["validation"]
    assert not np.any(np.all(measured["op04"].q0 == design.postures, axis=1))
    assert read.excitation.period == 2000


@pytest.mark.slow
def test_the_command_writes_a_plan_that_the_experiment_takes(tmp_path, capsys, monkeypatch):
    def run(*words):
        monkeypatch.setattr("sys.argv", ["simgap", *map(str, words)])
        try:
            main()
        except SystemExit as stop:
            return stop.code
        return 0

    plan = tmp_path / "plan.toml"
    assert run("design", "twomass", "--out", plan, "--points", 2, "--candidates", 20, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["optimality_gap"] < 1e-3 and len(said["operating_points"]) == 2
    assert run("experiment", "twomass", "--plan", plan, "--out", tmp_path / "data", "--quiet") == 0
    assert run("experiment", "ur10", "--plan", plan, "--out", tmp_path / "data2", "--quiet") == 2
    assert run("design", "twomass", "--out", plan, "--criterion", "Z", "--quiet") == 2
    assert run("design", "twomass", "--out", tmp_path, "--quiet") == 2


@pytest.mark.parametrize("wrong", [dict(points=0), dict(points=9, candidates=5), dict(draws=0), dict(criterion="X")])
def test_wrong_calls_are_refused(ur10, wrong):
    with pytest.raises(DataError):
        design_experiment(ur10, **wrong)
