"""Logs as users have them: gaps, wrapped angles, other encodings, torques of another run."""

import io
import time
import warnings
import zipfile

import h5py
import numpy as np
import pytest

from ident.channel_checks import freeze_warnings
from ident.checking import inspect_dataset
from ident.convert import convert_logs
from ident.convert.reading import list_signals
from ident.dataset import Dataset, Segment
from ident.diagnosis import diagnose
from ident.gain import Errors, measure_gain
from ident.identification import set_up
from ident.torque_checks import mislabelled
from robot_assets.errors import DataError
from robot_assets.from_urdf import write_robot
from robot_assets.robot import load_robot
from robot_assets.urdf import read_urdf
from tests.test_cli import simgap as run

RATE = 200.0


def motion(seconds=20.0, seed=0):
    """Time and a smooth angle of some radians."""
    t = np.arange(int(seconds * RATE)) / RATE
    rng = np.random.default_rng(seed)
    f, phase = np.array([0.11, 0.27, 0.53, 0.9]), rng.uniform(0, 2 * np.pi, 4)
    return t, np.sum(np.array([0.5, 0.3, 0.15, 0.08]) * np.sin(2 * np.pi * f * t[:, None] + phase), axis=1)


def written(folder, columns, text, name="log.csv"):
    """A log and its map; the map names the robot's only joint."""
    rows = "\n".join(",".join(f"{x:.9g}" for x in row) for row in zip(*columns.values(), strict=True))
    (folder / name).write_text(",".join(columns) + "\n" + rows + "\n")
    (folder / "map.toml").write_text(f"sample_rate = {RATE}\n{text}")
    return folder / name, folder / "map.toml"


def test_angles_of_a_motor_wrap_once_a_turn_of_the_motor(tmp_path):
    _t, q = motion()
    for unit, turn in (("rad", 2 * np.pi), ("deg", 360.0), ("rev", 1.0)):
        wrapped = np.mod(-121.0 * q / (2 * np.pi) * turn, turn)
        text = f'[columns]\ntau_1 = "tau"\nq_1 = {{ source = "q", unit = "{unit}", sign = -1, gear = 121, unwrap = true }}\n'
        log, given = written(tmp_path, {"tau": 0 * q, "q": wrapped}, text)
        found = convert_logs([log], "twomass", given).segments[0].q[:, 0]
        assert np.allclose(found - found[0], q - q[0], atol=1e-6)


def test_what_happened_in_a_long_gap_is_not_made_up(tmp_path):
    t, q = motion()
    text = '[time]\nsource = "t"\n[columns]\ntau_1 = "tau"\nq_1 = "q"\n'
    for gap, refused in ((0.3, False), (0.7, True), (60.0, True)):
        log, given = written(tmp_path, {"t": t + gap * (t > 5.0), "tau": q, "q": q}, text)
        said = []
        if refused:
            with pytest.raises(DataError, match="without a sample after 5 s"):
                convert_logs([log], "twomass", given)
        else:
            assert convert_logs([log], "twomass", given, say=said.append).segments[0].n_samples == len(t) + round(
                gap * RATE
            )
            assert "the longest 305 ms" in said[0]


