"""Results: what the simulation gets wrong, where, how sure, and what the extension gains."""

from __future__ import annotations

import json
import math
import os
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ident.plan import Plan
from robot_assets.robot import Robot

SCHEMA = "simgap-verdict/1"
UNKNOWN = "unknown cause remains"
NOTHING = 1e-3  # of a standard deviation, below which a value is told as zero
LEFT_OUT = "leave-one-operating-point-out"


@dataclass(frozen=True)
class Value:
    """A parameter with its standard deviation, SI."""

    value: float
    std: float
    unit: str

    @property
    def told(self) -> float:
        """The value as people are told it: zero where it is nothing beside its standard deviation."""
        return 0.0 if abs(self.value) < NOTHING * self.std < math.inf else self.value + 0.0


@dataclass(frozen=True)
class Alternative:
    """A rival of a named cause."""

    effect: str
    joint: str
    probability: float


@dataclass(frozen=True)
class Cause:
    """A named effect at a place ("flange" and "base" are places too).

    ``channel``: "q" or "q_link" for effects of a position channel, else None. ``joints``: both joints of an effect
    between two, the turning one, which is ``joint``, first; else none. ``with_load``: of a body, whether the loads that
    the robot names on it are part of it.
    """

    effect: str
    joint: str
    parameters: dict[str, Value]
    probability: float
    evidence: str
    alternatives: tuple[Alternative, ...]
    channel: str | None = None
    joints: tuple[str, ...] = ()
    with_load: bool = False


@dataclass(frozen=True)
class Where:
    """A share of the discrepancy: joint, signal and kind of line."""

    joint: str
    signal: str
    feature: str
    share: float


@dataclass(frozen=True)
class Discrepancy:
    """Whether the first model differs from the data beyond noise, and at which joints and frequencies."""

    detected: bool
    p_value: float
    chi2_per_dof: float
    where: tuple[Where, ...]


@dataclass(frozen=True)
class JointGain:
    """Rms prediction error of one joint on held-out segments before and after, N m, or N of a linear one."""

    before: float
    after: float
    noise_floor: float


@dataclass(frozen=True)
class Gain:
    """Prediction error on held-out segments before and after, in the unit that ``metric`` ends with.

    ``joints``: those over which errors are taken; ``by_joint``: all, one by one; ``worse``: whether held-out data are
    predicted worse, beyond chance.
    """

    segments: tuple[str, ...]
    metric: str
    before: float
    after: float
    noise_floor: float
    gap_closed: float | None
    ci95: tuple[float, float] | None
    method: str
    joints: tuple[str, ...] = ()
    by_joint: dict[str, JointGain] = field(default_factory=dict)
    worse: bool = False

    @property
    def over_all(self) -> tuple[float, float]:
        """Rms error over all joints, before and after; of ``joints`` where single ones are not known."""
        if not self.by_joint:
            return self.before, self.after
        before, after = (
            float(np.sqrt(np.mean([getattr(g, x) ** 2 for g in self.by_joint.values()]))) for x in ("before", "after")
        )
        return before, after

    @property
    def closed_told(self) -> float | None:
        """Share of the gap that is closed as people are told it: no more than all of it. Beyond is chance, by which the
        error after comes out below the estimate of the noise."""
        return None if self.gap_closed is None else min(self.gap_closed, 1.0)

    @property
    def interval_told(self) -> tuple[float, float] | None:
        """Interval of ``closed_told``; none where it has no width, as of a model that was not extended."""
        if self.ci95 is None or self.ci95[0] == self.ci95[1]:
            return None
        return min(self.ci95[0], 1.0), min(self.ci95[1], 1.0)

    @property
    def of_some(self) -> bool:
        """Whether errors are taken over some of the joints."""
        return 0 < len(self.joints) < len(self.by_joint)


