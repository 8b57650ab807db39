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