def test_periods_that_are_held_out_are_not_fitted_to(tmp_path):
    _t, q = motion()
    part = '[[multisine.part]]\nfirst = {}\nlast = {}\nrole = "{}"\n'
    text = '[columns]\ntau_1 = "tau"\nq_1 = "q"\n[multisine]\nperiod = 400\nexcited_lines = [3, 5]\n'
    for first, refused in ((3, True), (5, False)):
        both = part.format(first, 8, "validation") + part.format(1, 4, "identification")
        log, given = written(tmp_path, {"tau": q, "q": q}, text + both)
        if refused:
            with pytest.raises(DataError, match="period 3 for identification and for validation"):
                convert_logs([log], "twomass", given)
        else:
            assert [s.role for s in convert_logs([log], "twomass", given).segments] == ["validation", "identification"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize(("delimiter", "decimal"), [(";", ","), ("\t", ","), ("\t", "."), (",", ".")])
def test_texts_of_other_encodings_and_decimal_signs(tmp_path, encoding, delimiter, decimal):
    rows = [("Winkel [°]", "Moment [Nm]"), ("0", "1"), ("1.5", "-2.25"), ("2", "3e-2"), *[("4", "5")] * 20]
    text = "\n".join(delimiter.join(x.replace(".", decimal) if i else x for x in row) for i, row in enumerate(rows))
    (tmp_path / "log.csv").write_text(text + "\n", encoding=encoding)
    found = list_signals(tmp_path / "log.csv")
    assert sorted(found) == ["Moment [Nm]", "Winkel [°]"]
    assert np.allclose(found["Winkel [°]"][:3], [0.0, 1.5, 2.0]) and np.allclose(
        found["Moment [Nm]"][:3], [1.0, -2.25, 0.03]
    )


def motions(torque):
    """A dataset of two motions of the bench whose torque is a function of inertia's share of it and a generator."""
    bench, rng = load_robot("twomass"), np.random.default_rng(4)
    joint, segments = bench.joints[0], []
    for k, role in enumerate(("identification", "validation")):
        t, q = motion(seed=k)
        a = np.gradient(np.gradient(q, 1 / RATE), 1 / RATE)
        tau = torque((joint.motor_inertia + 0.00477) * a, rng)
        segments.append(
            Segment(f"m{k}", "trajectory", role, t, tau[:, None], q[:, None] + 1e-7 * rng.normal(size=(t.size, 1)))
        )
    return Dataset(
        "moves",
        bench,
        RATE,
        bench.joint_names,
        "none",
        np.array([1e-7]),
        np.array([1e-3]),
        None,
        tuple(segments),
    )


def test_torques_that_have_nothing_to_do_with_the_motion_name_no_cause():
    size = 0.01

    def noise(own, rng):
        return size * rng.normal(size=own.size)

    def right(own, rng):
        return own + 0.1 * size * rng.normal(size=own.size)

    assert not mislabelled(motions(right))
    data = motions(noise)
    assert any("nothing to do with" in text for text in mislabelled(data))
    verdict = diagnose(data)
    assert not verdict.causes and verdict.unexplained_verdict == "unknown cause remains"


def test_a_window_is_seen_as_the_transform_sees_it():
    (group,) = set_up(motions(lambda own, rng: own + 1e-3 * rng.normal(size=own.size))).problem.groups
    rng = np.random.default_rng(0)
    X = rng.normal(size=(1, len(group.omega), 3)) + 1j * rng.normal(size=(1, len(group.omega), 3))
    seen = group.to_lines(group.to_time(X) * group.window[:, None])[:, : group.n_compared]
    assert np.allclose(group.observe(X), seen, rtol=0, atol=1e-12 * np.abs(seen).max())


def test_a_gain_of_some_joints_tells_of_all_of_them():
    before, after, noise = (np.array([[x, 16.0], [3.0 * x, 16.0]]) for x in (2.0, 0.5, 0.125))
    gain = measure_gain(
        Errors(("a", "b"), before, after, noise), {"one": "N", "two": "N m"}, [0], "method", np.random.default_rng(0)
    )
    assert (
        gain.joints == ("one",)
        and gain.metric.endswith(", N")
        and gain.of_some
        and gain.before == pytest.approx(2.0)
        and gain.after == pytest.approx(1.0)
    )
    assert [(g.before, g.after) for g in gain.by_joint.values()] == [
        pytest.approx((2.0, 1.0)),
        pytest.approx((4.0, 4.0)),
    ]
    assert gain.over_all == pytest.approx((np.sqrt(10.0), np.sqrt(8.5)))


@pytest.mark.slow
def test_outputs_that_cannot_be_made_are_one_line(tmp_path):
    log, given = written(tmp_path, {"tau": motion()[1], "q": motion()[1]}, '[columns]\ntau_1 = "tau"\nq_1 = "q"\n')
    convert = ("convert", log, "--robot", "twomass", "--map", given, "--out")
    assert run(*convert, tmp_path / "d").returncode == 0
    for out in (log / "sub", "/proc/none/of"):
        for command, at_fault in ((convert, "output"), (("diagnose", tmp_path / "d", "--out"), "--out")):
            result = run(*command, out)
            (line,) = result.stderr.strip().splitlines()
            assert result.returncode == 2 and at_fault in line and str(out) in line


BODY = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="{mass}"/>
  <inertia ixx="{i[0]}" iyy="{i[1]}" izz="{i[2]}" ixy="{i[3]}" ixz="0" iyz="0"/></inertial></link>
  <joint name="one" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="80" velocity="3"/>{mimic}</joint></robot>"""


@pytest.mark.parametrize(
    ("mass", "moments", "mimic", "found"),
    [
        (3, (0.1, 0.1, 0.1, 0), "", None),
        (3, (0.1, 0.1, 0.201, 0), "", None),  # a plate, rounded
        (0, (0, 0, 0, 0), "", None),
        (1e-6, (1e-6, 1e-6, 1e-6, 1e-6), "", None),  # a placeholder
        (-3, (0.1, 0.1, 0.1, 0), "", "mass of link b"),
        (3, (0.1, 0.1, -0.1, 0), "", "a moment of -0.1 kg m2"),
        (3, (0.1, 0.1, 0.1, 0.2), "", "a moment of -0.1 kg m2"),
        (3, (0.1, 0.1, 0.3, 0), "", None),  # told as hardly so
        (3, (1e-9, 0, -3e-8, 0), "", None),
        (3, (0.1, 0.1, 0.1, 0.04), "", None),
        (3, (0.1, 0.1, 0.1, 0), '<mimic joint="one"/>', "found itself"),
        (3, (0.1, 0.1, 0.1, 0), '<mimic joint="two"/>', "a joint of the URDF"),
    ],
)
def test_bodies_and_mimics_that_cannot_be_are_one_line(tmp_path, mass, moments, mimic, found):
    (tmp_path / "r.urdf").write_text(BODY.format(mass=mass, i=moments, mimic=mimic))
    if found is None:
        read_urdf(tmp_path / "r.urdf")
    else:
        with pytest.raises(DataError, match=found):
            read_urdf(tmp_path / "r.urdf")


def test_joints_that_mimic_each_other_are_refused(tmp_path):
    text = BODY.format(mass=1, i=(1, 1, 1, 0), mimic='<mimic joint="two"/>').replace("</robot>", "")
    second = '<link name="c"/><joint name="two" type="revolute"><parent link="b"/><child link="c"/><mimic joint="{}"/></joint></robot>'
    for lead in ("one", "two"):
        (tmp_path / "r.urdf").write_text(text + second.format(lead))
        with pytest.raises(DataError, match="mimic of joint"):
            read_urdf(tmp_path / "r.urdf")
    (tmp_path / "r.urdf").write_text((text + second.format("one")).replace('<mimic joint="two"/>', ""))
    read_urdf(tmp_path / "r.urdf")


def test_a_joint_that_mimics_a_driven_one_is_locked_and_told(tmp_path):
    text = BODY.format(mass=1, i=(1, 1, 1, 0), mimic="").replace("</robot>", "")
    second = """<link name="c"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="two" type="revolute"><parent link="b"/><child link="c"/><mimic joint="one" multiplier="2" offset="0.1"/>
    <limit lower="-3" upper="3" effort="8" velocity="3"/></joint>"""
    third = second.replace('name="c"', 'name="d"').replace('link="c"', 'link="d"').replace('"two"', '"three"')
    (tmp_path / "r.urdf").write_text(text + second + third + "</robot>")
    robot, warnings = write_robot(tmp_path / "r.urdf", tmp_path / "arm")
    assert robot.joint_names == ("one",) and robot.locked == {"two": 0.1, "three": 0.1}
    told = [w for w in warnings if "mimics one" in w]
    assert [w.split()[0] for w in told] == ["two", "three"] and "locked at 0.1 rad" in told[0]
    assert f"# CHECK: {told[0]}" in (tmp_path / "arm" / "robot.toml").read_text()
    # Where nothing moves that it would follow, and where it was locked by hand, nothing is wrong.
    (tmp_path / "r.urdf").write_text(
        text + second + third.replace('<mimic joint="one" multiplier="2" offset="0.1"/>', "") + "</robot>"
    )
    robot, warnings = write_robot(tmp_path / "r.urdf", tmp_path / "other", {"one": 0.5})
    assert robot.locked == {"one": 0.5, "two": 1.1} and not [w for w in warnings if "mimics" in w]
    robot, warnings = write_robot(tmp_path / "r.urdf", tmp_path / "third", {"two": 0.7})
    assert robot.locked == {"two": 0.7} and not [w for w in warnings if "mimics" in w]


def test_truth_values_are_no_positions(tmp_path):
    _t, q = motion()
    text = f'sample_rate = {RATE}\n[columns]\ntau_1 = "tau"\nq_1 = "q"\n'
    (tmp_path / "map.toml").write_text(text)
    np.savez(tmp_path / "log.npz", tau=q, q=q > 0)
    (tmp_path / "log.csv").write_text("tau,q\n" + "\n".join(f"{x:.4f},{str(x > 0).lower()}" for x in q) + "\n")
    for name in ("log.npz", "log.csv"):
        assert list(list_signals(tmp_path / name)) == ["tau"]
        with pytest.raises(DataError, match="q is no array of numbers but of true and false"):
            convert_logs([tmp_path / name], "twomass", tmp_path / "map.toml")


def stored(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


MEMBERS = {
    "twice": (("x.npy", "x.npy"), stored(np.ones(100)), "x twice"),
    "structures": (("x.npy",), stored(np.zeros(100, [("a", float)])), "x is no array of numbers but of structures"),
    "pickled": (
        ("x.npy",),
        stored(np.array([1, None] * 50, object), allow_pickle=True),
        "x is an array of Python objects",
    ),
    "texts": (("x.npy",), stored(np.array(["a"] * 100)), "x is no array of numbers but of texts"),
    "complex": (("x.npy",), stored(np.ones(100) * 1j), "x is no array of numbers but of complex numbers"),
    "three dimensions": (("x.npy",), stored(np.ones((100, 3, 4))), "3 dimensions, 100 x 3 x 4"),
    "no header": (
        ("x.npy",),
        b"\x93NUMPY\x01\x00\x76\x00" + b"{'descr': object()}".ljust(117) + b"\n",
        "x is unreadable",
    ),
}


@pytest.mark.parametrize("kind", MEMBERS)
def test_members_of_an_archive_that_are_no_numbers_are_named(tmp_path, kind):
    names, content, found = MEMBERS[kind]
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, data in (("tau.npy", stored(np.ones(100))), *((n, content) for n in names)):
            file.writestr(name, data)
    (tmp_path / "map.toml").write_text(f'sample_rate = {RATE}\n[columns]\ntau_1 = "tau"\nq_1 = "x"\n')
    with pytest.raises(DataError, match=found) as caught:
        convert_logs([tmp_path / "log.npz"], "twomass", tmp_path / "map.toml")
    assert " at 0x" not in str(caught.value)
    if kind != "twice":  # what a map does not name is not in its way
        assert "tau" in list_signals(tmp_path / "log.npz")


@pytest.mark.parametrize(
    ("row", "date"),
    [(0, "2026-13-45 10:00:00.000"), (777, "2026-02-30 10:00:07.770"), (777, "2026-01-31 25:00:07.770"), (777, "noon")],
)
def test_a_date_that_is_none_of_the_calendar_is_named_with_its_row(tmp_path, row, date):
    texts = [f"2026-01-31 10:00:{k / 100:06.3f}" for k in range(1000)]
    texts[row] = date
    (tmp_path / "log.csv").write_text("t,tau,q\n" + "\n".join(f"{t},1,2" for t in texts) + "\n")
    (tmp_path / "map.toml").write_text(
        'sample_rate = 100.0\n[time]\nsource = "t"\n[columns]\ntau_1 = "tau"\nq_1 = "q"\n'
    )
    with pytest.raises(DataError, match=f"t = '{date}' in row {row + 1}, expected dates"):
        convert_logs([tmp_path / "log.csv"], "twomass", tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("option", "refused"), [("scale = 1e-320", True), ("gear = 1e-300", True), ("scale = 1e-6", False)]
)
def test_factors_that_leave_nothing_of_a_signal_are_refused(tmp_path, option, refused):
    log, given = written(
        tmp_path,
        {"tau": motion()[1], "q": motion()[1]},
        f'[columns]\ntau_1 = "tau"\nq_1 = {{ source = "q", {option} }}\n',
    )
    if refused:
        with pytest.raises(DataError, match="q_1"):
            convert_logs([log], "twomass", given)
    else:
        convert_logs([log], "twomass", given)


@pytest.mark.parametrize("shape", ["arrays", "groups", "inside each other"])
def test_files_of_thousands_of_groups_end_soon(tmp_path, shape):
    with h5py.File(tmp_path / "log.mat", "w") as file:
        group = file
        for k in range(400 if shape == "inside each other" else 6000):
            if shape == "arrays":
                file[f"d{k}"] = float(k)
            else:
                group = (group if shape == "inside each other" else file).create_group(f"g{k}")
    began = time.process_time()
    if shape == "inside each other":
        assert list_signals(tmp_path / "log.mat") == {}
    else:
        with pytest.raises(DataError, match="more than 2000 groups and arrays"):
            list_signals(tmp_path / "log.mat")
    assert time.process_time() - began < 2.0


def test_what_cells_of_matlab_hold_is_not_looked_at_one_by_one(tmp_path):
    with h5py.File(tmp_path / "log.mat", "w") as file:
        file["log/q"] = np.zeros((6, 100))
        for k in range(2500):
            file[f"#refs#/{k}"] = 0.0
    assert list(list_signals(tmp_path / "log.mat")) == ["log.q"]


def moves(seconds=20.0, rate=500.0, every=1):
    """A motion of the bench with a rest, positions by an encoder of 1e-5 rad and torques in steps of 1e-4 N m, of
    which the log repeats each ``every`` times."""
    t = np.arange(int(seconds * rate)) / rate
    slow = t[np.arange(len(t)) // every * every]
    run = np.clip(slow, 0, 8) + np.clip(slow - 10, 0, None)  # at rest from 8 to 10 s, after a turn
    q = 0.6 * np.cos(2 * np.pi * 0.5 * run) + 0.1 * np.cos(2 * np.pi * 1.5 * run)
    tau = 0.05 * np.cos(2 * np.pi * 0.5 * run + 0.3)
    return t, np.round(q, 5)[:, None], np.round(tau, 4)[:, None]


def of_the_bench(t, q, tau, rate=500.0):
    bench = load_robot("twomass")
    s = Segment("log", "trajectory", "identification", t, tau, q)
    return s, Dataset("moves", bench, rate, bench.joint_names, "none", None, None, None, (s,))


@pytest.mark.parametrize(("every", "samples"), [(1, 4), (1, 40), (1, 100), (2, 40)])
def test_a_log_that_froze_in_motion_is_told_with_its_place(every, samples):
    t, q, tau = moves(every=every)
    at = 2120
    q[at : at + samples], tau[at : at + samples] = q[at], tau[at]
    s, data = of_the_bench(t, q, tau)
    (found,) = [w for w in freeze_warnings(s, data) if "froze" in w]
    first, seconds = (float(found.split(before)[1].split()[0]) for before in ("for ", "samples, "))
    assert samples <= first <= samples + 1 and seconds == pytest.approx(samples / 500, abs=0.003)
    assert "from 4.24 s on" in found
    assert any(found in w for w in inspect_dataset(data).warnings)
    more = q.copy(), tau.copy()
    for x in more:
        x[3120 : 3120 + samples] = x[3120]
    twice = [w for w in freeze_warnings(*of_the_bench(t, *more)) if "froze" in w]
    assert "2 such stretches" in twice[0]


def test_rests_slow_channels_and_repeated_samples_are_no_freezes():
    rng = np.random.default_rng(0)
    t, q, tau = moves()
    assert freeze_warnings(*of_the_bench(t, q, tau)) == []
    coarse = np.round(q, 3), np.round(tau, 3)
    assert freeze_warnings(*of_the_bench(t, *coarse)) == []
    slow = tau[np.arange(len(t)) // 10 * 10]
    assert freeze_warnings(*of_the_bench(t, q, slow)) == []
    one = q.copy()
    one[2120:2160] = one[2120]  # torques go on: a fault of an encoder, which is told by itself
    assert freeze_warnings(*of_the_bench(t, one, tau + 1e-3 * rng.normal(size=tau.shape))) == []
    # A start in the middle of a motion, and a motion in steps that stops within some samples.
    ramp = np.interp(t % 1.0, [0.0, 0.02, 0.46, 0.5, 1.0], [0.0, 0.01, 0.48, 0.5, 0.5]) + 0.5 * np.floor(t)
    assert freeze_warnings(*of_the_bench(t, np.round(ramp, 5)[:, None] % 6, np.sign(np.round(tau, 4)))) == []
    for every in (2, 5):
        (told,) = freeze_warnings(*of_the_bench(*moves(every=every)))
        assert told.startswith(f"all channels change every {every} samples only: measured at {500 / every:g} Hz")
