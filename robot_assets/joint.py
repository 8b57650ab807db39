"""The figures of a driven joint, and guesses of those that may be left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Guesses of what a robot.toml may leave out; by whether a joint is linear.
WINDUP = 1 / 150  # rad: how far a gear winds up under the torque limit
VELOCITY = {False: np.pi, True: 1.0}  # velocity limit where the URDF has none, rad/s or m/s
ENCODER = {False: 3e-6, True: 1e-6}  # position noise, rad or m
NOISE = 1e-4  # torque noise over the torque limit


@dataclass(frozen=True)
class Joint:
    """A driven joint.

    Attributes:
        gear_ratio: motor turns per joint turn.
        motor_inertia: kg m2. stiffness: N m/rad. damping, viscous_friction: N m s/rad.
        torque_limit: N m. velocity_limit: rad/s. q_std: encoder noise, rad. tau_std: N m.

    A linear joint has kg, N and m in the place of kg m2, N m and rad. Limits that ``robot.toml`` does not give are those
    of the URDF, else guesses, as is noise.
    """

    name: str
    gear_ratio: float
    motor_inertia: float
    stiffness: float
    damping: float
    viscous_friction: float
    torque_limit: float
    velocity_limit: float
    q_std: float
    tau_std: float
