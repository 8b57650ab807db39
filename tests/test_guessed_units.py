"""Units, sides and signs in a guessed map: what a log cannot tell is left as it stands and marked."""

import tomllib

import numpy as np
import pytest

from ident.convert.guess import guess_map
from robot_assets.robot import load_robot

RATE = 500.0


def log_of(folder, q, tau, names=("q{}", "tau{}")):
    t = np.arange(len(q)) / RATE
    columns = (
        {"t": t}
        | {names[0].format(j + 1): x for j, x in enumerate(q.T)}
        | {names[1].format(j + 1): x for j, x in enumerate(tau.T)}
    )
    np.savetxt(
        folder / "log.csv",
        np.stack(list(columns.values()), axis=1),
        header=",".join(columns),
        comments="",
        delimiter=",",
        fmt="%.9g",
    )
    return folder / "log.csv"


def columns_of(log, robot="ur10_bare"):
    text = guess_map([log], robot).text
    return text, tomllib.loads(text)["columns"]


def one_way(N=2000, n=6):
    """A smooth move there, and torques that a spring and friction of the wrong sign would make."""
    x = np.linspace(0, 1, N)[:, None]
    q = 0.1 * np.arange(n) + np.linspace(0.7, 1.3, n) * (10 * x**3 - 15 * x**4 + 6 * x**5)
    v = np.gradient(q, 1 / RATE, axis=0)
    return q, 40 * np.sin(q + np.arange(n)) - 8 * np.tanh(v / 0.05)


def back_and_forth(N=3000, n=6):
    t = np.arange(N)[:, None] / RATE
    w = 2 * np.pi * np.linspace(0.5, 1.2, n)
    q, v = 0.4 * np.sin(w * t), 0.4 * w * np.cos(w * t)
    return q, 20 * np.sin(q + np.arange(n)) - 8 * np.tanh(v / 0.05)


@pytest.mark.parametrize(
    ("motion", "told"),
    [(one_way, False), (lambda: tuple(x[:400] for x in back_and_forth()), False), (back_and_forth, True)],
)
def test_a_sign_is_set_by_a_motion_that_turns_round_and_left_by_others(tmp_path, motion, told):
    text, columns = columns_of(log_of(tmp_path, *motion()))
    assert all(("sign" in columns[f"tau_{j + 1}"]) == told for j in range(6))
    assert ("EDIT? signs as they stand: all joints turn round too seldom" in text) != told


@pytest.mark.parametrize(("motion", "told"), [(one_way, False), (back_and_forth, True)])
def test_a_side_is_set_by_a_motion_that_turns_round_and_left_by_others(tmp_path, motion, told):
    q, tau = motion()
    text, columns = columns_of(log_of(tmp_path, q, -tau / load_robot("ur10_bare").array("gear_ratio")))
    assert all((columns[f"tau_{j + 1}"].get("side") == "motor") == told for j in range(6))
    assert ("EDIT: " in text and 'before the gear (side = "motor")?' in text) != told


def test_joints_that_turn_round_too_seldom_are_named(tmp_path):
    q, tau = back_and_forth()
    slow, torque = one_way(len(q))
    q[:, 2], tau[:, 2] = slow[:, 2], torque[:, 2]
    text, columns = columns_of(log_of(tmp_path, q, tau))
    assert "EDIT? signs as they stand: joints 3 turn round" in text
    assert [j + 1 for j in range(6) if "sign" not in columns[f"tau_{j + 1}"]] == [3]


@pytest.mark.parametrize(
    ("name", "unit", "size"),
    [
        ("torque{}_mNm", "mN m", 1e3), ("torque{}_kNm", "kN m", 1e-3), ("tau{}_Nm", "N m", 1.0), ("tauNm{}", "N m", 1.0), ("current{}_mA", "mA", 1e3),
        ("current_{}_A", "A", 1.0), ("Moment_{} mNm", "mN m", 1e3),
    ],
)  # fmt: skip
def test_prefixes_of_units_in_names(tmp_path, name, unit, size):
    q, tau = back_and_forth()
    _, columns = columns_of(log_of(tmp_path, q, tau * size, ("q{}_rad", name)))
    assert columns["tau_4"]["unit"] == unit


