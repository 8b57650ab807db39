"""The dataset format: what is read from a folder of ``dataset.toml`` and one file per segment."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robot_assets.errors import DataError
from robot_assets.robot import Robot

CHANNELS = ("tau", "q", "qd", "r", "q_ref", "q_link", "temp")


@dataclass(frozen=True)
class Filled:
    """Gaps of a log that were filled by interpolation: how many, the longest and all of them, s."""

    gaps: int
    longest: float
    total: float


@dataclass(frozen=True)
class Segment:
    """One recording. Times in s, torques in N m, positions in rad, link side of the gear.

    Attributes:
        name: stem of its file.
        kind: "multisine" (periodic, around one posture) or "trajectory".
        role: "identification" or "validation" (held out).
        t: (N,); tau, q: (N, n); qd, r, q_ref, q_link, temp: (N, n) or None.
        q0: (n,) posture of the operating point, or None.
        period, periods: samples per period, whole periods; None for a trajectory.
        transient_periods: leading periods to discard.
        experiment: column of the orthogonal excitation, from 1. realization: from 1.
        amplitude: relative excitation level.
        excited_lines: (F,) DFT lines.
        filled: what was made up of the log; None where nothing was.
    """

    name: str
    kind: str
    role: str
    t: np.ndarray
    tau: np.ndarray
    q: np.ndarray
    operating_point: str | None = None
    qd: np.ndarray | None = None
    r: np.ndarray | None = None
    q_ref: np.ndarray | None = None
    q_link: np.ndarray | None = None
    temp: np.ndarray | None = None
    q0: np.ndarray | None = None
    period: int | None = None
    periods: int | None = None
    transient_periods: int = 0
    experiment: int | None = None
    realization: int | None = None
    amplitude: float = 1.0
    excited_lines: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    filled: Filled | None = None

    @property
    def n_samples(self) -> int:
        """Samples of the record."""
        return len(self.t)

    def part(self, rows: slice) -> dict[str, Any]:
        """Time and the channels that there are, some of their samples, as arguments of a segment."""
        return {name: x[rows] for name in ("t", *CHANNELS) if (x := getattr(self, name)) is not None}

    @property
    def steady_periods(self) -> int:
        """Periods left when the transient ones are discarded."""
        return int(self.periods or 0) - self.transient_periods

    def periodic(self, channel: str) -> np.ndarray:
        """Steady periods of a channel, (P, period, n).

        Raises:
            DataError: where the segment is no multisine or lacks the channel.
        """
        x = getattr(self, channel)
        if self.period is None or x is None:
            found = "a trajectory" if self.period is None else "no such channel"
            raise DataError(channel, self.name, found, "a multisine with it")
        start = self.transient_periods * self.period
        return x[start:].reshape(self.steady_periods, self.period, -1)


@dataclass(frozen=True)
class Dataset:
    """A set of recordings of one robot. ``robot.joints`` stand in the order of ``joints``."""

    name: str
    robot: Robot
    sample_rate: float
    joints: tuple[str, ...]
    input_hold: str
    q_std: np.ndarray | None
    tau_std: np.ndarray | None
    controller: dict | None
    segments: tuple[Segment, ...]
    path: Path | None = None

    @property
    def n(self) -> int:
        """Joints."""
        return len(self.joints)

    def select(self, *, role: str | None = None, kind: str | None = None) -> tuple[Segment, ...]:
        """Segments of a role and kind, in order."""
        return tuple(s for s in self.segments if role in (None, s.role) and kind in (None, s.kind))
