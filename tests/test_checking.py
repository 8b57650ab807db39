"""What `simgap check` says of a dataset: contents, and faults put in one at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import scipy.signal

from ident import skew_checks
from ident.channel_checks import (
    anti_resonance,
    identical_warnings,
    lost_sample_warnings,
    stuck_warnings,
    unit_warnings,
)
from ident.checking import inspect_dataset
from ident.dataset import Dataset, Segment
from ident.skew_checks import _far_skew as far_skew
from ident.skew_checks import joint_skews, link_skew, skew_warnings, torque_skew
from ident.torque_checks import contradictions, match_torques, torque_warnings
from robot_assets.robot import load_robot

RATE, N = 500.0, 6000


def recording(robot, rng, late=0.0, q_link_late=0.0, N=N, rate=RATE):
    """Torque and link position of rigid bodies, friction and gears, by Pinocchio; channels may come late, s."""
    model = pin.buildModelFromUrdf(str(robot.urdf))
    data = model.createData()
    t = np.arange(N) / rate

    def torque(q, v, a):
        rigid = np.array([pin.rnea(model, data, *x) for x in zip(q, v, a)])
        f, J = robot.array("viscous_friction"), robot.array("motor_inertia")
        return rigid, rigid + J * a + f * v + 0.02 * robot.array("torque_limit") * np.tanh(v / 0.01)

    seed = int(rng.integers(1 << 30))
    q, v, _ = motion(t, seed, robot)
    _, tau = torque(*motion(t - late, seed, robot))
    before = motion(t - q_link_late, seed, robot)
    q_link = before[0] - torque(*before)[0] / robot.array("stiffness")
    tau = tau + 1e-3 * robot.array("torque_limit") * rng.normal(size=tau.shape)
    noise = 3e-6 * rng.normal(size=(2, *q.shape))
    return Segment("log", "trajectory", "identification", t, tau, q + noise[0], qd=v, q_link=q_link + noise[1])


def motion(t, seed, robot):
    """Position, velocity and acceleration of five harmonics inside the limits, (N, n)."""
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * np.arange(1, 6) / 6.0
    q, v, a = (np.zeros((len(t), robot.n)) for _ in range(3))
    cos, sin = np.cos(np.outer(t, w)), np.sin(np.outer(t, w))
    for j in range(robot.n):
        c, s = rng.normal(size=(2, 5)) / np.arange(1, 6)
        size = 0.5 / np.sum(np.abs(c) + np.abs(s))
        c, s = size * c, size * s
        q[:, j] = cos @ c + sin @ s + 0.5 * (robot.q_min[j] + robot.q_max[j])
        v[:, j], a[:, j] = cos @ (s * w) - sin @ (c * w), -cos @ (c * w**2) - sin @ (s * w**2)
    return q, v, a


def dataset(robot, *segments):
    return Dataset("d", robot, RATE, robot.joint_names, "none", None, None, None, segments)


@pytest.fixture(scope="module")
def arm():
    return load_robot("ur10_bare")


@pytest.fixture(scope="module")
def log(arm):
    return recording(arm, np.random.default_rng(1))


def warnings(arm, *segments):
    return inspect_dataset(dataset(arm, *segments)).warnings


def test_a_sound_recording_gives_no_warning_but_of_what_it_lacks(arm, log):
    found = warnings(arm, log, replace(log, name="held", role="validation"))
    assert all("anti-resonance" in w for w in found), found
    assert any("2 segments" in w for w in found)
    report = inspect_dataset(dataset(arm, log))
    assert "no validation" in report.warnings[0]
    assert report.channels["q_link"] == (1, 2, 3, 4, 5, 6) and "r" not in report.channels
    assert report.duration == N / RATE and "shoulder_lift_joint: q" in report.text()


def change(x, j, f):
    x = x.copy()
    x[:, j] = f(x[:, j])
    return x


def frozen(x):
    k = int(np.argmax(np.abs(np.gradient(x))[500:-500])) + 500
    out = x.copy()
    out[k : k + 100] = out[k]
    return out


FAULTS = {
    "degrees": (lambda s: replace(s, q=np.rad2deg(s.q), qd=None, q_link=None), "its limit"),
    "one joint in degrees": (lambda s: replace(s, q=change(s.q, 2, np.rad2deg)), "q_3"),
    "milliradians": (lambda s: replace(s, q=change(s.q, 2, lambda x: 1e3 * x), qd=None), "q_3 (elbow_joint) goes from"),
    "torque of the motor side": (lambda s: replace(s, tau=s.tau / 1e4), "before the gear"),
    "torque in mN m": (lambda s: replace(s, tau=s.tau * 1e3), "tau_1"),
    "velocity in deg/s": (lambda s: replace(s, qd=np.rad2deg(s.qd)), "qd_1 (shoulder_pan_joint) is 57."),
    "velocity of the wrong sign": (lambda s: replace(s, qd=change(s.qd, 1, np.negative)), "qd_2"),
    "link encoder in degrees": (lambda s: replace(s, q_link=change(s.q_link, 0, np.rad2deg)), "q_link_1"),
    "no torque": (lambda s: replace(s, tau=change(s.tau, 3, np.zeros_like)), "tau_4 (wrist_1_joint) is frozen"),
    "torque beyond its limit": (
        lambda s: replace(s, tau=change(s.tau, 5, lambda x: x + 70.0)),
        "tau_6 (wrist_3_joint) reaches 7",
    ),
    "torque clipped": (lambda s: replace(s, tau=np.clip(s.tau, -140, 140)), "tau_2 (shoulder_lift_joint) is clipped"),
    "torque frozen": (
        lambda s: replace(s, tau=change(s.tau, 1, frozen)),
        "tau_2 (shoulder_lift_joint) stands still for 0.2 s",
    ),
    "position frozen": (
        lambda s: replace(s, q=change(s.q, 1, frozen), qd=None, q_link=None),
        "q_2 (shoulder_lift_joint) stands still for 0.2 s",
    ),
    "samples lost": (lambda s: without(s), "double steps"),
    "samples repeated": (lambda s: repeated(s), "repeat the one before"),
    "one joint at rest": (
        lambda s: replace(s, q=change(s.q, 5, lambda x: 1e-4 * x), qd=None, q_link=None),
        "joints 6 hardly move",
    ),
    "one direction": (
        lambda s: replace(s, q=change(s.q, 0, lambda x: np.linspace(0, 1, len(x)) + 1e-6 * x), qd=None, q_link=None),
        "joints 1 move in one direction",
    ),
    "filtered": (lambda s: replace(s, tau=smooth(s.tau)), "the log was filtered"),
    "torque late": (lambda s: replace(s, tau=np.roll(s.tau, 6, axis=0)), "torque comes 12 ms after"),
    "torque of the wrong sign": (lambda s: replace(s, tau=-s.tau), "tau_1 (shoulder_pan_joint) runs against"),
    "one torque of the wrong sign": (
        lambda s: replace(s, tau=change(s.tau, 2, np.negative)),
        "tau_3 (elbow_joint) runs against",
    ),
    "one torque before the gear": (
        lambda s: replace(s, tau=change(s.tau, 1, lambda x: x / 101)),
        "tau_2 (shoulder_lift_joint) is 0.0",
    ),
    "torques swapped": (
        lambda s: replace(s, tau=s.tau[:, [0, 2, 1, 3, 4, 5]]),
        "tau_2 (shoulder_lift_joint) follows what joint 3 needs",
    ),
    "a position of the wrong sign": (
        lambda s: replace(s, q=change(s.q, 1, np.negative), qd=None, q_link=None),
        "which the torques do with q_2 reversed: wrong sign?",
    ),
    "a mirrored axis": (
        lambda s: replace(s, q=change(s.q, 1, np.negative), tau=change(s.tau, 1, np.negative), qd=None, q_link=None),
        "which the torques do with both q_2 and tau_2 reversed: wrong sign?",
    ),
    "all positions of the wrong sign": (
        lambda s: replace(s, q=-s.q, qd=None, q_link=None),
        "which the torques do with q_3 reversed: wrong sign?",
    ),
    "a position at a base that gravity does not load": (
        lambda s: replace(s, q=change(s.q, 0, np.negative), qd=None, q_link=None),
        "tau_1 (shoulder_pan_joint) runs against what bodies and motor need, -0.984 times it: wrong sign of tau_1, or of q_1?",
    ),
    "one torque for two joints": (
        lambda s: replace(s, tau=s.tau[:, [0, 1, 1, 3, 4, 5]]),
        "tau_2 (shoulder_lift_joint) and tau_3 (elbow_joint) are identical: one column for two joints?",
    ),
    "one position for two joints": (
        lambda s: replace(s, q=s.q[:, [0, 1, 2, 3, 3, 5]], qd=None, q_link=None),
        "q_4 (wrist_1_joint) and q_5 (wrist_2_joint) are identical",
    ),
    "link late": (
        lambda s: replace(s, q_link=np.roll(s.q_link, 2, axis=0)),
        "q_link_1 (shoulder_pan_joint) comes 4 ms after",
    ),
}


def without(s):
    keep = np.ones(len(s.t), bool)
    keep[np.random.default_rng(3).choice(len(keep), 60, replace=False)] = False
    return replace(s, t=s.t[: keep.sum()], tau=s.tau[keep], q=s.q[keep], qd=None, q_link=None)


def repeated(s):
    pick = np.arange(len(s.t))
    twice = np.random.default_rng(3).choice(len(pick) - 1, 60, replace=False) + 1
    pick[twice] -= 1
    return replace(s, tau=s.tau[pick], q=s.q[pick], qd=None, q_link=None)


def smooth(x):
    import scipy.signal

    return scipy.signal.sosfiltfilt(scipy.signal.butter(6, 2 / (RATE / 2), output="sos"), x, axis=0)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found(arm, log, fault):
    make, expected = FAULTS[fault]
    found = warnings(arm, make(log))
    assert any(expected in w for w in found), found


def test_channels_that_stand_still_are_not_those_of_another_joint(arm, log):
    still = change(change(log.tau, 1, np.zeros_like), 2, np.zeros_like)
    assert identical_warnings(replace(log, tau=still), dataset(arm, log)) == []


def test_a_position_that_waits_for_its_next_count_does_not_stand_still(arm, log):
    """It goes to and fro between two counts, and stays on one as long as it is far from the next."""
    k = np.arange(N)
    q = change(log.q, 1, lambda x: 1e-4 * np.where((k > 1000) & (k < 1100), 0, k % 2))
    assert not any("stands still" in w for w in stuck_warnings(replace(log, q=q), dataset(arm, log)))


def test_a_link_that_swings_near_its_resonance_has_the_unit_of_its_motor(arm, log):
    """Whether it moves little else or follows its motor for the most part; degrees are told of the latter."""
    j, t = 2, log.t
    hz = 0.6 * anti_resonance(log, arm)[j]
    for slow, told in ((0.0, False), (0.5, True)):
        fast, drift = 0.2 * np.sin(2 * np.pi * hz * t), slow * np.sin(2 * np.pi * 0.3 * t)
        q, q_link = log.q.copy(), log.q.copy()
        q[:, j], q_link[:, j] = drift + fast, drift + 1.56 * fast
        s = replace(log, q=q, q_link=q_link, qd=None)
        assert not any(w.startswith("q_link_3") for w in unit_warnings(s, dataset(arm, s)))
        s = replace(s, q_link=change(q_link, j, np.rad2deg))
        assert any(w.startswith("q_link_3 (elbow_joint) is 57") for w in unit_warnings(s, dataset(arm, s))) == told


def test_a_wrong_sample_rate_is_found(arm, log):
    s = replace(log, t=log.t / 2, qd=None, q_link=None)
    found = inspect_dataset(replace(dataset(arm, s), sample_rate=2 * RATE)).warnings
    assert any("wrong unit, or sample rate" in w for w in found), found


def test_an_experiment_in_which_nothing_moves_is_found(clean):
    data, _ = clean
    rng = np.random.default_rng(0)
    s = data.segments[0]
    still = replace(data, segments=(replace(s, q=s.q[:1] + 3e-6 * rng.normal(size=s.q.shape)),))
    assert any("joints 1, 2, 3, 4, 5, 6 hardly move" in w for w in inspect_dataset(still).warnings)


@pytest.mark.parametrize("late", [-0.008, 0.0, 0.0035])
@pytest.mark.parametrize("name", ["ur10_bare", "panda_bare"])
def test_skews_are_estimated_within_their_deviation(name, late):
    robot = load_robot(name)
    s = recording(robot, np.random.default_rng(7), late=late, q_link_late=late)
    found = torque_skew(s, dataset(robot, s))
    assert abs(found.late - late) < 4 * found.std + 1e-4 and found.std < 2e-3, found
    turned = replace(s, q_link=s.q_link + np.linspace(-0.8, 0.8, robot.n))  # the zeros of link encoders are not known
    for of in (s, turned):
        for k in link_skew(of, dataset(robot, of)):
            assert abs(k.late - late) < 4 * k.std + 2e-4 and k.std < 1e-3, k


@pytest.mark.parametrize(
    "name", ["emps", *(pytest.param(name, marks=pytest.mark.slow) for name in ("ur10_bare", "panda_bare"))]
)
def test_skews_of_less_than_a_sample_are_said_where_they_are_sure(name):
    robot, rate, found = load_robot(name), 250.0, {0.0: [], 0.6: [], -0.5: []}
    for seed in range(3):
        for late, said in found.items():
            s = recording(
                robot,
                np.random.default_rng(seed),
                late=late / rate,
                q_link_late=max(late, 0.0) / rate,
                N=3000,
                rate=rate,
            )
            said += skew_warnings(s, replace(dataset(robot, s), sample_rate=rate))
    assert found[0.0] == []
    after = [w for w in found[0.6] if w.startswith("torque")]
    assert len(after) == 3 and all(
        abs(float(w.split()[2]) - 2.4) < 0.3 and "ms after the positions" in w for w in after
    )
    assert sum(w.startswith("q_link_1") and "2.4 ms after q_1" in w for w in found[0.6]) == 3
    held = [w for w in found[-0.5] if w.startswith("torque")]
    assert len(held) == 3 and all("before the positions" in w and 'input_hold = "zoh"' in w for w in held)


@pytest.mark.parametrize("late", [-0.7, -0.217, 0.04, 0.06])
@pytest.mark.parametrize("name", ["emps", pytest.param("ur10_bare", marks=pytest.mark.slow)])
def test_torques_far_out_of_step_are_told(name, late):
    robot = load_robot(name)
    s = recording(robot, np.random.default_rng(5), late=late)
    found = torque_skew(s, dataset(robot, s))
    assert found.sure and found.late == pytest.approx(late, abs=2e-3)
    order = "after" if late > 0 else "before"
    (said,) = [w for w in skew_warnings(s, dataset(robot, s)) if w.startswith("torque")]
    assert f"ms {order} the positions" in said and "shift in [files]" in said
    assert abs(float(said.split()[2]) - 1e3 * abs(late)) < 2.0


def test_nothing_far_out_of_step_is_made_of_torques_that_no_shift_explains(monkeypatch):
    """Of another run, of wrong signs and order, of one joint alone late, and of a motion that repeats too soon."""
    searched = []
    monkeypatch.setattr(skew_checks, "_far_skew", lambda s, d: searched.append(far := far_skew(s, d)) or far)
    for name in ("emps", "ur10_bare"):
        robot = load_robot(name)
        s, other = (recording(robot, np.random.default_rng(k)) for k in (5, 9))
        wrong = [other.tau, s.tau[::-1], -s.tau, s.tau[:, ::-1]]
        if robot.n > 1:
            wrong.append(change(s.tau, 1, lambda x: np.roll(x, 50)))
        for tau in wrong:
            assert not torque_skew(replace(s, tau=tau), dataset(robot, s)).sure
    assert searched
    # Late by a quarter of a cycle is as early by one and of the other sign.
    t, robot = np.arange(N) / RATE, load_robot("emps")
    w = 2 * np.pi * 1.25
    q, a = (
        0.02 * np.sin(w * (t - late)) * np.array([1.0, w**2])[k]
        + 0.004 * np.sin(3 * w * (t - late)) * np.array([1.0, 9 * w**2])[k]
        for k, late in enumerate((0.0, 0.2))
    )
    tau = -90.0 * a[:, None] + 0.1 * np.random.default_rng(0).normal(size=(N, 1))
    s = Segment("a", "trajectory", "identification", t, tau, q[:, None])
    assert not torque_skew(s, dataset(robot, s)).sure


def test_a_torque_that_is_held_over_a_sample_is_early_by_half_of_it_and_that_is_usual():
    robot, rate = load_robot("emps"), 250.0
    s = recording(robot, np.random.default_rng(0), late=-0.5 / rate, N=3000, rate=rate)
    data = replace(dataset(robot, s), sample_rate=rate)
    assert len(skew_warnings(s, data)) == 1 and skew_warnings(s, replace(data, input_hold="zoh")) == []


def test_a_multisine_experiment_gives_no_warning(clean):
    data, _ = clean
    found = [w for w in inspect_dataset(data).warnings if "anti-resonance" not in w]
    assert not found


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("samples", [1, 2, 5, 9, 20, 63, 64, 400, 3000])
@pytest.mark.parametrize("kind", ["noise", "constant", "huge"])
def test_short_and_odd_recordings_are_reported_too(arm, samples, kind):
    rng = np.random.default_rng(0)
    x = {
        "noise": rng.normal(size=(samples, 6)),
        "constant": np.ones((samples, 6)),
        "huge": 1e12 * rng.normal(size=(samples, 6)),
    }[kind]
    q_link = np.where(np.arange(6) < 3, x, np.nan)
    for rate in (1e-2, 1e3, 1e6):
        s = Segment("log", "trajectory", "identification", np.arange(samples) / rate, x, x, qd=x, q_link=q_link)
        report = inspect_dataset(replace(dataset(arm, s), sample_rate=rate))
        assert report.warnings and report.text() and report.to_dict()


def test_one_joint_whose_torque_comes_late_is_no_skew_of_the_channels():
    robot = load_robot("ur10_bare")
    s = recording(robot, np.random.default_rng(7), late=0.0, q_link_late=0.0)
    tau = s.tau.copy()
    shift = round(0.012 * dataset(robot, s).sample_rate)
    tau[shift:, 2] = s.tau[:-shift, 2]
    late = replace(s, tau=tau)
    assert not torque_skew(late, dataset(robot, s)).sure
    said = [w for w in skew_warnings(late, dataset(robot, s)) if not w.startswith("q_link")]
    assert len(said) == 1 and said[0].startswith("tau_3 (elbow_joint) comes 12 ms after q_3")
    whole = s.tau.copy()
    whole[shift:] = s.tau[:-shift]
    found = torque_skew(replace(s, tau=whole), dataset(robot, s))
    assert found.sure and found.late == pytest.approx(0.012, abs=1e-3)


def test_torques_late_by_another_time_each_have_no_skew_in_common():
    robot = load_robot("ur10_bare")
    s = recording(robot, np.random.default_rng(7))
    lates = [6, 5, 4, 5, 6, 2]  # samples
    s = replace(s, tau=np.stack([np.roll(x, k) for x, k in zip(s.tau.T, lates)], axis=1))
    assert not torque_skew(s, dataset(robot, s)).sure
    for k, late in zip(joint_skews(s, dataset(robot, s)), lates):
        assert k.late == pytest.approx(late / RATE, abs=1e-3) or np.isnan(k.late)


def test_a_late_joint_is_told_of_none_where_others_seem_late_and_are_not(monkeypatch):
    robot = load_robot("ur10_bare")
    s = recording(robot, np.random.default_rng(7))
    s = replace(s, tau=change(s.tau, 2, lambda x: np.roll(x, 6)))
    sure, gone = skew_checks.Skew(0.012, 1e-5), np.array([0.0, 0.0, 1.0, 0.0, 0.5, 0.0])
    for other, told in ((skew_checks.UNKNOWN, [2]), (skew_checks.Skew(-0.01, 1e-3), [])):
        skews = tuple({2: sure, 4: other}.get(j, skew_checks.UNKNOWN) for j in range(6))
        monkeypatch.setattr(skew_checks, "_by_joint", lambda *_, x=skews: skew_checks._ByJoint(x, gone))
        assert [j for j, k in enumerate(joint_skews(s, dataset(robot, s))) if k.sure] == told


def test_longer_and_longer_steps_are_no_lost_samples():
    """A slow log of a joint that speeds up, and the same log without one of its samples."""
    robot = load_robot("twomass")
    t = np.arange(400) / 100.0
    q = (0.5 * np.sin(2 * np.pi * 1.5 * t) ** 3)[:, None]
    s = Segment(name="a", role="identification", kind="trajectory", t=t, tau=0.1 * q, q=q)
    assert lost_sample_warnings(s, replace(dataset(robot, s), sample_rate=100.0)) == []
    smooth = np.sin(2 * np.pi * 0.2 * np.arange(4000) / 1000.0)[:, None]
    gone = np.delete(smooth, np.arange(200, 3800, 300), axis=0)
    cut = replace(s, q=gone, tau=0.1 * gone, t=np.arange(len(gone)) / 1000.0)
    assert any("dropped" in w for w in lost_sample_warnings(cut, dataset(robot, cut)))


def test_a_log_too_short_to_tell_causes_apart_is_said_to_be(arm, log):
    cut = replace(log, **log.part(slice(0, int(1.5 * RATE))))
    short = inspect_dataset(dataset(arm, cut)).warnings
    assert any("1.5 s of motion to fit in all" in w for w in short), short
    for segments in ((log,), (cut, log)):
        assert not any("of motion to fit in all" in w for w in inspect_dataset(dataset(arm, *segments)).warnings)


@pytest.mark.slow
def test_lost_motion_of_a_gear_is_no_skew_of_the_channels():
    """Friction that follows the motion late, by a twentieth of the stroke at each turn."""
    false = 0
    for name in ("emps", "ur10_bare", "panda_bare"):
        robot = load_robot(name)
        for seed in range(4):
            s = recording(robot, np.random.default_rng(seed))
            width, z = 0.05 * np.ptp(s.q, axis=0), np.zeros(robot.n)
            followed = [z := np.clip(z + step / width, -1, 1) for step in np.diff(s.q, axis=0, prepend=s.q[:1])]
            bent = replace(s, tau=s.tau + 0.1 * s.tau.std(axis=0) * np.array(followed))
            false += torque_skew(bent, dataset(robot, bent)).sure
    assert false == 0


def test_long_steps_of_every_period_are_no_lost_samples():
    """A multisine of few samples per cycle takes double steps by itself, and each period takes them again."""
    robot, period = load_robot("twomass"), 200
    rng = np.random.default_rng(6)
    lines = np.arange(1, 30, 2)
    phases = 2 * np.pi * np.outer(np.arange(4 * period), lines) / period + rng.uniform(0, 2 * np.pi, len(lines))
    q = np.cos(phases).sum(axis=1)[:, None] + 1e-6 * rng.normal(size=(4 * period, 1))
    t = np.arange(len(q)) / 200.0
    s = Segment("a", "multisine", "identification", t, 0.1 * q, q, period=period, periods=4)
    among = replace(dataset(robot, s), sample_rate=200.0)
    assert lost_sample_warnings(s, among) == []
    assert lost_sample_warnings(replace(s, kind="trajectory", period=None, periods=None), among) != []
    slow = np.cos(2 * np.pi * np.arange(4000) / 1000.0)[:, None]
    gone = np.delete(slow, np.arange(150, 3800, 301), axis=0)
    short = replace(s, t=np.arange(len(gone)) / 200.0, tau=0.1 * gone, q=gone, period=1000, periods=4)
    assert "double steps" in lost_sample_warnings(short, among)[0]


def test_a_channel_of_some_segments_is_told_as_such(clean):
    data, _ = clean
    link = np.full_like(data.segments[0].q, np.nan)
    link[:, 1] = data.segments[0].q[:, 1]
    first, *others = data.segments
    report = inspect_dataset(replace(data, segments=(replace(first, q_link=link), *others)))
    assert report.channels["q_link"] == (2,)
    assert any(w.startswith(f"q_link of joint 2 in 1 of {len(data.segments)} segments only") for w in report.warnings)


@pytest.mark.slow
def test_what_no_model_is_fitted_to_and_what_no_gain_is_measured_by_is_told(clean):
    data, _ = clean
    motion = next(s for s in data.segments if s.kind == "trajectory")
    fitted = [s for s in data.segments if s.role == "identification"]

    def told(*segments):
        return " ".join(inspect_dataset(replace(data, segments=segments)).warnings)

    assert f"{motion.name} of role identification: nothing is fitted to motions beside multisines" in told(
        *fitted, replace(motion, role="identification")
    )
    assert "beside multisines" not in told(*fitted, motion)
    assert "leaving operating points out" in told(*fitted)
    assert "no gain can be measured" in told(*(s for s in fitted if s.operating_point == fitted[0].operating_point))
    assert "the end of the only motion will be held out" in told(replace(motion, role="identification"))
    assert "excited_lines are not said" in told(*(replace(s, excited_lines=()) for s in fitted))


def test_a_spring_that_balances_gravity_is_no_wrong_sign():
    """A spring at the shoulder that gives three times the torque of gravity turns the sum over; inertia stays."""
    robot = load_robot("panda_bare")
    s = recording(robot, np.random.default_rng(1))
    q, tau = s.q[:, 1], s.tau[:, 1]
    balanced = tau - 3.0 * np.polyfit(q, tau, 1)[0] * (q - 0.2)

    def with_torque(x):
        return replace(s, tau=change(s.tau, 1, lambda _: x))

    found = match_torques(with_torque(balanced), dataset(robot, s))
    assert found.correlation[1, 1] < -0.7 and found.beside_spring[1] > 0.9
    assert torque_warnings(with_torque(balanced), dataset(robot, s)) == []
    (said,) = torque_warnings(with_torque(-tau), dataset(robot, s))
    assert "tau_2 (panda_joint2) runs against" in said


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_another_zero_of_a_joint_that_gravity_loads_is_told(quarter):
    robot = load_robot("panda_bare")
    s = recording(robot, np.random.default_rng(1))
    off = replace(s, q=change(s.q, 3, lambda x: x - quarter * np.pi / 2))
    (said,) = contradictions(match_torques(off, dataset(robot, s)), robot.joint_names).values()
    assert f"{90 * quarter} degrees added to q_4" in said and said.endswith("another zero?")


@pytest.mark.parametrize(("name", "joint"), [("ur10_bare", 1), ("panda_bare", 3)])
def test_a_zero_that_is_a_little_off_is_told_beside_motors_that_are_not_known(name, joint):
    robot = load_robot(name)
    s = recording(robot, np.random.default_rng(1))
    acceleration = np.gradient(s.qd, 1 / RATE, axis=0)
    s = replace(s, tau=s.tau - 0.3 * robot.array("motor_inertia") * acceleration, qd=None, q_link=None)
    off = replace(s, q=change(s.q, joint, lambda x: x - 0.25))
    (said,) = torque_warnings(off, dataset(robot, s))
    assert f"with 0.25 rad added to q_{joint + 1} (" in said and "another zero, or a centre of mass" in said
    assert torque_warnings(s, dataset(robot, s)) == []


def test_what_several_readings_explain_is_told_of_none_alone():
    """To turn the axes before and after by half a turn mirrors the one between, and the first one bears no gravity."""
    robot = load_robot("panda_bare")
    s = recording(robot, np.random.default_rng(1))
    mirrored = replace(s, q=change(s.q, 1, np.negative), tau=change(s.tau, 1, np.negative))
    (said,) = contradictions(match_torques(mirrored, dataset(robot, s)), robot.joint_names).values()
    assert "with both q_2 and tau_2 reversed, or with 180 degrees added to q_3: wrong sign or another zero?" in said


@pytest.mark.parametrize("name", ["emps", "ur10_bare", "panda_bare"])
def test_sound_torques_and_those_that_no_sign_explains_are_read_as_recorded(name):
    """Of bodies that are a third off, with stiction, springs and noise of their own, and of another motion."""
    robot, rng = load_robot(name), np.random.default_rng(3)
    s, other = recording(robot, np.random.default_rng(4)), recording(robot, np.random.default_rng(5))
    size = s.tau.std(axis=0)
    spring = 2.0 * size / s.q.std(axis=0) * (s.q - 0.1) * rng.choice([-1, 1], robot.n)
    for tau in (
        s.tau,
        s.tau * rng.uniform(0.6, 1.6, robot.n),
        s.tau + 0.5 * size * np.sign(s.qd),
        s.tau + spring,
        s.tau + size * rng.normal(size=s.tau.shape),
        other.tau,
    ):
        assert match_torques(replace(s, tau=tau), dataset(robot, s)).readings == {}


def test_a_loop_need_not_follow_a_fast_reference_in_full(arm, log):
    """Near its bandwidth a loop moves more or less than it is asked to; of another unit or sign it is far off."""
    for factor, told in ((1.36, False), (0.7, False), (-1.0, True), (180.0 / np.pi, True)):
        middle = log.q.mean(axis=0)
        asked = replace(log, q_ref=middle + factor * (log.q - middle))
        assert any(w.startswith("q_ref") for w in unit_warnings(asked, dataset(arm, asked))) is told


def test_drives_that_are_guesses_are_told(arm, log):
    told = "starting guesses, not known: drives of elbow_joint"
    guessed = replace(arm, guessed=arm.guessed | {"stiffness": ("elbow_joint",)})
    assert told in inspect_dataset(dataset(guessed, log)).text()
    assert "not known" not in inspect_dataset(dataset(arm, log)).text()


@pytest.mark.parametrize(("limit", "guessed", "told"), [
    ([5e4] * 5 + [4e4], (), True),
    ([5e4] * 6, (), False),  # put in for none
    ([5e4] * 5 + [4e4], "all", False),  # of no one's
])  # fmt: skip
def test_a_torque_is_small_beside_limits_that_are_known(arm, log, limit, guessed, told):
    joints = tuple(replace(joint, torque_limit=each) for joint, each in zip(arm.joints, limit, strict=True))
    unknown = arm.joint_names if guessed else ()
    placed = replace(arm, joints=joints, guessed=arm.guessed | {"torque_limit": unknown})
    assert any("stays below" in line for line in warnings(placed, log)) == told


def test_links_that_swing_behind_motors_of_one_direction_have_no_skew():
    """Sines on a ramp, in which velocity hardly differs from an offset, up to two thirds of the resonance of the link."""
    robot, j, anti, damping = load_robot("ur10_bare"), 1, 9.0, 0.004
    model = pin.buildModelFromUrdf(str(robot.urdf))
    data, t = model.createData(), np.arange(N) / RATE
    q_link = np.zeros((N, robot.n))
    q_link[:, j] = 0.2 * t + 0.02 * scipy.signal.chirp(t, 0.2, t[-1], 6.0) * np.sin(np.pi * t / t[-1]) ** 2
    v = np.gradient(q_link, t, axis=0)
    carried = np.array([pin.rnea(model, data, *x) for x in zip(q_link, v, np.gradient(v, t, axis=0))])
    stiffness = np.diag(pin.crba(model, data, q_link[0])) * (2 * np.pi * anti) ** 2
    q = q_link + (carried + damping * np.gradient(carried, t, axis=0)) / stiffness
    noise = 1e-7 * np.random.default_rng(0).normal(size=(2, *q.shape))
    s = Segment("log", "trajectory", "identification", t, carried, q + noise[0], q_link=q_link + noise[1])
    for late in (0, 5):
        found = link_skew(replace(s, q_link=np.roll(s.q_link, late, axis=0)), dataset(robot, s))[j]
        assert found.late == pytest.approx(late / RATE, abs=1e-4) and found.sure == (late > 0)


@pytest.mark.parametrize("hz", [0.3, 6.0])
def test_a_joint_that_is_held_while_another_moves_tells_nothing_of_its_torque(hz):
    """It yields to what moves it, softly or stiffly held, beside motors that are a fifth heavier than described."""
    robot, rng, period, moved = load_robot("ur10_bare"), np.random.default_rng(0), 5000, 1
    model = pin.buildModelFromUrdf(str(robot.urdf))
    q0 = np.array([0.0, -1.0, 1.0, 0.3, 0.5, 0.0])
    M = np.triu(pin.crba(model, model.createData(), q0))
    M = M + np.triu(M, 1).T + np.diag(1.2 * robot.array("motor_inertia"))
    spring = np.where(np.arange(6) == moved, 0.0, (2 * np.pi * hz) ** 2 * np.diag(M))
    spectra = np.zeros((2, period // 2 + 1, 6), complex)
    for line in range(10, 90):
        w = 2 * np.pi * line * RATE / period
        push = np.eye(6)[moved] * np.exp(2j * np.pi * rng.random())
        hold = np.diag(spring * (1 + 0.03j * w))
        q = np.linalg.solve(hold + 1j * w * np.diag(robot.array("viscous_friction")) - w**2 * M, push)
        spectra[:, line] = q, push - hold @ q
    q, tau = (np.tile(np.fft.irfft(x, period, axis=0), (2, 1)) for x in spectra)
    size = 0.02 / np.abs(q).max()
    tau = size * tau + pin.rnea(model, model.createData(), q0, np.zeros(6), np.zeros(6))
    tau = tau + 1e-4 * robot.array("torque_limit") * rng.normal(size=tau.shape)
    q = q0 + size * q + 2e-6 * rng.normal(size=q.shape)
    s = Segment("log", "multisine", "identification", np.arange(len(q)) / RATE, tau, q, period=period, periods=2)
    assert torque_warnings(s, dataset(robot, s)) == []
    assert match_torques(s, dataset(robot, s)).telling[moved]


def test_steps_of_a_position_are_no_skew(arm):
    """The loop turns them into torques beyond the noise of these; what is left is far less than that noise says."""
    s = recording(arm, np.random.default_rng(0))
    coarse = s.q.copy()
    coarse[:, 1] = np.round(coarse[:, 1] / 5e-4) * 5e-4
    loud = replace(s, q=coarse, tau=s.tau + 1e5 * (coarse - s.q))
    assert not np.isfinite(torque_skew(loud, dataset(arm, s)).late)