@dataclass(frozen=True)
class Verdict:
    """The result of a diagnosis; ``to_dict`` is the contract of verdict.json."""

    dataset: str
    baseline: dict[str, Value]
    discrepancy: Discrepancy
    causes: tuple[Cause, ...]
    unexplained_share: float
    unexplained_verdict: str
    gain: Gain | None
    next_experiment: str | None
    sentence: str
    unidentified: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    residual_description: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, plain SI numbers."""
        out = {
            "schema": SCHEMA,
            "dataset": self.dataset,
            "sentence": self.sentence,
            "baseline": {
                "parameters": {k: asdict(v) for k, v in self.baseline.items()},
                "not_identified": list(self.unidentified),
            },
            "discrepancy": asdict(self.discrepancy),
            "causes": [asdict(c) for c in self.causes],
            "unexplained": {
                "share": self.unexplained_share,
                "verdict": self.unexplained_verdict,
                "description": self.residual_description,
            },
            "gain": None if self.gain is None else asdict(self.gain),
            "next_experiment": self.next_experiment,
            "notes": list(self.notes),
        }
        return _plain(out)

    def save(self, folder: str | Path) -> Path:
        """Write ``verdict.json`` into a folder; an earlier one stands until the new one is whole."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(self.to_dict(), indent=2, allow_nan=False)
        handle, name = tempfile.mkstemp(prefix=".verdict-", dir=folder)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text + "\n")
        os.chmod(name, 0o644)
        os.replace(name, folder / "verdict.json")
        return folder / "verdict.json"


@dataclass(frozen=True)
class SpectrumMap:
    """Rms torque residual, N m: (Q, n, B) per operating point, joint and band."""

    band_edges_hz: np.ndarray
    before: np.ndarray
    after: np.ndarray
    noise: np.ndarray
    operating_points: tuple[str, ...]


@dataclass(frozen=True)
class EvidencePlot:
    """Residual torque, or that of a link encoder, against the variable that explains it, and the fitted law.

    Of what no cause explains (``cause`` None) the mean of the residual over the variable stands for the law.
    """

    cause: int | None
    title: str
    x_label: str
    y_label: str
    x: np.ndarray
    y: np.ndarray
    model_x: np.ndarray
    model_y: np.ndarray


@dataclass(frozen=True)
class TorqueTrace:
    """Motor torque along a motion: (N, n) measured and predicted, and the motor position."""

    segment: str
    t: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    q: np.ndarray


@dataclass(frozen=True)
class FrfView:
    """Motor torque to motor acceleration at an operating point, (rad/s2)/(N m)."""

    operating_point: str
    frequency: np.ndarray
    measured: np.ndarray
    measured_std: np.ndarray
    baseline: np.ndarray
    extended: np.ndarray


@dataclass(frozen=True)
class Diagnosis:
    """Everything a report or recording shows.

    ``inertias`` of bodies by joint of the description, where they were found; ``parameters`` of the drives; ``timing``,
    s: delay of the torque against its record that the hold does not explain; ``roll_off``, s2: what that record loses
    (``ident.roll_off``).
    """

    verdict: Verdict
    robot: Robot
    joints: tuple[str, ...]
    frf: tuple[FrfView, ...]
    spectrum: SpectrumMap | None
    evidence: tuple[EvidencePlot, ...]
    traces: tuple[TorqueTrace, ...]
    parameters: dict[str, float]
    seconds: float
    candidates: tuple[tuple[tuple[str, str, float], ...], ...] = field(default=())
    next_plan: Plan | None = None
    inertias: dict[str, pin.Inertia] = field(default_factory=dict)
    timing: float = 0.0
    roll_off: float = 0.0


def _plain(x: Any) -> Any:
    """NumPy numbers to Python ones; numbers that JSON lacks to null."""
    if isinstance(x, dict):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, np.ndarray):
        return [_plain(v) for v in x.tolist()]
    if isinstance(x, np.bool_):
        return bool(x)
    if isinstance(x, np.integer):
        return int(x)
    if isinstance(x, float | np.floating):
        return float(x) if np.isfinite(x) else None
    return x
