"""What a dataset holds, and what looks wrong in it."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ident.dataset import Dataset
from ident.noise import difference_noise


@dataclass(frozen=True)
class Report:
    """Contents and warnings of a dataset."""

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

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    def text(self) -> str:
        kinds = ", ".join(f"{v} {k}" for k, v in self.segments.items())
        rows = [
            f"{self.name}: {self.robot}, {len(self.joints)} joints at {self.sample_rate:g} Hz; {kinds}",
            f"operating points {len(self.operating_points)}, levels {list(self.levels)}, {self.lines} excited lines up to {self.highest_hz:.4g} Hz",
        ]
        for j, name in enumerate(self.joints):
            rows.append(
                f"  {name}: motion {self.motion_rms[j]:.3g} rad rms, noise {self.q_noise[j]:.2g} rad and {self.tau_noise[j]:.2g} N m"
            )
        return "\n".join([*rows, *(f"warning: {w}" for w in self.warnings)])


def inspect_dataset(dataset: Dataset) -> Report:
    """Contents, noise from fourth differences, and warnings."""
    segments = dataset.segments
    multisines = [s for s in segments if s.kind == "multisine"]
    lines = sorted({int(k) for s in multisines for k in s.excited_lines})
    tops = [max(s.excited_lines) * dataset.sample_rate / s.period for s in multisines if len(s.excited_lines)]
    points = tuple(dict.fromkeys(str(s.operating_point) for s in multisines))
    return Report(
        name=dataset.name,
        robot=dataset.robot.name,
        joints=dataset.joints,
        sample_rate=dataset.sample_rate,
        segments=dict(Counter(f"{s.role} {s.kind}" for s in segments)),
        operating_points=points,
        levels=tuple(sorted({s.amplitude for s in multisines}, reverse=True)),
        lines=len(lines),
        highest_hz=float(max(tops)) if tops else 0.0,
        q_noise=_median([difference_noise(s.q) for s in segments]),
        tau_noise=_median([difference_noise(s.tau) for s in segments]),
        motion_rms=_median([s.q.std(axis=0) for s in segments]),
        warnings=tuple(_warnings(dataset)),
    )


def _median(rows: list[np.ndarray]) -> tuple[float, ...]:
    return tuple(float(v) for v in np.median(rows, axis=0))


def _warnings(dataset: Dataset) -> list[str]:
    out = []
    limits = dataset.robot.array("torque_limit")
    if not any(s.role == "validation" for s in dataset.segments):
        out.append("no validation segments: the gain will be measured by leaving operating points out")
    for s in dataset.segments:
        for j, name in enumerate(dataset.joints):
            for channel in ("tau", "q"):
                x = getattr(s, channel)[:, j]
                if np.ptp(x) == 0:
                    out.append(f"{s.name}: {channel}_{j + 1} ({name}) is frozen")
                elif channel == "tau":
                    top = np.mean(np.isclose(x, x.max(), rtol=0, atol=1e-9 * np.ptp(x)))
                    if top > 0.01:
                        out.append(f"{s.name}: tau_{j + 1} ({name}) is clipped at {x.max():.4g} N m")
            if np.abs(s.tau[:, j]).max() > 20 * limits[j]:
                out.append(f"{s.name}: tau_{j + 1} ({name}) is far above the torque limit: wrong unit or side of the gear?")
            if np.abs(s.q[:, j]).max() > 50:
                out.append(f"{s.name}: q_{j + 1} ({name}) exceeds 50 rad: degrees, or the motor side of the gear?")
        if s.kind == "multisine" and s.steady_periods < 2:
            out.append(f"{s.name}: one steady period; noise cannot be told from the scatter between periods")
    return out[:40]
