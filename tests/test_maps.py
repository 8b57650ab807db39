"""Maps of logs: what they misspell, or say of a quantity that it cannot be, is one clear line."""

import re
import shutil
import tomllib

import numpy as np
import pytest

from ident.convert import convert_logs
from ident.convert.guess import guess_map
from ident.dataset_io import load_dataset, save_dataset
from robot_assets.errors import DataError
from robot_assets.from_urdf import write_robot
from robot_assets.robot import load_robot

N = 200
T = np.arange(N) / 100.0
TURNING = """sample_rate = 100.0
[time]
source = "t"
[columns]
tau_1 = { source = "u" }
q_1 = { source = "x" }
"""
PARTS = "[multisine]\nperiod = 100\n[[multisine.part]]\nfirst = 1\nlast = 2\n"


def written(folder, name="log.csv", **columns):
    columns = columns or {"t": T, "u": np.cos(3 * T), "x": np.sin(3 * T)}
    np.savetxt(
        folder / name,
        np.stack(list(columns.values()), axis=1),
        header=",".join(columns),
        comments="",
        delimiter=",",
        fmt="%.12g",
    )
    return folder / name


def mapped(folder, text):
    (folder / "map.toml").write_text(text, encoding="utf-8")
    return folder / "map.toml"


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ('source = "t"', 'source = "t"\nunits = "ms"', r"time\.units.*an unknown key.*'unit'"),
        ('source = "t"', 'unit = "ms"', "source: .*map.toml time: found no such key"),
        ('source = "t"', 'source = "t"\nunit = "rad"', r"unit of time.*'rad'.*'ns'"),
        ('"x" }', '"x" }\n' + PARTS.replace("period", "perod"), r"multisine\.perod.*an unknown key"),
        ('"x" }', '"x" }\n' + PARTS + 'rol = "validation"', r"multisine\.part\.rol.*an unknown key.*'role'"),
        ('"x" }', '"x" }\n[multisine]', "multisine"),
        (
            '"x" }',
            '"x" }\n' + PARTS + 'role = "validation"\n[roles]\nlog = "validation"',
            r"\[roles\].*role in \[\[multisine\.part\]\] as well",
        ),
        ('"x" }', '"x", plus = [{ source = "u", factor = 1.0, unit = "deg" }] }', r"q_1\.plus\.unit.*an unknown key"),
        ('"x" }', '"x", unit = "N m" }', r"unit of q_1.*'N m'.*'rad'"),
        ('"x" }', '"x", unit = "mm" }', r"unit of q_1.*'mm'.*'rad'"),
        ('"x" }', '"x", unit = "mm", side = "motor" }', "unit of q_1"),
        ('"u" }', '"u", unit = "rpm" }', r"unit of tau_1.*'rpm'.*'N m'"),
        ('"u" }', '"u", unit = "N" }', "unit of tau_1"),
        ('"x" }', '"x" }\nqd_1 = { source = "x", unit = "rad" }', r"unit of qd_1.*'rad/s'"),
        ('"x" }', '"x" }\ntemp_1 = { source = "x", unit = "rad" }', r"unit of temp_1.*'degC'"),
        ('"x" }', '"x", sign = 5 }', r"q_1\.sign.*found 5, expected 1 or -1"),
        ('"x" }', '"x", index = 99 }', "x: .*found index = 99, expected no index, or 0: it has one column"),
        ('"x" }', '"x", plus = [{ source = "u", factor = 1.0, index = 7 }] }', "u: .*found index = 7"),
        ('"x" }', '"x" }\n[files]\na = { name = "log.csv", tim = "t" }', r"files\.a\.tim.*an unknown key"),
        (
            '"x" }',
            '"x" }\n[roles]\nlgo = "validation"',
            r"\[roles\].*found lgo, which is none of the files given.*'log\.csv'",
        ),
        ('"x" }', '"x" }\n[roles]\nlog = "validation"\n"log.csv" = "identification"', "two roles of one log"),
    ],
)
def test_a_key_that_nothing_reads_and_a_unit_of_another_quantity_are_one_line(tmp_path, old, new, found):
    log = written(tmp_path)
    convert_logs([log], "twomass", mapped(tmp_path, TURNING))
    with pytest.raises(DataError, match=found) as caught:
        convert_logs([log], "twomass", mapped(tmp_path, TURNING.replace(old, new, 1)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        'q_1 = { source = "x", sign = -1.0, index = 0 }',
        'q_1 = { source = "x", unit = "rev", side = "motor" }',
        'q_1 = { source = "x", unit = "mm", gear = 0.05 }',  # a spindle turns the joint by a lever
        'q_1 = { source = "x" }\nr_1 = { source = "x", unit = "deg" }\ntemp_1 = { source = "u", unit = "degC" }',
    ],
)
def test_what_a_map_may_say(tmp_path, options):
    convert_logs([written(tmp_path)], "twomass", mapped(tmp_path, TURNING.replace('q_1 = { source = "x" }', options)))


def test_a_shipped_map_serves_some_of_the_published_files(tmp_path):
    columns = {"t": T, "vir": T, "qm": T, "qg": T}
    (s, _) = convert_logs([written(tmp_path, "DATA.csv", **columns)], "emps", "emps_drive").segments
    assert s.role == "identification"


MIXED = """<robot name="mixed"><link name="a"/>
  <link name="b"><inertial><mass value="3"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
  <link name="c"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="80" velocity="3"/></joint>
  <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="40" velocity="3"/></joint></robot>"""


