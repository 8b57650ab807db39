"""Motions as records: their return to the start, and the noise seen through their window."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from ident.chain import build_structure
from ident.closing import close_motion
from ident.dataset import Dataset, Segment
from ident.diagnosis import diagnose
from ident.extended import predict
from ident.gain import mean_squares, stretch_squares
from ident.graybox import Parameters
from ident.hypotheses import catalogue
from ident.identification import set_up
from ident.inverse import inverse_dynamics
from ident.law_noise import law_noise
from ident.model import Effect, Model
from ident.problem import data_count, residual
from ident.records import FAST_SHARE, build_groups, lines_of_motion
from ident.weights import make_weights
from robot_assets.robot import load_robot
from tests.conftest import of_motions

RATE = 500.0


@pytest.mark.parametrize(
    ("fastest", "share", "expected"),
    [(20, 1.0, 42), (70, 1.0, 71), (70, 0.5 * FAST_SHARE, 42), (500, 10.0, 120), (70, 0.0, 42)],
)
def test_as_many_lines_of_a_motion_are_solved_as_it_has(fastest, share, expected):
    """Of accelerations, beside noise that has far more of them at lines that are faster; one joint rests."""
    rng = np.random.default_rng(1)
    white = np.full(2, 1e-12)
    lines = np.sqrt(0.5 * white) * (rng.normal(size=(900, 2)) + 1j * rng.normal(size=(900, 2)))
    lines[10, 0] += 1e-2
    lines[fastest, 0] += share * 1e-2 * (10.0 / fastest) ** 2
    assert lines_of_motion(lines, white, 42, 120) == expected


@pytest.mark.parametrize("fast", [0.0, 0.02])
def test_a_motion_with_fast_parts_is_predicted_as_a_slow_one(ur10, fast):
    """Torque of a flexible arm along a motion of its links, in closed form by its lines: what is faster than twice the
    compared band reaches into it by inertias that change and by Coriolis torque."""
    par, structure, seconds = Parameters.nominal(ur10), build_structure(ur10), 24.0
    t = np.arange(int(seconds * RATE)) / RATE
    part = slice(0, 2 * len(t) // 3)
    rng = np.random.default_rng(5)
    links = np.array([0.2, -1.2, 0.9, 0.1, 0.5, 0.3]) + np.zeros((len(t), 1))
    for f, size in ((1 / seconds, 0.3), (3 / seconds, 0.2), *((f, fast) for f in np.arange(5.5, 8.0, 0.25))):
        rises = np.zeros(len(t))  # what is fast grows from nothing, and leaves nothing that swings
        rises[part] = np.hanning(len(t[part])) ** 2
        phase = rng.uniform(0.0, 2.0 * np.pi, ur10.n)
        links += size * np.cos(2.0 * np.pi * f * t[:, None] + phase) * (rises[:, None] if f > 1.0 else 1.0)
    s = 2j * np.pi * np.fft.rfftfreq(len(t), 1.0 / RATE)[:, None]
    lines = np.fft.rfft(links, axis=0)
    rates = (np.fft.irfft(s**k * lines, len(t), axis=0) for k in (1, 2))
    asked = np.fft.rfft(inverse_dynamics(structure, links, *rates), axis=0)
    motors = lines + asked / (par.stiffness + s * par.damping)
    torque = asked + (s**2 * par.inertia + s * par.viscous) * motors
    tau, q = (np.fft.irfft(x, len(t), axis=0) for x in (torque, motors))
    motion = Segment(name="m", role="identification", kind="trajectory", t=t[part], tau=tau[part], q=q[part])
    problem = set_up(of_motions(ur10, RATE, [motion], q_std=1e-7, tau_std=1e-3)).problem
    (group,) = problem.groups
    left = residual(group, predict(Model(structure, par), group, problem.sampling))
    whole = group.observe(group.U)
    share = np.sqrt(np.sum(np.abs(left[:, 1:]) ** 2, axis=1) / np.sum(np.abs(whole[:, 1:]) ** 2, axis=1))
    assert share.max() < 3e-3


@pytest.mark.parametrize("noise", [0.0, 1e-6])
def test_the_return_of_a_motion_goes_on_with_its_acceleration(noise):
    """A motion that is cut while it accelerates, at both ends."""
    t = np.arange(4000) / RATE
    rng = np.random.default_rng(0)
    x = np.stack([0.8 * np.cos(2.0 * t), 0.3 * np.sin(5.0 * t + 1.0)], axis=1)
    whole = close_motion(x + noise * rng.normal(size=x.shape), 4000, RATE, curvature=True)
    around = np.concatenate([whole[-200:], whole, whole[:200]])
    v = np.gradient(around, 1 / RATE, axis=0)
    a = np.diff(around, 2, axis=0) * RATE**2
    assert np.array_equal(whole[:4000], x + noise * np.random.default_rng(0).normal(size=x.shape))
    top = np.abs(a[200:4000]).max(axis=0)
    for at in (200, 4200):
        seams = a[at - 6 : at + 4]
        step = np.abs(seams[-1] - seams[0])
        # The seam spans 9 samples, over which it also falls: by 9 times itself a second of the brake.
        assert np.all(step < 0.2 * top + 4 * noise * RATE**2)
        assert np.all(np.abs(v[at + 1] - v[at - 2]) < 3.6 / RATE * top + 4 * noise * RATE)
    assert np.abs(whole[4000:]).max() < 4.0


@pytest.mark.parametrize("seed", range(3))
def test_a_motion_that_breaks_off_leaves_nothing_of_its_ends(seed):
    """Sines of a linear drive, begun and ended under way, against its impedance: the line of a few ten thousandths of
    the torque to which real motions show it must be far above what the ends leave."""
    bench, rng = load_robot("twomass"), np.random.default_rng(seed)
    t = np.arange(3000) / RATE
    hz = rng.uniform(0.2, 1.4, 6)
    size = rng.normal(size=6) / (1.0 + hz) * np.exp(2j * np.pi * rng.random(6))
    waves = np.exp(2j * np.pi * np.outer(t, hz))

    def recorded(lines):
        q, tau = ((waves @ x).real[:, None] for x in (size, lines))
        return of_motions(bench, RATE, [Segment(name="m", role="identification", kind="trajectory", t=t, tau=tau, q=q)])

    still = recorded(0.0 * size)
    problem = set_up(still).problem
    model = Model(problem.structure, problem.nominal)
    pred = predict(model, build_groups(still, motion_band_hz=3.0)[0], problem.sampling)
    seen = pred.sampled_impedance[:, 0, 0]
    lines = pred.plane.s.imag / (2 * np.pi)
    # A polynomial between its lines, exact far below the mode of the load.
    near = lines < 4.0
    impedance = [np.polyval(np.polyfit(lines[near], part[near], 8), hz) for part in (seen.real, seen.imag)]
    (group,) = build_groups(recorded((impedance[0] + 1j * impedance[1]) * size), motion_band_hz=3.0)
    error = residual(group, predict(model, group, problem.sampling))
    assert np.linalg.norm(error) < 2e-5 * np.linalg.norm(group.observe(group.U))


@pytest.mark.parametrize("seconds", [4.0, 15.0])
def test_noise_of_a_motion_costs_as_much_as_it_counts(seconds):
    """White noise of the torque alone, whitened: as many squares as numbers are compared, however short the motion
    is."""
    bench = load_robot("twomass")
    rng = np.random.default_rng(1)
    t = np.arange(int(seconds * RATE)) / RATE
    q = 0.3 * (1 - np.cos(2 * np.pi * t / seconds))[:, None]
    motion = Segment(name="m", role="identification", kind="trajectory", t=t, tau=0.0 * q, q=q)
    data = Dataset(
        name="noise", robot=bench, sample_rate=RATE, joints=bench.joint_names, input_hold="none",
        q_std=np.array([1e-12]), tau_std=np.array([0.05]), controller=None, segments=(motion,),
    )  # fmt: skip
    problem = set_up(data).problem
    (group,) = problem.groups
    pred = predict(Model(problem.structure, problem.nominal), group, problem.sampling)
    weights = make_weights(problem, [pred], 0.0)
    costs = []
    for _ in range(200):
        noise = np.zeros((1, group.n_time, 1))
        inside = np.linspace(0, group.n_time, len(group.window), endpoint=False) < group.n_time
        noise[0, inside] = rng.normal(size=(inside.sum(), 1))
        lines = group.to_lines(noise) * 0.05 * np.sqrt(group.n_time / (group.period_time * RATE))
        error = weights.apply(0, group.observe(lines))
        costs.append(np.sum(np.abs(error) ** 2))
    assert np.mean(costs) == pytest.approx(data_count(replace(problem)), rel=0.05)


def moves_with_dwells(size, scale=1.0, asymmetry=0.0):
    """Moves from point to point with dwells, in each of which dry friction of a ``size`` happens to balance another
    torque.

    The torque that is recorded is the one delivered over ``scale``. Friction is ``1 + asymmetry`` times its size
    forwards, and ``1 - asymmetry`` times backwards.
    """
    bench, rng = load_robot("twomass"), np.random.default_rng(3)
    fs, n = 500.0, 150
    u = np.arange(n) / n
    step = u**3 * (10 - 15 * u + 6 * u**2)
    angles = np.cumsum(rng.choice([-1.0, 1.0], 30) * rng.uniform(0.5, 2.0, 30))
    q, friction = [], []
    for a, b in itertools.pairwise(angles):
        q += [a + (b - a) * step, np.full(100, b)]
        held = rng.uniform(-size, size) + asymmetry * size
        friction += [np.full(n, size * (np.sign(b - a) + asymmetry)), np.full(100, held)]
    q, friction = np.concatenate(q), np.concatenate(friction)
    v, joint = np.gradient(q, 1 / fs), bench.joints[0]
    inertia = joint.motor_inertia + 0.00477
    tau = (inertia * np.gradient(v, 1 / fs) + joint.viscous_friction * v + friction) / scale + 0.02 * rng.normal(
        size=len(q)
    )
    cut = 250 * 20
    motions = [
        Segment(name=name, role=role, kind="trajectory", t=np.arange(len(q[part])) / fs, tau=tau[part, None], q=q[part, None] + 1e-7 * rng.normal(size=(len(q[part]), 1)))
        for name, role, part in (("a", "identification", slice(None, cut)), ("b", "validation", slice(cut, None)))
    ]  # fmt: skip
    return Dataset(
        name="moves", robot=bench, sample_rate=fs, joints=bench.joint_names, input_hold="none",
        q_std=np.array([1e-7]), tau_std=np.array([0.02]), controller=None, segments=tuple(motions),
    )  # fmt: skip


@pytest.mark.slow
def test_friction_at_rest_is_what_the_drive_asks_of_it():
    size = 0.8
    data = moves_with_dwells(size)
    cut = data.segments[0].n_samples
    assert np.mean(set_up(data).problem.groups[0].rest[0, :cut]) == pytest.approx(0.4, abs=0.1)
    verdict = diagnose(data, max_causes=2)
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [("coulomb_friction", "drive")]
    found = verdict.causes[0].parameters
    assert found["torque"].value == pytest.approx(size, rel=0.02) and abs(found["asymmetry"].value) < 0.05
    assert verdict.gain.gap_closed > 0.85 and verdict.gain.segments == ("b",)
    low, high = verdict.gain.ci95
    assert 0.7 < low < verdict.gain.gap_closed < high <= 1.01
    (group,) = set_up(data).held_out
    lines = group.observe(group.U)
    parts = stretch_squares(group, lines, 8)
    assert parts.shape == (8, 1) and parts.mean(axis=0) == pytest.approx(mean_squares(np.abs(lines) ** 2)[0], rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("asymmetry", [-0.3, 0.5])
def test_friction_that_differs_with_direction_balances_at_rest_what_is_asked_of_it(asymmetry):
    verdict = diagnose(moves_with_dwells(0.8, asymmetry=asymmetry), max_causes=2)
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [("coulomb_friction", "drive")]
    found = verdict.causes[0].parameters
    assert found["torque"].value == pytest.approx(0.8, rel=0.02)
    assert found["asymmetry"].value == pytest.approx(asymmetry, abs=0.03)
    assert verdict.gain.gap_closed > 0.85


def test_friction_that_drifts_balances_at_rest_what_is_asked_of_it(monkeypatch):
    monkeypatch.setattr("ident.hypotheses.friction.PROJECTIONS", 0)
    setup = set_up(moves_with_dwells(0.8))
    problem, (group,) = setup.problem, setup.problem.groups
    h = next(h for h in catalogue(problem.structure) if h.effect == "friction_drift")
    p = np.array([0.5, 5.0, 0.8, 1e-3])
    motion = predict(Model(problem.structure, problem.nominal, (Effect(h, p),)), group, problem.sampling).motion()
    rest, size = group.rest[0, :, 0], 0.8 * (1.0 + 0.5 * (1.0 - np.exp(-motion.time / 5.0)))
    drag = 0.5 * (1.0 - np.exp(-motion.time / 5.0)) * problem.nominal.viscous[0] * motion.v(0)
    held = np.clip(motion.asked(0), -size, size) + drag
    assert h.law(p, motion, 0, problem.nominal.stiffness[0])[:, rest] == pytest.approx(held[:, rest])


@pytest.mark.parametrize("scale", [0.5, 1.6])
def test_friction_at_rest_balances_what_the_drive_delivers(scale):
    """A drive that delivers another torque than is recorded: at the true figures no more is left than with a right
    one."""

    def left(scale):
        setup = set_up(moves_with_dwells(0.8, scale))
        problem, (group,) = setup.problem, setup.problem.groups
        known = {h.effect: h for h in catalogue(problem.structure)}
        effects = [Effect(known["coulomb_friction"], np.array([0.8, 0.0, 1e-3, 0.0]))]
        effects += [Effect(known["torque_constant"], np.array([scale]))] if scale != 1.0 else []
        found = predict(Model(problem.structure, problem.nominal, tuple(effects)), group, problem.sampling)
        return float(np.sqrt(np.mean(np.abs(group.observe(group.U - found.U)) ** 2)))

    assert left(scale) < 1.2 * max(left(1.0), left(1.0) / scale)


def test_what_a_motor_delivers_while_it_warms_up_is_told_by_the_decoy_for_it():
    change, time_constant = -0.3, 6.0
    delivered = 1.0 + change * -np.expm1(-np.arange(7250) / RATE / time_constant)

    def left(scale, *effects):
        setup = set_up(moves_with_dwells(0.0, scale))
        problem, (group,) = setup.problem, setup.problem.groups
        known = {h.effect: h for h in catalogue(problem.structure)}
        there = tuple(Effect(known[name], np.array(p)) for name, p in effects)
        found = predict(Model(problem.structure, problem.nominal, there), group, problem.sampling)
        return float(np.sqrt(np.mean(np.abs(group.observe(group.U - found.U)) ** 2)))

    clean = left(1.0)
    assert left(delivered) > 3.0 * clean
    assert left(delivered, ("unknown:torque_drift", (1.0, change, time_constant))) == pytest.approx(clean, rel=0.05)


def test_limits_of_the_torque_are_sought_below_what_was_recorded():
    """A motion that is cut while the torque rises: its return swings far beyond, and was never asked of the motor."""
    bench, fs = load_robot("twomass"), RATE
    t = np.arange(int(6 * fs)) / fs
    q, tau = 0.2 * np.sin(2 * np.pi * 0.7 * t), 3.0 * np.sin(2 * np.pi * 0.7 * t + 0.5)
    rng = np.random.default_rng(1)
    segment = Segment(
        "m", "trajectory", "identification", t, tau[:, None] + 1e-3 * rng.normal(size=(t.size, 1)), q[:, None]
    )
    data = Dataset("cut", bench, fs, bench.joint_names, "zoh", np.array([1e-6]), np.array([1e-3]), None, (segment,))
    setup = set_up(data)
    (group,) = setup.problem.groups
    motion = predict(Model(setup.problem.structure, setup.problem.nominal), group, setup.problem.sampling).motion()
    assert np.abs(motion.torque(0)).max() > 1.5 * 3.0
    assert motion.peak_torque(0) == pytest.approx(3.0, rel=0.05)


def periodic_positions():
    """Records of the two masses whose lines fall from far above the noise to far below it, and none beyond; and their
    truth."""
    bench, rng, n = load_robot("twomass"), np.random.default_rng(2), 2000
    lines = np.arange(1, 200)
    size = np.where(lines < 150, 1e-3 * np.exp(-lines / 18.0), 0.0)
    noise, segments, truth = 1e-4, [], []
    for i in range(24):
        X = np.zeros(n // 2 + 1, complex)
        X[lines] = size * (rng.normal(size=lines.size) + 1j * rng.normal(size=lines.size)) / np.sqrt(2)
        q = np.tile(np.fft.irfft(X, n=n, norm="forward"), 3) + noise * rng.normal(size=3 * n)
        truth.append(X)
        segments.append(
            Segment(
                f"s{i}", "multisine", "identification", np.arange(3 * n) / RATE, 0.1 * rng.normal(size=(3 * n, 1)), q[:, None],
                operating_point="a", q0=np.zeros(1), period=n, periods=3, excited_lines=np.arange(1, 100),
            )
        )  # fmt: skip
    data = Dataset(
        "lines",
        bench,
        RATE,
        bench.joint_names,
        "zoh",
        np.array([noise]),
        np.array([0.1]),
        None,
        tuple(segments),
    )
    (group,) = build_groups(data)
    return data, group, np.stack(truth)[:, : group.Q.shape[1], None]


def test_what_laws_see_of_a_position_is_off_by_as_much_as_is_said():
    """The error of the motion shown to laws against its claim, line by line."""
    _, group, truth = periodic_positions()
    off = np.abs(group.signal_share * group.Q - truth)[..., 0] ** 2
    said = group.shown_error[..., 0]
    for band in (slice(1, 40), slice(40, 70), slice(70, 110)):  # mostly signal, half and half, mostly noise
        assert said[:, band].mean() == pytest.approx(off[:, band].mean(), rel=0.25)
    alone = group.position_noise[165:].mean()
    assert off[:, 165:].mean() < 0.1 * alone and said[:, 165:].mean() < 0.2 * alone


@pytest.mark.parametrize("smoothing", [2e-3, 1e-2])
def test_what_that_leaves_in_a_friction_is_what_is_said(smoothing):
    """The torque of a friction along the motion shown to it, against that along the true one."""
    data, group, truth = periodic_positions()
    group = replace(group, rest=None)
    problem = set_up(data).problem
    (friction,) = [h for h in catalogue(problem.structure) if h.effect == "coulomb_friction"]
    effect = Effect(friction, np.array([1.0, 0.0, smoothing]))
    seen = predict(Model(problem.structure, problem.nominal, (effect,)), group, problem.sampling)
    motion = seen.motion()
    exact = replace(motion, error=truth - group.signal_share * seen.solution.Q)
    off = motion.lines(friction.law(effect.p, motion, 0, 0.0) - friction.law(effect.p, exact, 0, 0.0))
    assert np.mean(law_noise(seen, group)) / np.mean(np.abs(off) ** 2) == pytest.approx(1.0, abs=0.3)


def test_segments_whose_clocks_begin_anew_came_one_after_the_other():
    data, group, _ = periodic_positions()
    n, length = len(data.segments), data.segments[0].n_samples / RATE
    assert np.allclose(np.diff(group.start), length)
    # Absolute times count as they are, pauses and the order of recording too.
    offsets = 5.0 + 40.0 * np.arange(n)[::-1]
    late = replace(data, segments=tuple(replace(s, t=s.t + x) for s, x in zip(data.segments, offsets, strict=True)))
    (again,) = build_groups(late)
    assert np.allclose(again.start - group.start, offsets - length * np.arange(n))
