"""Drives to begin with, by the logarithms of the spectra.

From guesses that are off by more than about a half, resonances of a model lie beside those of the arm, and least squares
of torques lead away: a resonance at the wrong place costs more than none, and gears end a hundred times too soft or too
stiff. The logarithm of predicted over measured torque is the same for a pole and a zero, and bounded here as of a
robust estimator (Geman and McClure 1987), so that lines which the wrong resonances spoil do not outvote the others. It
has one broad valley, which a search along one drive figure after another finds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ident.graybox import Parameters, equilibrium, impedance, linearise
from ident.group import Group
from ident.inverse import torque_record
from ident.problem import Problem
from ident.thinning import thinned
from robot_assets.robot import guessed_drives

MOST_LINES = 40  # looked at of a group
ABOVE_NOISE = 10.0  # amplitude of a line of the torque over its noise, from which it is looked at
SWEEPS = 4  # over all drives, at most, of each step
STEPS = (1.6, 1.15, 1.05)  # factor from one value of a figure to the next
NEAR = 3  # of the finer ones tried on either side
BETTER = 0.01  # share of the cost by which a sweep must lower it for another one
KNOWN, GUESSED = 4.0, 20.0  # factor from the starting guess, at most, of a drive that is known, and of one that is not
FIELDS = ("stiffness", "inertia", "damping", "viscous")


@dataclass(frozen=True)
class Spectra:
    """Lines of a group that are looked at.

    Attributes:
        group: at its posture, of these lines alone.
        position, torque: (S, K, n) spectra, rad and N m.
        seen: (S, K, n) True where the torque is excited and clear of the noise.
    """

    group: Group
    position: np.ndarray
    torque: np.ndarray
    seen: np.ndarray


def begun_by_logarithms(problem: Problem) -> Parameters:
    """Drives near the nominal ones, at which the logarithms of torques agree best with those of the records; the nominal
    ones where no record is periodic.

    The arm is linear here, at its nominal equilibrium, and without effects.
    """
    spectra = [x for g in thinned(problem).groups if g.window is None and np.any((x := spectra_of(g)).seen)]
    if not spectra:
        return problem.nominal
    cost = _cost(problem, spectra)
    guessed = np.isin(problem.structure.robot.joint_names, guessed_drives(problem.structure.robot))
    reach = np.log(np.where(guessed, GUESSED, KNOWN))
    offsets = {field: np.zeros(problem.structure.n) for field in FIELDS}
    best = cost(offsets)
    for step in np.log(STEPS):
        whole = step == np.log(STEPS[0])
        for _ in range(SWEEPS):
            before = best
            # Dampers show once resonances are in their places.
            for field in FIELDS[:2] if whole else FIELDS:
                for j in range(problem.structure.n):
                    near = step * np.arange(-NEAR, NEAR + 1) + offsets[field][j]
                    each = np.arange(-(reach[j] // step), reach[j] // step + 1) * step if whole else near
                    others = [
                        {**offsets, field: np.where(np.arange(len(reach)) == j, x, offsets[field])}
                        for x in each[np.abs(each) <= reach[j]]
                    ]
                    costs = [cost(x) for x in others]
                    if min(costs) < best:
                        best, offsets = min(costs), others[int(np.argmin(costs))]
            if best > (1.0 - BETTER) * before:
                break
    return _moved(problem.nominal, offsets)


def spectra_of(group: Group) -> Spectra:
    """At most ``MOST_LINES`` of the lines of a periodic group that some record excites, spread over the band."""
    lines = np.arange(1, group.n_compared)
    if np.any(group.excited):
        lines = lines[np.any(group.excited, axis=0)[lines]]
    lines = lines[np.unique(np.linspace(0, len(lines) - 1, MOST_LINES).astype(int))] if len(lines) else lines
    torque = group.U[:, lines]
    noise = np.sqrt(group.white_torque_noise / np.maximum(group.periods, 1)[:, None])
    seen = np.abs(torque) > ABOVE_NOISE * noise[:, None]
    return Spectra(replace(group, omega=group.omega[lines]), group.Q[:, lines], torque, seen)


def _moved(par: Parameters, offsets: dict[str, np.ndarray]) -> Parameters:
    return replace(par, **{field: getattr(par, field) * np.exp(x) for field, x in offsets.items()})


def _cost(problem: Problem, spectra: list[Spectra]) -> Callable[[dict[str, np.ndarray]], float]:
    """What drives cost that differ from the nominal ones by the exponentials of offsets."""
    structure, nominal = problem.structure, problem.nominal
    there = [linearise(structure, equilibrium(structure, nominal, x.group.posture)) for x in spectra]
    records = [torque_record(nominal, x.group, problem.sampling) for x in spectra]

    def cost(offsets: dict[str, np.ndarray]) -> float:
        par, total = _moved(nominal, offsets), 0.0
        for x, lin, record in zip(spectra, there, records, strict=True):
            Z = record[:, None, None] * impedance(structure, par, lin, 1j * x.group.omega, x.group.steps)[0]
            torque = np.matmul(Z, x.position[..., None])[..., 0]
            with np.errstate(divide="ignore", invalid="ignore"):
                square = np.abs(np.log(torque / x.torque)) ** 2
            total += float(np.sum((square / (1.0 + square))[x.seen]))
        return total

    return cost
