"""Units of parameters at rotary and at linear joints."""

import pytest

from ident.units import KIND_UNITS, LINEAR_UNITS, linear_names, parameter_unit, torque_unit, unit_at, unit_suffix
from robot_assets.robot import load_robot


def test_a_linear_drive_has_forces_and_metres():
    slide = load_robot("emps")
    (axis,) = slide.joint_names
    assert torque_unit(slide) == "N" and linear_names(slide) == {axis}
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
    assert all("rad" not in LINEAR_UNITS[unit] for unit in KIND_UNITS.values())


def test_a_pure_number_has_no_unit_behind_it():
    assert unit_suffix("1") == "" and unit_suffix("N m") == " N m"
