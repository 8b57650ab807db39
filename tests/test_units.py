"""Units of parameters at rotary and at linear joints."""

import numpy as np
import pytest

from ident.chain import build_structure
from ident.hypotheses import catalogue
from ident.model import Effect
from ident.notes import told, waves
from ident.units import (
    KIND_UNITS,
    linear_names,
    parameter_unit,
    response_unit,
    text_at,
    torque_unit,
    torque_units,
    unit_at,
    unit_suffix,
)
from ident.values import at_linear_joint
from robot_assets.robot import load_robot


def test_a_linear_drive_has_forces_and_metres():
    slide = load_robot("emps")
    (axis,) = slide.joint_names
    assert torque_unit(slide) == "N" and torque_units(slide) == ("N",) and linear_names(slide) == {axis}
    assert response_unit(slide) == "(m/s²)/N"
    assert parameter_unit(f"stiffness.{axis}", linear_names(slide)) == "N/m"
    assert parameter_unit(f"motor_inertia.{axis}", linear_names(slide)) == "kg"


def test_a_rotary_arm_keeps_its_units():
    arm = load_robot("ur10")
    assert torque_unit(arm) == "N m" and not linear_names(arm)
    assert parameter_unit("stiffness.elbow_joint", linear_names(arm)) == "N m/rad"
    assert parameter_unit("first_moment_x.elbow_joint") == "kg m"


@pytest.mark.parametrize("unit", ["s", "1", "kg", "m"])
def test_what_has_no_angle_in_it_is_the_same_at_both(unit):
    assert unit_at(unit, True) == unit_at(unit, False) == unit


def test_no_parameter_of_a_drive_at_a_linear_joint_is_told_per_radian():
    assert all("rad" not in unit_at(unit, True) for unit in KIND_UNITS.values())


def test_no_effect_of_a_linear_joint_is_told_in_radians():
    """Numbers and sentences of the whole catalogue at a linear drive; hinges that may hide there turn."""
    structure = build_structure(load_robot("emps"))
    (axis,) = structure.robot.joint_names
    told = 0
    for h in catalogue(structure):
        if h.place != axis or not at_linear_joint(Effect(h, None), structure):
            continue
        assert all("rad" not in unit_at(q.unit, True) for q in h.parameters), h.key
        said = text_at(h.sentence, True)
        assert " rad" not in said and "N m" not in said, said
        told += 1
    assert told > 20


def test_what_repeats_is_counted_by_turns_of_joint_and_motor_or_by_length():
    assert waves(2880.0, 160.0, False) == "2880 times a turn of the joint, 18 of its motor"
    assert waves(4.0, 1.0, False) == "4 times a turn of the joint"
    assert waves(2.0 * np.pi / 0.01, 500.0, True) == "once in 0.01 m"


@pytest.mark.parametrize("name", ["ur10", "emps"])
def test_every_effect_is_told_by_its_parameters(name):
    structure = build_structure(load_robot(name))
    for h in catalogue(structure):
        names = [*(q.name for q in h.parameters), "amplitude", "phase", "axis_x", "axis_y", "axis_z"]
        said = told(Effect(h, None), structure, dict.fromkeys(names, 2.5))
        assert "{" not in said and said.endswith("."), h.key


def test_a_sentence_of_a_rotary_joint_stays():
    text = "friction of 3.2 N m beyond 1e-3 rad/s, 5 N m/rad2 and 2 rad."
    assert text_at(text, False) == text
    assert text_at(text, True) == "friction of 3.2 N beyond 1e-3 m/s, 5 N/m2 and 2 m."


def test_a_pure_number_has_no_unit_behind_it():
    assert unit_suffix("1") == "" and unit_suffix("N m") == " N m"
