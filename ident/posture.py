"""What an arm does at another posture, to first order.

Where a gear gives a little under the weight of the arm the torque that holds it up hardly changes, but all that the arm
does elsewhere: its inertia there is another. Small motions about a posture are linear in it, so that one linearisation
a coordinate tells what the geometric remainder would take steps to find.
"""

from __future__ import annotations

import numpy as np

from ident.extended import Prediction
from ident.graybox import linearise

MOVED = 1e-3  # rad, by which the arm is put elsewhere to see what its posture does


def moved_by_posture(pred: Prediction) -> np.ndarray:
    """What a shift of each link coordinate at rest does to the outputs beyond those of the linear arm, by differences.

    Returns:
        (S, L, n + M, N) outputs per rad.
    """
    plane, here = pred.plane, pred.plane.lin
    motion = pred.solution.Q_a.copy()
    motion[:, 0] -= here.q
    square = plane.differences[1][:, None, None]
    changes = []
    for shift in MOVED * np.eye(len(here.q)):
        there = linearise(pred.structure, here.q + shift)
        changes.append((square * (there.M - here.M) + (there.Kg - here.Kg)) / MOVED)
    loads = np.stack([np.matmul(change, motion[..., None])[..., 0] for change in changes], axis=-1)
    return np.matmul(plane.output_per_load, loads)


def moved_by_gears(pred: Prediction) -> np.ndarray:
    """The same for a constant torque in each gear, by the posture to which it moves the arm.

    Returns:
        (S, L, n + M, joints) outputs per N m.
    """
    return moved_by_posture(pred) @ pred.plane.A_inv[0][:, pred.structure.driven].real
