"""What a dataset holds, how it was understood, and what looks wrong in it."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ident.channel_checks import (
    excitation_warnings,
    filled_warnings,
    freeze_warnings,
    identical_warnings,
    lost_sample_warnings,
    stuck_warnings,
    unit_warnings,
)
from ident.dataset import CHANNELS, Dataset, Segment
from ident.held_out import not_fitted, with_held_out
from ident.lost_samples import with_lost_samples_filled
from ident.parallel import one_thread_each
from ident.period_checks import period_warnings
from ident.rest import difference_noise
from ident.skew_checks import skew_warnings
from ident.torque_checks import torque_warnings
from robot_assets.robot import guessed_drives, linear_joints

CHECKS = (
    filled_warnings,
    period_warnings,
    unit_warnings,
    stuck_warnings,
    identical_warnings,
    freeze_warnings,
    lost_sample_warnings,
    skew_warnings,
    excitation_warnings,
    torque_warnings,
)
MOST = 40  # warnings shown
SHOWN = 12  # segments listed one by one
BRIEF = 5.0  # s of motion in all, below which inertia, gravity and friction hardly get apart


@dataclass(frozen=True)
class Report:
    """Contents and warnings of a dataset. One value per joint in SI: rad or m, N m or N, link side.

    Attributes:
        channels: channel -> joints (from 1) that have it. hold: how torque is taken between samples.
        guessed_drives: joints of which a stiffness or motor inertia is a guess.
        q_range, tau_range: (n, 2) smallest and largest value. limits: (n, 2) of the position.
    """

    name: str
    robot: str
    joints: tuple[str, ...]
    sample_rate: float
    segments: dict[str, int]
    operating_points: tuple[str, ...]
    levels: tuple[float, ...]
    lines: int
    highest_hz: float
    q_noise: tuple[float, ...]
    tau_noise: tuple[float, ...]
    motion_rms: tuple[float, ...]
    warnings: tuple[str, ...]
    hold: str
    duration: float
    channels: dict[str, tuple[int, ...]]
    units: tuple[tuple[str, str], ...]
    q_range: tuple[tuple[float, float], ...]
    tau_range: tuple[tuple[float, float], ...]
    limits: tuple[tuple[float, float], ...]
    torque_limits: tuple[float, ...]
    files: tuple[str, ...]
    guessed_drives: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON holds it."""
        return asdict(self)

    def text(self) -> str:
        """The report as the command line prints it."""
        kinds = ", ".join(f"{v} {k}" for k, v in self.segments.items())
        n = len(self.joints)
        hold = "held over a sample" if self.hold == "zoh" else "band-limited or unknown between samples"
        rows = [
            f"{self.name}: {self.robot}, {n} joints at {self.sample_rate:g} Hz, {self.duration:.4g} s; {kinds}",
            f"understood: SI units on the link side of the gear; torque {hold}",
            "channels: "
            + ", ".join(
                c if len(j) == n else f"{c} of joints {', '.join(map(str, j))}" for c, j in self.channels.items()
            ),
        ]
        if self.operating_points:
            rows.append(
                f"operating points {len(self.operating_points)}, levels {list(self.levels)}, {self.lines} excited lines up to {self.highest_hz:.4g} Hz"
            )
        if self.guessed_drives:
            rows.append(f"starting guesses, not known: drives of {', '.join(self.guessed_drives)}")
        rows += [f"  {line}" for line in self.files]
        for j, name in enumerate(self.joints):
            m, newton = self.units[j]
            q, tau, limit = self.q_range[j], self.tau_range[j], self.limits[j]
            rows.append(
                f"  {name}: q {q[0]:.3g} to {q[1]:.3g} {m} (limits {limit[0]:.3g} to {limit[1]:.3g}), {self.motion_rms[j]:.3g} {m} rms, "
                f"noise {self.q_noise[j]:.2g} {m}; tau {tau[0]:.3g} to {tau[1]:.3g} {newton} (limit {self.torque_limits[j]:.3g}), noise {self.tau_noise[j]:.2g} {newton}"
            )
        return "\n".join([*rows, *(f"warning: {w}" for w in self.warnings)])


@one_thread_each
def inspect_dataset(dataset: Dataset) -> Report:
    """Contents, noise from fourth differences, and warnings."""
    segments = dataset.segments
    multisines = [s for s in segments if s.kind == "multisine"]
    lines = sorted({int(k) for s in multisines for k in s.excited_lines})
    tops = [max(s.excited_lines) * dataset.sample_rate / s.period for s in multisines if len(s.excited_lines)]
    points = tuple(dict.fromkeys(str(s.operating_point) for s in multisines))
    robot = dataset.robot
    return Report(
        name=dataset.name,
        robot=robot.name,
        joints=dataset.joints,
        sample_rate=dataset.sample_rate,
        segments=dict(Counter(f"{s.role} {s.kind}" for s in segments)),
        operating_points=points,
        levels=tuple(sorted({s.amplitude for s in multisines}, reverse=True)),
        lines=len(lines),
        highest_hz=float(max(tops)) if tops else 0.0,
        q_noise=_median([_noise(s.q) for s in segments]),
        tau_noise=_median([_noise(s.tau) for s in segments]),
        motion_rms=_median([s.q.std(axis=0) for s in segments]),
        warnings=tuple(_warnings(dataset)),
        hold=dataset.input_hold,
        duration=sum(s.n_samples for s in segments) / dataset.sample_rate,
        channels={c: j for c in CHANNELS if (j := _present(segments, c, dataset.n))},
        units=tuple(("m", "N") if linear else ("rad", "N m") for linear in linear_joints(robot)),
        q_range=_range([s.q for s in segments]),
        tau_range=_range([s.tau for s in segments]),
        limits=tuple((float(a), float(b)) for a, b in zip(robot.q_min, robot.q_max)),
        torque_limits=tuple(float(x) for x in robot.array("torque_limit")),
        files=tuple(_line(s, dataset.sample_rate) for s in segments) if len(segments) <= SHOWN else (),
        guessed_drives=guessed_drives(robot),
    )


