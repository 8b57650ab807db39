"""Whether multisines repeat with the period that is said of them."""

from __future__ import annotations

import numpy as np
import scipy.signal

from ident.dataset import Dataset, Segment
from ident.records import drift
from ident.rest import difference_noise
from robot_assets.robot import linear_joints

SEEN = 5.0  # rms of a channel over the noise of its samples, from which it can tell
REPEATS = 0.5  # of what a channel does within a period, by which periods may differ
TOGETHER = 0.25  # of what all positions do within a period, by which their last two may differ beyond noise


def period_warnings(s: Segment, dataset: Dataset) -> list[str]:
    """A period after which nothing repeats, or positions as a whole do not; a single one that has not settled."""
    if s.kind != "multisine":
        return []
    if s.steady_periods < 2:
        return _unsettled(s, dataset) if s.steady_periods and not s.transient_periods else []
    return _nothing_repeats(s) or _otherwise_moved(s, dataset)


def _unsettled(s: Segment, dataset: Dataset) -> list[str]:
    """Positions that drift over the only period, that which drifts most beside what it does."""
    (q,) = s.periodic("q")
    far = np.ptp(drift(q), axis=0)
    share = far / np.maximum(np.std(q, axis=0), 1e-300)
    most = int(np.argmax(share))
    if not share[most]:
        return []
    unit = "m" if linear_joints(dataset.robot)[most] else "rad"
    return [
        f"{dataset.joints[most]} ends the only period {far[most]:.2g} {unit} from where it began, {share[most]:.2g}"
        " times its rms motion: it had not settled. A period recorded before it, as a transient one, tells of that best"
    ]


def _nothing_repeats(s: Segment) -> list[str]:
    least = min(float(differing(s, channel).min()) for channel in ("q", "tau"))
    if least < REPEATS or np.isinf(least):
        return []
    return [
        f"nothing repeats with a period of {s.period} samples: from one to the next every signal differs by {least:.2g} times what"
        " it does within a period, or more: another period, or no multisine?"
    ]


def _otherwise_moved(s: Segment, dataset: Dataset) -> list[str]:
    """Positions that go another way in the last period than in the one before.

    Their second halves are compared, where transients have gone by, and all joints at once: one that is not excited
    wanders by counts and friction, which is little beside what others do. A straight line between them is left out: so
    does a transient that dies down slowly look.
    """
    x = s.periodic("q")[-2:]
    half = x.shape[1] // 2
    x = x[:, half:] / dataset.robot.array("velocity_limit")
    x = x - x.mean(axis=1, keepdims=True)
    noise = difference_noise(s.q) / dataset.robot.array("velocity_limit")
    off = scipy.signal.detrend(x[1] - x[0], axis=0)
    differ = np.maximum(np.mean(off**2, axis=0) / 2 - noise**2, 0.0)
    within = float(np.sum(np.var(x.mean(axis=0), axis=0)))
    share = float(np.sqrt(differ.sum() / within)) if within > 0 else 0.0
    if share < TOGETHER:
        return []
    most = int(np.argmax(differ))
    return [
        f"the motion does not repeat with a period of {s.period} samples: the positions of the last one differ from those before by"
        f" {share:.2g} times what they do within a period, joint {most + 1} ({dataset.joints[most]}) most: another period, or no multisine?"
    ]


def differing(s: Segment, channel: str) -> np.ndarray:
    """(n,) rms of what differs between periods over that of their mean; infinite where nothing but noise is seen.

    Means of each period do not count: a motor may creep.
    """
    x = s.periodic(channel)
    x = x - x.mean(axis=1, keepdims=True)
    mean = x.mean(axis=0)
    differ = np.sqrt(np.sum((x - mean) ** 2, axis=(0, 1)) / ((len(x) - 1) * x.shape[1]))
    within = np.maximum(np.std(mean, axis=0), 1e-300)
    seen = np.sqrt(np.mean(x**2, axis=(0, 1))) > SEEN * difference_noise(getattr(s, channel))
    return np.where(seen, differ / within, np.inf)


def unrepeated(dataset: Dataset) -> list[str]:
    """What is surely wrong in the periods of a dataset: said of more than half of its multisines that have several."""
    told = [(s.name, _nothing_repeats(s)) for s in dataset.segments if s.kind == "multisine" and s.steady_periods > 1]
    wrong = [f"{name}: {text}" for name, found in told for text in found]
    return wrong[:1] if len(wrong) > 0.5 * len(told) else []
