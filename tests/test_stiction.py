"""Motors that stick: friction of a set of values at rest, in periodic records.

The bench is simulated here, apart from the plant of the project: two inertias on a spring, and friction at the motor
that holds it as long as no more than its static size is asked, to the step (Karnopp 1985).
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from ident.checking import inspect_dataset
from ident.coordinates import pack, unpack
from ident.costs import fair_costs, joint_costs
from ident.dataset import Dataset, Segment
from ident.derivatives import jacobian
from ident.diagnosis import diagnose
from ident.extended import predict
from ident.group import Group
from ident.hypotheses import catalogue
from ident.hypotheses.friction import RESOLVED, other_turn, within
from ident.identification import identify, set_up, whitened
from ident.model import Effect, Model, along_record
from ident.output_noise import noise_covariance
from ident.problem import data_counts, predictions, residual
from ident.pruning import plainly_special
from ident.records import build_groups, drift, with_turns_alike, without_creep
from ident.refits import either_turn, refit
from ident.stiction import LEFT_HELD, as_held, held, held_share
from ident.weights import make_weights
from robot_assets.robot import load_robot
from tests.conftest import of_motions, quick_experiment, small_plan, through_postures

FS, PERIOD, PERIODS, STEPS = 1000.0, 2000, 3, 16
MOTOR, LOAD, SPRING, DAMPER, VISCOUS = 0.004, 0.00477, 380.0, 0.03, 0.02
GAINS = 6.0, 0.05  # N m/rad and N m s/rad, of the loop
NOISE = 4e-6, 2e-2  # rad and N m
COULOMB, STATIC, STRIBECK = 0.3, 0.55, 0.4  # N m, N m, rad/s


@njit(cache=True)
def kick(h, u, x, v, y, w, coulomb, static, stribeck):
    """Velocities of motor and load after a time ``h`` at the same positions."""
    gear = SPRING * (x - y) + DAMPER * (v - w)
    drive = u - gear - VISCOUS * v
    w += h * gear / LOAD
    if v == 0.0:
        size = min(abs(drive), static)
        return h * (drive - (size if drive > 0 else -size)) / MOTOR, w
    size = coulomb + (static - coulomb) * np.exp(-((v / stribeck) ** 2))
    new = v + h * (drive - (size if v > 0 else -size)) / MOTOR
    return (0.0 if new * v < 0.0 else new), w


@njit(cache=True)
def run_bench(reference, feed, coulomb, static, stribeck, q_noise, offset):
    """Sampled torque, position, and whether the motor stuck at the sample, of a loop of samples with a held torque."""
    n, h = len(reference), 1.0 / (FS * STEPS)
    tau, q, stuck = np.empty(n), np.empty(n), np.zeros(n)
    x, v, y, w = offset, 0.0, offset, 0.0
    last = offset
    for k in range(n):
        q[k] = x + q_noise[k]
        u = feed[k] + GAINS[0] * (reference[k] - q[k]) - GAINS[1] * (q[k] - last) * FS
        last, tau[k] = q[k], u
        stuck[k] = 1.0 if v == 0.0 else 0.0
        for _ in range(STEPS):
            v, w = kick(0.5 * h, u, x, v, y, w, coulomb, static, stribeck)
            x += h * v
            y += h * w
            v, w = kick(0.5 * h, u, x, v, y, w, coulomb, static, stribeck)
    return tau, q, stuck


@cache
def sticking(static=COULOMB, seed=0):
    """Records at two postures and three levels, those at a third posture held out; and the share of samples at rest, by
    segment."""
    bench, rng = load_robot("twomass"), np.random.default_rng(seed)
    lines = np.arange(1, 181)
    t, segments, shares = np.arange(PERIODS * PERIOD) / FS, [], {}
    for posture, offset in (("a", 0.0), ("b", 0.7), ("c", -0.4)):
        for level in (1.0, 0.4, 0.2):
            X = np.zeros(PERIOD // 2 + 1, complex)
            X[lines] = np.exp(2j * np.pi * rng.uniform(size=lines.size))
            feed = np.fft.irfft(X, n=PERIOD)
            feed = np.tile(1.6 * level * feed / feed.std(), PERIODS + 1)
            noise = NOISE[0] * rng.normal(size=len(feed))
            tau, q, stuck = run_bench(np.full(len(feed), offset), feed, COULOMB, static, STRIBECK, noise, offset)
            tau, q, stuck = (x[PERIOD:] for x in (tau + NOISE[1] * rng.normal(size=len(feed)), q, stuck))
            name = f"{posture}{level}"
            shares[name] = stuck.mean()
            segments.append(
                Segment(
                    name, "multisine", "validation" if posture == "c" else "identification", t, tau[:, None], q[:, None],
                    operating_point=posture, q0=np.array([offset]), period=PERIOD, periods=PERIODS, amplitude=level, excited_lines=lines,
                )
            )  # fmt: skip
    data = Dataset(
        "sticking",
        bench,
        FS,
        bench.joint_names,
        "zoh",
        np.array([NOISE[0]]),
        np.array([NOISE[1]]),
        None,
        tuple(segments),
    )
    return data, shares


def friction(effect, p):
    """The bench as it is, with a friction."""
    problem = set_up(sticking()[0]).problem
    h = next(h for h in catalogue(problem.structure) if h.effect == effect)
    par = replace(
        problem.nominal,
        inertia=np.array([MOTOR]),
        stiffness=np.array([SPRING]),
        damping=np.array([DAMPER]),
        viscous=np.array([VISCOUS]),
    )
    return problem, Model(problem.structure, par, (Effect(h, np.array(p)),))


def test_where_motors_stick_is_known():
    data, shares = sticking()
    assert shares["a0.2"] > 0.3 > shares["a0.4"] > shares["a1.0"] > 0.0
    for group in build_groups(data):
        for name, rest in zip(group.segments, group.rest, strict=True):
            # And where they turn between two points of the grid.
            assert shares[name] < rest.mean() < shares[name] + 0.25


def test_dry_friction_that_sticks_leaves_little():
    """At its true figures, where the motor sticks most: a hundred times as much without what rest says."""
    problem, model = friction("coulomb_friction", [COULOMB, 0.0, 1e-4, 0.0])
    group = problem.groups[0]
    pred = predict(model, group, problem.sampling)
    blind = predict(model, replace(group, rest=None), problem.sampling)
    noise = noise_covariance(problem, group, pred)[:, 0, 0].real
    left, unknown = (np.mean(np.abs(residual(group, x))[..., 0] ** 2 / noise, axis=1) for x in (pred, blind))
    assert left[-1] < 6.0
    assert unknown[-1] > 50.0 * left[-1]


@pytest.mark.parametrize("static", [pytest.param(COULOMB, marks=pytest.mark.slow), STATIC])
def test_friction_that_sticks_is_named(static):
    verdict = diagnose(sticking(static)[0], max_causes=2 if static == COULOMB else 1)
    effect = "coulomb_friction" if static == COULOMB else "stribeck_friction"
    assert [(c.effect, c.joint) for c in verdict.causes if c.probability > 0.5] == [(effect, "drive")]
    found = verdict.causes[0].parameters
    if static == COULOMB:
        assert found["torque"].value == pytest.approx(COULOMB, rel=0.03) and abs(found["asymmetry"].value) < 0.02
    else:
        assert found["static"].value == pytest.approx(STATIC, rel=0.05)
        assert found["stribeck_velocity"].value == pytest.approx(STRIBECK, rel=0.15)
    assert verdict.gain.gap_closed > 0.95


@pytest.mark.parametrize(("every", "noise"), [(2, NOISE[0]), (4, NOISE[0]), (2, 5.0 * NOISE[0])])
def test_where_friction_turns_along_a_motion_looks_like_no_other_cause(every, noise):
    """The motor rests for hundredths of a second wherever it turns, far longer than lines of the compared band show."""
    bench, segments = load_robot("twomass"), []
    for i, role in enumerate(("identification", "validation")):
        rng = np.random.default_rng(60 + i)
        t, q, _, _ = through_postures(rng, 1, FS, 30.0)
        reference = 4.0 * q[:, 0]
        off = noise * rng.normal(size=len(t))
        tau, q, stuck = run_bench(reference, np.zeros(len(t)), COULOMB, COULOMB, STRIBECK, off, reference[0])
        assert 0.0 < stuck.mean() < 0.2
        tau, q = (x[::every, None] for x in (tau + 1e-3 * rng.normal(size=len(t)), q))
        segments.append(Segment(name=f"m{i}", role=role, kind="trajectory", t=t[::every], tau=tau, q=q))
    verdict = diagnose(of_motions(bench, FS / every, segments))
    (cause,) = [c for c in verdict.causes if c.probability > 0.5]
    assert cause.effect == "coulomb_friction" and cause.probability > 0.9
    assert cause.parameters["torque"].value == pytest.approx(COULOMB, rel=0.02)
    assert all(c.probability < 0.3 for c in verdict.causes if c is not cause)


def test_what_rest_leaves_of_noise():
    """Covariance of lines of coloured noise at two joints, one of which is held now and then, against draws."""
    rng, T, K, draws = np.random.default_rng(4), 600, 90, 4000
    mix = np.array([[1.0, 0.0], [0.6, 0.8]])
    shape = np.where(np.arange(T // 2 + 1) < K, 1.0 + (np.arange(T // 2 + 1) / 30.0) ** 2, 0.0)
    free = np.ones((1, T, 2))
    free[0, 100:180, 0] = free[0, 300:340, 0] = free[0, 500:507, 0] = 0.3
    lines = (rng.normal(size=(draws, T // 2 + 1, 2)) + 1j * rng.normal(size=(draws, T // 2 + 1, 2))) * np.sqrt(0.5)
    lines = (lines @ mix.T) * shape[:, None]
    lines[:, 0] = 0.0
    seen = np.fft.rfft(np.fft.irfft(lines, n=T, axis=1, norm="forward") * free, axis=1, norm="forward")[:, :K]
    drawn = np.einsum("dki,dkj->kij", seen, seen.conj()) / draws
    M = np.fft.fft(free[0], axis=0, norm="forward")
    share = np.fft.ifft(np.einsum("ki,kj->kij", M, M.conj()), axis=0, norm="forward")
    S = shape[:K, None, None] ** 2 * (mix @ mix.T)
    said = as_held(S, share)
    middle = slice(20, K - 20)  # beyond the last line there is more here than none
    for i, j in ((0, 0), (0, 1), (1, 1)):
        assert said[middle, i, j].real == pytest.approx(drawn[middle, i, j].real, rel=0.12)
        assert said[middle, i, j].mean().real == pytest.approx(drawn[middle, i, j].mean().real, rel=0.03)
    assert np.array_equal(as_held(S, None), S)


def test_only_a_motor_that_rests_is_held():
    problem, model = friction("coulomb_friction", [COULOMB, 0.0, 1e-4, 0.0])
    group: Group = problem.groups[0]
    pred = predict(model, group, problem.sampling)
    still = held(pred, group)
    assert not np.any(still & ~group.rest) and 0.2 < still[-1].mean() <= group.rest[-1].mean()
    # Without a lag: the mean share of its power that is left.
    assert held_share(pred, group)[0, 0, 0].real == pytest.approx(1.0 - (1.0 - LEFT_HELD**2) * still.mean())
    assert held_share(predict(replace(model, effects=()), group, problem.sampling), group) is None
    moving = replace(group, rest=np.zeros_like(group.rest))
    assert held_share(predict(model, moving, problem.sampling), moving) is None


@pytest.mark.parametrize("creep", [0.0, 3e-4])
def test_a_motor_that_creeps_is_periodic_but_for_a_line(creep):
    """A motor that slips by as much in each period, all at once: less the line, it repeats."""
    rng, P, N = np.random.default_rng(5), 4, 1000
    t = np.arange(P * N)
    swing = np.tile(1e-3 * np.sin(2 * np.pi * 3 * np.arange(N) / N), P)
    x = swing + creep * ((t + 400) // N) + 1e-6 * rng.normal(size=P * N)
    y = without_creep(x.reshape(P, N, 1))
    assert y.mean() == pytest.approx(x.mean(), abs=1e-9)
    if not creep:
        assert np.array_equal(y[..., 0].ravel(), x)
    assert (y - y[:1]).mean(axis=(1, 2)) == pytest.approx(np.zeros(P), abs=0.01 * 3e-4)


@pytest.mark.parametrize("slow", [0.0, 2e-3])
def test_a_single_period_whose_transient_goes_on_slowly_is_periodic_but_for_a_line(slow):
    """The integrator of a loop takes longer than the transient: by the end of the period before, its jump is told."""
    rng, N = np.random.default_rng(6), 4000
    t = np.arange(2 * N) / N
    swing = 1e-3 * np.sin(2 * np.pi * 3 * t)
    ringing = 1e-2 * np.exp(-t / 0.03) * np.cos(2 * np.pi * 40 * t)
    x = (swing + ringing + slow * np.exp(-t / 1.1) + 1e-6 * rng.normal(size=2 * N)).reshape(2, N, 1)
    y = without_creep(x[1:], x[0])
    assert np.array_equal(without_creep(x[1:]), x[1:])
    if not slow:
        assert np.array_equal(y, x[1:])
    left = np.fft.rfft(y[0, :, 0] - swing[N:])[1:300] / N
    jump = slow * (np.exp(-1 / 1.1) - np.exp(-2 / 1.1))
    # Lines of a jump, and of what bends less than a tenth of that.
    lines = jump / (2 * np.pi * np.arange(1, 300))
    assert np.all(np.abs(left) < 0.15 * lines + 1e-7)


@given(st.integers(0, 10**6), st.floats(1e-4, 1e-2), st.booleans())
def test_a_single_period_that_ends_elsewhere_than_it_began_is_periodic_but_for_a_line(seed, far, drifts):
    rng, N = np.random.default_rng(seed), 2000
    phase = 2 * np.pi * (np.arange(N)[:, None] / N * np.arange(1, 100) + rng.uniform(size=99))
    x = 1e-3 * np.cos(phase).sum(axis=1) / 10 + 1e-6 * rng.normal(size=N)
    line = drifts * far * ((np.arange(N) + 0.5) / N - 0.5)
    assert drift((x + line)[:, None])[:, 0] == pytest.approx(line, abs=0.02 * far * drifts + 1e-12)


@pytest.mark.parametrize("corner", [0, 1])
def test_a_corner_where_a_period_begins_is_no_drift(corner):
    """Of a triangle, and of a motion that begins with a jolt."""
    t = np.arange(2000) / 2000
    x = (np.abs(2.0 * t - 1.0), t * np.exp(-20.0 * t))[corner] + 1e-6 * np.random.default_rng(1).normal(size=2000)
    assert not np.any(drift(x[:, None]))


def settling(robot, seed, far):
    """One period of each experiment, over which the reference of a loop moves on by so many times its rms."""
    plan = small_plan(robot, seed, levels=(1.0,), period=1000, validation_points=0, injection="position")
    N, P = plan.excitation.period, plan.excitation.periods
    way = far * np.linspace(0.0, 1.0, P * N)[:, None] * np.random.default_rng(seed).choice([-1.0, 1.0], robot.n)
    moved = tuple(replace(e, r=np.tile(e.r, (P, 1)) + way * np.std(e.r)) for e in plan.experiments)
    data = quick_experiment(replace(plan, experiments=moved), seed=seed)
    last = {"r": None, "periods": 1, "transient_periods": 0}
    segments = tuple(replace(s, t=s.t[-N:], tau=s.tau[-N:], q=s.q[-N:], **last) for s in data.segments)
    return replace(data, segments=segments)


def test_drives_are_right_where_a_single_period_drifts(ur10):
    """Springs of the wrist had been 0.006 to 0.02 of what they are, and 90 times the noise was left."""
    data = settling(ur10, 3, 0.5)
    assert any("had not settled" in text for text in inspect_dataset(data).warnings)
    setup, result = identify(data)
    assert all(g.drift is not None for g in setup.problem.groups)
    assert result.chi2_per_dof < 1.3
    assert result.model.par.stiffness == pytest.approx(ur10.array("stiffness"), rel=5e-3)
    preds = predictions(setup.problem, result.model, result.remainders)
    mean = np.concatenate([x[:, 0] for x in whitened(setup.problem, result, preds)])
    assert np.sqrt(np.mean(np.abs(mean) ** 2)) < 1.5  # what the velocity takes stands there alone


def test_a_drive_that_hunts_between_steps_of_its_encoder_does_not_creep():
    """Pulses here and there, of which some fall on the ends of the periods: most differences of samples are small."""
    rng, P, N = np.random.default_rng(2), 3, 4000
    x = 0.01 * rng.normal(size=(P, N, 1)) + 20.0 * (rng.random((P, N, 1)) < 0.1) * rng.choice(
        [-1.0, 1.0], size=(P, N, 1)
    )
    assert np.array_equal(without_creep(x), x)


def test_what_is_held_hangs_on_few_parameters(monkeypatch):
    """Columns beside dry friction, against differences: far nearer to these than those of a motor that nothing
    holds."""
    problem, model = friction("coulomb_friction", [COULOMB, 0.1, 1e-4, 0.0])
    group = problem.groups[0]
    pred = predict(model, group, problem.sampling)
    x, off = pack(model), {}
    J = jacobian(problem, model, group, pred).dense()
    with monkeypatch.context() as without:
        without.setattr("ident.derivatives.held", lambda *_: None)
        unaware = jacobian(problem, model, group, pred).dense()
    for c in (0, 2, 3, len(model.par.to_log()) + 1):
        ends = [
            predict(
                unpack(model, x + s * 1e-4 * (np.arange(len(x)) == c), np.inf),
                group,
                problem.sampling,
                W=pred.solution.W,
            ).U
            for s in (1, -1)
        ]
        slope = (ends[0] - ends[1])[-1, : J.shape[1]] / 2e-4
        off[c] = [np.linalg.norm(X[-1, ..., c] - slope) / np.linalg.norm(slope) for X in (J, unaware)]
    assert all(near < 0.5 for near, _ in off.values()) and off[len(model.par.to_log()) + 1][0] < 1e-2
    assert all(aware < 0.7 * unaware for aware, unaware in (off[c] for c in (0, 2)))


def test_noise_that_friction_takes_from_a_motor_at_rest_is_no_merit():
    """Records of noise alone of a motor that stands still, of which friction takes a part: it costs as much as
    without."""
    data, _ = sticking()
    rng = np.random.default_rng(6)
    still = [
        replace(s, q=NOISE[0] * rng.normal(size=s.q.shape) + s.q0, tau=NOISE[1] * rng.normal(size=s.tau.shape))
        for s in data.segments
        if s.role == "identification"
    ]
    problem, model = friction("coulomb_friction", [COULOMB, 0.0, 1e-4, 0.0])
    groups = build_groups(replace(data, segments=tuple(still)))
    assert all(g.rest.mean() > 0.99 for g in groups)
    for share in (0.0, 1.0):  # of the scatter between periods
        p = replace(problem, groups=groups, scatter_share=share)
        without = [predict(replace(model, effects=()), g, p.sampling) for g in groups]
        held_by = [predict(model, g, p.sampling) for g in groups]
        weights = make_weights(p, without, 0.0)
        count = np.sum(data_counts(p))
        assert np.sum(joint_costs(p, held_by, weights)) < 0.9 * count
        fair = [np.sum(fair_costs(p, x, weights)) for x in (without, held_by)]
        assert fair[1] > fair[0] - 0.15 * count


def test_rest_tells_nothing_of_a_friction_within_the_noise_of_what_is_asked():
    """Else the friction of a motor that hardly moves would explain the noise of its torque, whatever its size."""
    problem, model = friction("coulomb_friction", [COULOMB, 0.0, 1e-4, 0.0])
    group = problem.groups[0]
    noise = predict(model, group, problem.sampling).motion().asked_noise(0)
    assert NOISE[1] / 5 < noise < 0.2 * COULOMB
    still = []
    for size in (1.0, 6.0):
        small = replace(model, effects=(replace(model.effects[0], p=np.array([size * noise, 0.0, 1e-4])),))
        still.append(held(predict(small, group, problem.sampling), group).mean())
    assert still[0] == 0.0 < still[1]


def test_a_law_that_has_lost_what_sets_it_apart_is_its_special_case():
    problem, model = friction("coulomb_friction", [COULOMB, 0.0, 1e-4, 0.0])
    laws = {h.effect: h for h in catalogue(problem.structure)}

    def special(effect, p):
        return plainly_special(problem, model, Effect(laws[effect], np.array(p)))

    assert [special("stribeck_friction", [2.0, static, STRIBECK, 1e-3, 2.0, 0.0]) for static in (1.7, 2.2, 2.4)] == [
        True,
        True,
        False,
    ]
    assert not special("coulomb_friction", [2.0, 0.0, 1e-3, 0.0])


def test_a_dip_within_rest_is_none_beside_a_law_along_the_record():
    problem, model = friction("coulomb_friction", [COULOMB, 0.0, 1e-4, 0.0])
    # What passes between two samples would be none without that law too.
    problem = replace(problem, sampling=replace(problem.sampling, sample_time=1e-6))
    laws = {h.effect: h for h in catalogue(problem.structure)}
    slow = min(g.least_velocity[:, 0].mean() for g in problem.groups)
    along = replace(model, effects=(Effect(along_record(laws["backlash"]), np.array([1e-3, 0.0])),))
    for width, beside in ((0.5, True), (10.0, False)):
        dip = Effect(laws["stribeck_friction"], np.array([COULOMB, STATIC, width * slow, 1e-4, 2.0, 0.0]))
        assert plainly_special(problem, along, dip) is beside
        assert not plainly_special(problem, model, dip)


@pytest.mark.parametrize("begun", [1e-6, 0.1])
def test_a_friction_that_sticks_is_found_from_either_side_of_what_is_seen(begun):
    """Fits begun where it turns at once, and within a velocity that is seen: no step leads from the latter to the
    former."""
    problem, model = friction("coulomb_friction", [COULOMB, 0.0, begun, 0.0])
    preds = [predict(model, g, problem.sampling) for g in problem.groups]
    weights = make_weights(problem, preds, 0.0)
    first = refit(problem, model, weights, [p.solution.W for p in preds])
    last = either_turn(problem, first, first.model.effects[0])
    seen = min(g.turn_noise[0] for g in problem.groups)
    assert last.model.effects[0].value("smoothing_velocity") < 2.0 * seen
    assert last.cost <= first.cost and (begun < seen or last.cost < 0.5 * first.cost)
    assert last.model.effects[0].value("torque") == pytest.approx(COULOMB, rel=0.03)
    # Without motors that rest, or for another effect, there is nothing to choose.
    moving = replace(problem, groups=tuple(replace(g, rest=None) for g in problem.groups))
    assert either_turn(moving, first, first.model.effects[0]) is first


def test_friction_turns_alike_in_all_records_of_a_dataset():
    """One posture more or less noisy than the others, or held out, must not decide otherwise whether a turn is seen."""
    problem, _ = friction("coulomb_friction", [COULOMB, 0.0, 1e-6, 0.0])
    group = replace(problem.groups[0], alike_turn_noise=None)
    noisy = replace(group, omega=2.0 * group.omega)
    assert noisy.turn_noise[0] > 1.5 * group.turn_noise[0]
    (one, other), (held_out,) = with_turns_alike([group, noisy], [noisy])
    mean = np.sqrt(np.mean([group.turn_noise**2, noisy.turn_noise**2], axis=0))
    assert all(g.turn_noise == pytest.approx(mean) for g in (one, other, held_out, one.pick(np.array([0]))))
    along = replace(group, window=np.ones(group.n_time))
    assert with_turns_alike([along], [group]) == ((along,), (group,))


def test_what_is_asked_of_a_friction_at_its_size_loses_little_of_one_side_of_its_noise():
    """In the mean over noise, where a limit alone would take 0.4 of its standard deviation; without jumps, and between the
    limits where these are within the noise."""
    noise = np.random.default_rng(0).normal(size=200_000)
    given = within(3.0 + 0.1 * noise, np.full(noise.shape, -3.0), np.full(noise.shape, 3.0), 0.1)
    assert given.max() == 3.0 and given.mean() - 3.0 > -0.33 * 0.1
    asked = np.linspace(-4.0, 4.0, 8001)
    limits = np.full(asked.shape, -2.0), np.full(asked.shape, 3.0)
    given = within(asked, *limits, 0.1)
    assert np.diff(given).max() < 2.5 * (asked[1] - asked[0]) and np.all(np.diff(given) >= 0.0)
    assert np.array_equal(given[np.abs(asked) < 1.5], asked[np.abs(asked) < 1.5])
    small = within(asked, np.full(asked.shape, -0.2), np.full(asked.shape, 0.2), 1.0)
    assert small.min() == -0.2 and small.max() == 0.2 and np.all(small * asked >= 0.0)


def test_a_friction_is_begun_from_either_side_of_what_rest_tells():
    """Turning at once where it turns within what is seen, and the other way round."""
    group = SimpleNamespace(window=None, rest=np.ones((1, 4, 1), bool), turn_noise=np.array([1e-3]))
    assert other_turn([group], 0, 1.0) == pytest.approx(0.1 * RESOLVED * 1e-3)
    assert other_turn([group], 0, 1e-5) == pytest.approx(2.0 * RESOLVED * 1e-3)
    assert other_turn([SimpleNamespace(window=None, rest=None)], 0, 1.0) is None