def _line(s: Segment, rate: float) -> str:
    periods = f", {s.periods} periods of {s.period} at {s.operating_point}" if s.kind == "multisine" else ""
    return f"{s.name}: {s.role} {s.kind}, {s.n_samples / rate:.4g} s{periods}"


def _noise(x: np.ndarray) -> np.ndarray:
    """(n,) noise; zero where there are too few samples to tell."""
    return difference_noise(x) if len(x) > 4 else np.zeros(x.shape[1])


def _median(rows: list[np.ndarray]) -> tuple[float, ...]:
    return tuple(float(v) for v in np.median(rows, axis=0))


def _range(signals: list[np.ndarray]) -> tuple[tuple[float, float], ...]:
    low, high = np.min([x.min(axis=0) for x in signals], axis=0), np.max([x.max(axis=0) for x in signals], axis=0)
    return tuple((float(a), float(b)) for a, b in zip(low, high))


def _present(segments: tuple[Segment, ...], channel: str, n: int) -> tuple[int, ...]:
    """Joints, from 1, whose channel holds values in some segment."""
    counts = _holding(segments, channel, n)
    return tuple(j + 1 for j in range(n) if counts[j])


def _holding(segments: tuple[Segment, ...], channel: str, n: int) -> list[int]:
    """Number of segments in which the channel of each joint holds values."""
    signals = [x for s in segments if (x := getattr(s, channel)) is not None]
    return [sum(bool(np.all(np.isfinite(x[:, j]))) for x in signals) for j in range(n)]


def _partial(dataset: Dataset) -> list[str]:
    """Measured channels that some segments hold and others do not; references go with the kind of a segment."""
    out = []
    for channel in ("q_link", "temp"):
        counts, all_of_them = _holding(dataset.segments, channel, dataset.n), len(dataset.segments)
        some = [j + 1 for j in range(dataset.n) if 0 < counts[j] < all_of_them]
        if some:
            most = max(counts[j - 1] for j in some)
            out.append(
                f"{channel} of joint{'s' if len(some) > 1 else ''} {', '.join(map(str, some))} in {most} of {all_of_them} segments only"
            )
    return out


def _lost(dataset: Dataset) -> list[str]:
    """Positions of single joints that repeat values in motion, as a diagnosis finds and fills them."""
    out = []
    for lost in with_lost_samples_filled(dataset)[1]:
        what = f"{lost.channel}_{lost.joint + 1} ({dataset.joints[lost.joint]})"
        if lost.every:
            out.append(f"{what} has a new value every {lost.every} samples only: a slower clock than that of the log")
        else:
            out.append(f"{what}: {lost.share:.1%} of the samples repeat the one before, in motion: lost samples")
    return out


def _without_validation(dataset: Dataset) -> str:
    """How the gain is measured of data of which none are held out."""
    fitted = dataset.select(role="identification")
    if with_held_out(dataset) is not dataset:
        return "the end of the only motion will be held out"
    points = {s.operating_point for s in fitted if s.kind == "multisine"} or {s.name for s in fitted}
    if len(points) < 2:
        return "with a single operating point no gain can be measured"
    return "the gain will be measured by leaving operating points out"


def _warnings(dataset: Dataset) -> list[str]:
    out = []
    if not any(s.role == "validation" for s in dataset.segments):
        out.append(f"no validation segments: {_without_validation(dataset)}")
    if not any(s.role == "identification" for s in dataset.segments):
        out.append("no identification segments: there is nothing to fit")
    out += [*_brief_warnings(dataset), *not_fitted(dataset), *_partial(dataset), *_lost(dataset)]
    alike: dict[str, list[str]] = {}
    for s in dataset.segments:
        found = [w for check in CHECKS for w in check(s, dataset)]
        if s.kind == "multisine" and not len(s.excited_lines):
            found.append("excited_lines are not said: no FRFs can be estimated")
        if s.kind == "multisine" and s.steady_periods < 2:
            found.append("one steady period; noise cannot be told from the scatter between periods")
        for w in found:
            # The same fault in many segments differs in its figures only.
            alike.setdefault(re.sub(r"(?<![A-Za-z_])-?\d[\d.e+-]*", "#", w) + _joint(w), []).append(f"{s.name}: {w}")
    for same in alike.values():
        out.append(same[0] + (f" (so in {len(same)} segments)" if len(same) > 1 else ""))
    return out[:MOST]


def _brief_warnings(dataset: Dataset) -> list[str]:
    """Motions too short in all to tell causes apart."""
    fitted = dataset.select(role="identification")
    if not fitted or any(s.kind != "trajectory" for s in fitted):
        return []
    seconds = sum(s.n_samples for s in fitted) / dataset.sample_rate
    if seconds >= BRIEF:
        return []
    return [
        f"{seconds:.3g} s of motion to fit in all, less than {BRIEF:g} s: inertia, gravity and friction hardly get apart, and causes even less"
    ]


def _joint(warning: str) -> str:
    match = re.match(r"[A-Za-z]\w*", warning)
    return match[0] if match else ""