def test_names_of_kuka_s_sensor_interface(tmp_path):
    q, tau = back_and_forth()
    log = log_of(tmp_path, np.rad2deg(q), tau, ("AIPos.A{}", "MACur.A{}"))
    log.write_text(log.read_text().replace("t,", "IPOC,", 1))
    text, columns = columns_of(log)
    assert columns["q_3"]["source"] == "AIPos.A3" and columns["q_3"]["unit"] == "deg"
    assert columns["tau_3"]["source"] == "MACur.A3" and columns["tau_3"]["unit"] == "A"
    assert tomllib.loads(text)["time"]["source"] == "IPOC"


def with_units(log, units):
    """A row of units below the header."""
    head, rest = log.read_text().split("\n", 1)
    log.write_text(f"{head}\n{units}\n{rest}", encoding="utf-8")
    return log


@pytest.mark.parametrize(
    ("name", "unit", "scale", "quoted"),
    [
        ("torque{} (%)", None, 0.01, 'per cent of the rated torque ("%")'),
        ("torque{} [0.1 %]", None, 0.001, 'per mille of the rated torque ("0.1 %")'),
        ("torque{}", "\u2030", 0.001, 'per mille of the rated torque ("\u2030")'),
        ("torque{}", "[%]", 0.01, 'per cent of the rated torque ("%")'),
        ("torque_percent_{}", None, 0.01, "per cent of the rated torque"),
        ("current{} (%)", None, 0.01, 'per cent of the rated current ("%")'),
        ("Axis{}_0x6077_TorqueActualValue", None, 0.001, "per mille of the rated torque"),
        ("Axis{} 6078h CurrentActualValue", None, 0.001, "per mille of the rated current"),
        ("torque{} [kgf cm]", None, None, 'the unit "kgf cm" of the log is not understood'),
        ("torque{}", "lb in", None, 'the unit "lb in" of the log is not understood'),
    ],
)
def test_units_of_a_torque_that_are_none_of_a_map_are_quoted_and_marked(tmp_path, name, unit, scale, quoted):
    q, tau = back_and_forth()
    log = log_of(tmp_path, q, tau, ("q{}", name))
    text, columns = columns_of(with_units(log, ",".join(["s", *["rad"] * 6, *[unit] * 6])) if unit else log)
    note = next(line for line in text.splitlines() if line.startswith("# tau:"))
    assert f"EDIT: {quoted}" in note and columns["tau_2"].get("scale") == scale
    # Their size tells no side of the gear.
    assert "side" not in columns["tau_2"] and "limit" not in note


@pytest.mark.parametrize(
    "name", ["torque (A{})", "torque{} (measured)", "torque [{}]", "motor torque{} (act)", "torque{} (motor)", "tau_{}"]
)
def test_what_stands_in_brackets_and_is_no_unit_is_not_marked(tmp_path, name):
    text, _ = columns_of(log_of(tmp_path, *back_and_forth(), ("q{}", name)))
    assert "not understood" not in text and "whole numbers" not in text and "rated" not in text


def test_other_channels_quote_units_too(tmp_path):
    q, tau = back_and_forth()
    text, columns = columns_of(log_of(tmp_path, q, tau, ("pos{} [gon]", "tau{}")))
    assert '# q: EDIT: the unit "gon" of the log is not understood' in text and "tau_1" in columns


def test_whole_numbers_without_a_unit_are_marked(tmp_path):
    q, tau = back_and_forth()
    counts = np.round(q * 2**20 / (2 * np.pi))
    text, _ = columns_of(log_of(tmp_path, counts, np.round(tau * 10)))
    assert "# tau: EDIT: whole numbers without a unit" in text and "# q: EDIT: whole numbers without a unit" in text
    text, columns = columns_of(
        log_of(tmp_path, np.round(np.rad2deg(q)), np.round(tau * 1e3), ("q{} [deg]", "tau{} [mNm]"))
    )
    assert "whole numbers" not in text and columns["tau_1"]["unit"] == "mN m"


def test_what_a_log_writes_stands_in_one_line_of_a_comment(tmp_path):
    q, tau = back_and_forth()
    names = np.array([f"a{j}\n[columns]\nq_1 = 1" for j in range(6)])
    np.savez(tmp_path / "log.npz", names=names, q=q, tau=tau)
    text, columns = columns_of(tmp_path / "log.npz")
    assert "calls a0 [columns] q_1 = 1, a1" in text and columns["q_1"]["source"] == "q"