def test_an_arm_of_both_kinds_of_joints_has_units_of_both(tmp_path):
    (tmp_path / "mixed.urdf").write_text(MIXED)
    write_robot(tmp_path / "mixed.urdf", tmp_path / "arm")
    signals = {
        "t": T,
        "q1": np.sin(3 * T),
        "q2": 0.3 * np.cos(2 * T),
        "tau1": 9 * np.cos(3 * T),
        "tau2": 5 * np.sin(2 * T),
    }
    log = written(tmp_path, **signals)
    text = guess_map([log], tmp_path / "arm").text
    columns = tomllib.loads(text)["columns"]
    assert [columns[k]["unit"] for k in ("q_1", "q_2", "tau_1", "tau_2")] == ["rad", "m", "N m", "N"]
    data = convert_logs([log], tmp_path / "arm", mapped(tmp_path, text))
    assert np.allclose(np.concatenate([s.q for s in data.segments])[:, 1], signals["q2"])
    for wrong in (
        text.replace('"q2", unit = "m"', '"q2", unit = "rad"'),
        text.replace('"tau2", unit = "N"', '"tau2", unit = "N m"'),
    ):
        with pytest.raises(DataError, match="unit of"):
            convert_logs([log], tmp_path / "arm", mapped(tmp_path, wrong))
    geared = text.replace('"q2", unit = "m"', '"q2", unit = "rad", side = "motor"')
    convert_logs([log], tmp_path / "arm", mapped(tmp_path, geared))


def two_joints(folder):
    """(log, map without r and temperatures, text of an arm of two joints, geared 100) written to a folder."""
    (folder / "mixed.urdf").write_text(MIXED)
    write_robot(folder / "mixed.urdf", folder / "arm")
    robot = (folder / "arm" / "robot.toml").read_text(encoding="utf-8")
    (folder / "arm" / "robot.toml").write_text(re.sub(r"gear_ratio = \S+", "gear_ratio = 100.0", robot))
    log = written(folder, t=T, a=np.sin(3 * T), b=0.3 * np.cos(2 * T), c=9 * np.cos(3 * T), d=5 * np.sin(2 * T))
    columns = "".join(f'{k} = "{v}"\n' for k, v in {"q_1": "a", "q_2": "b", "tau_1": "c", "tau_2": "d"}.items())
    return log, f'sample_rate = {1 / (T[1] - T[0]):.6g}\n[time]\nsource = "t"\n[columns]\n{columns}'


@pytest.mark.parametrize(("unit", "factor"), [("rad", 0.01), ("deg", 0.01 * np.pi / 180), ("N m", 100.0)])
def test_a_reference_of_the_motor_is_an_angle_or_a_torque_by_its_unit(tmp_path, unit, factor):
    """Angles shrink on the way through the gear, torques grow. A joint without a reference has none, which is said."""
    log, text = two_joints(tmp_path)
    told = []
    more = f'r_1 = {{ source = "a", unit = "{unit}", side = "motor" }}\n'
    data = convert_logs([log], tmp_path / "arm", mapped(tmp_path, text + more), say=told.append)
    r = data.segments[0].r
    assert r[:, 0] == pytest.approx(factor * np.sin(3 * T), abs=1e-9) and not r[:, 1].any()
    assert any("r_2 taken as zero" in line for line in told)


def test_a_guessed_gear_ratio_that_scales_a_column_is_told(tmp_path):
    log, text = two_joints(tmp_path)
    robot = tmp_path / "arm" / "robot.toml"
    given = robot.read_text(encoding="utf-8")

    def told(old="", new="", more=""):
        lines = []
        given_map = mapped(tmp_path, text.replace(old, new, 1) + more)
        convert_logs([log], tmp_path / "arm", given_map, say=lines.append)
        return [line for line in lines if "GUESS" in line]

    motor = ('q_1 = "a"', 'q_1 = { source = "a", side = "motor" }')
    (line,) = told(*motor)
    assert line.startswith("q of turn scaled by a gear_ratio that is a guess")
    (line,) = told(*motor, 'r_2 = { source = "d", unit = "N m", side = "motor" }')
    assert line.startswith("q, r of turn, slide scaled")
    # No ratio of the robot in it: on the link side, or of the map's own.
    assert not told() and not told(motor[0], 'q_1 = { source = "a", side = "motor", gear = 100.0 }')
    assert not told(more="".join(f'temp_{j} = {{ source = "a", side = "motor" }}\n' for j in (1, 2)))
    robot.write_text(re.sub(r"(gear_ratio = \S+).*", r"\1   # of the data sheet", given, count=1), encoding="utf-8")
    assert not told(*motor) and told('"d"', '{ source = "d", side = "motor", unit = "N m" }')
    robot.write_text(given.replace("gear_ratio", "ratio").replace("[[joint]]", "[[drive]]"), encoding="utf-8")
    assert told(*motor)


@pytest.mark.parametrize("channel", ["qd", "q_ref", "temp"])
def test_a_channel_of_some_joints_is_not_filled_up(tmp_path, channel):
    log, text = two_joints(tmp_path)
    with pytest.raises(DataError, match=f"{channel}_2: .*no such column.*{channel}_1 to {channel}_2"):
        convert_logs([log], tmp_path / "arm", mapped(tmp_path, text + f'{channel}_1 = "a"\n'))


def test_a_byte_order_mark_before_a_file_is_no_fault(tmp_path):
    log, folder = written(tmp_path), tmp_path / "arm"
    shutil.copytree(load_robot("twomass").folder, folder)
    data = convert_logs([log], folder, mapped(tmp_path, "\ufeff" + TURNING))
    save_dataset(data, tmp_path / "d")
    for toml in (folder / "robot.toml", tmp_path / "d" / "dataset.toml"):
        toml.write_text("\ufeff" + toml.read_text(encoding="utf-8"), encoding="utf-8")
    assert load_dataset(tmp_path / "d").robot.folder == folder.resolve()
