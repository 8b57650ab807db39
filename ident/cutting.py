"""A whole plan in one long recording: where its parts lie, and the recording cut into a dataset.

The experiment of Wernholt and Moberg 2011, Figure 1: the arm moves to an operating point, settles,
and the experiments of that point follow one another without a stop, each as long as its periods;
then the next point. What is spent on the way is counted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ident.dataset import Dataset, Segment
from ident.plan import Experiment, Part, Plan, Schedule, Trajectory, point_to_point
from robot_assets.errors import DataError

SETTLE = 1.0  # s of rest after a move; the transient periods of the first experiment follow it
OFF_POSTURE = 0.1  # rad (m), mean distance from the planned posture beyond which a recording is of something else


@dataclass(frozen=True)
class Usage:
    """Samples of a recording by what they are spent on, and the sample rate in Hz.

    Attributes:
        moves, settling: on the way to operating points and at rest there.
        transients: leading periods of the experiments, which are discarded.
        measured: steady periods.
        trajectories: motions of the plan.
    """

    sample_rate: float
    moves: int
    settling: int
    transients: int
    measured: int
    trajectories: int

    @property
    def total(self) -> int:
        """All samples."""
        return self.moves + self.settling + self.transients + self.measured + self.trajectories

    def text(self) -> str:
        """A table of samples, seconds and shares."""
        rows = [(k, getattr(self, k)) for k in ("moves", "settling", "transients", "measured", "trajectories", "total")]
        total = max(self.total, 1)
        return "\n".join(f"{k:12s} {n:9d} samples {n / self.sample_rate:8.1f} s {n / total:6.1%}" for k, n in rows)


def schedule_plan(plan: Plan, *, settle: float = SETTLE) -> Schedule:
    """Run the experiments and then the motions of a plan one after another.

    Args:
        settle: s of rest after every move.

    Raises:
        DataError: for a plan without anything in it, or a negative time.
    """
    items: tuple[Experiment | Trajectory, ...] = (*plan.experiments, *plan.trajectories)
    if not items:
        raise DataError("plan", plan.robot.name, "neither experiment nor motion", "at least one")
    if not 0 <= settle < 1e4:
        raise DataError("settle", "schedule_plan", f"{settle:g} s", "0 to 10000 s")
    x, n = plan.excitation, plan.robot.n
    rest = np.zeros((round(settle * x.sample_rate), n))
    parts: list[Part] = []
    q_ref, r = [], []
    clock, at = 0, None

    def add(
        kind: str, q: np.ndarray, excitation: np.ndarray | None = None, source: Experiment | Trajectory | None = None
    ) -> None:
        nonlocal clock
        parts.append(Part(kind, clock, clock + len(q), source))
        q_ref.append(q)
        r.append(np.zeros_like(q) if excitation is None else excitation)
        clock += len(q)

    for item in items:
        start, end = (item.q0, item.q0) if isinstance(item, Experiment) else (item.q_ref[0], item.q_ref[-1])
        if at is not None and not np.allclose(at, start, rtol=0, atol=1e-9):
            add("move", point_to_point(plan.robot, at, start, x.sample_rate))
            add("settle", start + rest)
        elif at is None:
            add("settle", start + rest)
        if isinstance(item, Experiment):
            add(
                "experiment",
                np.repeat(start[None], x.period * x.periods, axis=0),
                np.tile(item.r, (x.periods, 1)),
                item,
            )
        else:
            add("trajectory", item.q_ref, source=item)
        at = end
    return Schedule(plan, tuple(parts), np.concatenate(q_ref), np.concatenate(r))


def usage(schedule: Schedule) -> Usage:
    """What the samples of a recording are spent on."""
    x = schedule.plan.excitation
    spent = {
        kind: sum(p.stop - p.start for p in schedule.parts if p.kind == kind)
        for kind in ("move", "settle", "experiment", "trajectory")
    }
    transients = sum(x.transient_periods * x.period for p in schedule.parts if p.kind == "experiment")
    return Usage(
        x.sample_rate, spent["move"], spent["settle"], transients, spent["experiment"] - transients, spent["trajectory"]
    )


def cut_recording(recording: Dataset, schedule: Schedule) -> Dataset:
    """The dataset that separate experiments would give, from one recording of the whole schedule.

    Args:
        recording: of one segment, as long as the schedule. Its ``r``, where it has one, is what was
            injected; else that of the plan is taken.

    Raises:
        DataError: where the recording is not one of this schedule: more than one segment, another arm,
            sample rate or length, or a posture far from the planned one.
    """
    plan, name = schedule.plan, recording.name
    x = plan.excitation
    if len(recording.segments) != 1:
        raise DataError("segments", name, str(len(recording.segments)), "one recording of the whole plan")
    whole = recording.segments[0]
    if recording.joints != plan.robot.joint_names:
        raise DataError("joints", name, ", ".join(recording.joints), ", ".join(plan.robot.joint_names))
    if abs(recording.sample_rate / x.sample_rate - 1) > 1e-6:
        raise DataError("sample_rate", name, f"{recording.sample_rate:g} Hz", f"{x.sample_rate:g} Hz as planned")
    if whole.n_samples != len(schedule.q_ref):
        raise DataError("samples", name, str(whole.n_samples), f"{len(schedule.q_ref)}, the length of the plan")
    cut = [_segment(whole, schedule, part, part.source) for part in schedule.parts if part.source is not None]
    return replace(recording, segments=tuple(cut))


def _segment(whole: Segment, schedule: Schedule, part: Part, source: Experiment | Trajectory) -> Segment:
    off = np.abs(np.mean(whole.q[part.samples] - schedule.q_ref[part.samples], axis=0))
    worst = int(np.argmax(off))
    if not off[worst] < OFF_POSTURE:
        found = f"q_{worst + 1} on average {off[worst]:.3g} off the planned posture"
        raise DataError(
            "posture", f"{source.name}, samples {part.start} to {part.stop}", found, f"less than {OFF_POSTURE:g}"
        )
    channels = whole.part(part.samples)
    # Motions and excitation of the whole recording stand in the plan; what was injected may be better known.
    channels.pop("q_ref", None)
    r = channels.pop("r", schedule.r[part.samples])
    if isinstance(source, Trajectory):
        return Segment(name=source.name, kind="trajectory", role=source.role, q_ref=source.q_ref, **channels)
    return Segment(r=r, **channels, **source.labels(schedule.plan.excitation))
