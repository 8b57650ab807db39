"""How far names can be trusted: by what is left where they sit, by held-out data, by the drives beside them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.attribute import DETECTION_EXCESS, Attribution, Round, implausible
from ident.extended import Effect, Prediction
from ident.hypotheses import Hypothesis
from ident.torque_fit import Fit, Problem
from ident.verdict import Gain

LEFT_NOISE = 1.15  # chi2 per degree of freedom up to which the noise floor counts as reached
WORSE = 1.05  # held-out error of the extended model, over that of the baseline, that refutes it
CLEAR = 2.0  # held-out error of the baseline over the noise from which it tells
CLOSED = 0.5  # share of the gap that the extended model must then close
CARRIED = 0.8  # the same where it explains the data that it was fitted to down to the noise
ABOVE_NOISE = 1.5  # held-out error of the extended model over the noise, from which it has not carried over
SHORT = 0.25  # by which the gap closed on held-out data may fall short of what the fitted ones promise
RIPPLE = "periods_per_rev"  # parameter of effects that repeat with the position
LEAST_FOLLOWED = 0.1  # share of the path along which a ripple must lie in the compared band for its name to be trusted
LEFT_ERROR = 3.0  # chi2 per degree of freedom above which an unknown cause remains however strong the named ones are


def _at(h: Hypothesis, costs: np.ndarray) -> float:
    """Of costs by joint, those that an effect answers for: its joint, or all where it changes the chain."""
    return float(costs[h.joint] if h.joint >= 0 and h.channel != "model" else np.sum(costs))


def _excess(result: Fit, level: float) -> np.ndarray:
    """(n,) whitened cost of a fit by joint beyond ``level`` times the noise."""
    return np.maximum(result.costs - level * result.count / len(result.costs), 0.0)


def left_of(h: Hypothesis, result: Attribution) -> float:
    """Share of the discrepancy that is left where an effect sits, 0 to 1: there no other cause hides behind it."""
    before = _at(h, _excess(result.baseline, 1.0))
    after = _at(h, _excess(result.final, DETECTION_EXCESS))
    return float(np.clip(after / max(before, 1e-300), 0.0, 1.0)) if after > 0.0 else 0.0


def explained_share(found: Round, final: Fit) -> float:
    """What a cause explains where it sits, over that and what is left there at the end: 1 where nothing is left.

    A cause that explains less than the unknown may be the unknown's own shadow.
    """
    winner = found.candidates[0]
    fall = max(_at(winner.hypothesis, found.before.costs - winner.fit.costs), 0.0)
    left = _at(winner.hypothesis, _excess(final, LEFT_NOISE))
    return fall / max(fall + left, 1e-300)


def fails_held_out(gain: Gain | None, final: Fit, left: float) -> bool:
    """Whether held-out data refute the extended model: no name is trusted then.

    It predicts them worse than the baseline, or leaves most of a clear error that the causes were named for;
    or it explains the data it was fitted to, and leaves more of the held-out ones than a model that is right.

    Args:
        left: share of the discrepancy, as power, that the model leaves of the data that it was fitted to.
    """
    if gain is None:
        return False
    if gain.after > WORSE * gain.before:
        return True
    if gain.gap_closed is None or not gain.before > CLEAR * gain.noise_floor:
        return False
    settled = final.chi2_per_dof < LEFT_ERROR and gain.after > ABOVE_NOISE * gain.noise_floor
    expected = 1.0 - np.sqrt(left)
    return gain.gap_closed < max(CARRIED if settled else CLOSED, expected - SHORT)


def too_fast(problem: Problem, predictions: Sequence[Prediction], effect: Effect) -> bool:
    """Whether a ripple lies beyond the compared band along nearly all the path of the motions.

    What is left of it there is a turn or two where the joint creeps: that has many wave numbers.
    """
    names = [q.name for q in effect.hypothesis.parameters]
    if not problem.motions_alone or RIPPLE not in names:
        return False
    slow = path = 0.0
    for group, pred in zip(problem.groups, predictions, strict=True):
        speed = np.abs(pred.motion(group).v(effect.hypothesis.joint)) * group.window
        slow += float(np.sum(speed[effect.value(RIPPLE) * speed < group.omega[group.n_compared - 1]]))
        path += float(np.sum(speed))
    return slow < LEAST_FOLLOWED * path


def collapsed(problem: Problem, final: Fit) -> bool:
    """Whether the final model explains the data badly and with drives that cannot be those of this arm.

    The causes that were found beside these may stand for what is missing too.
    """
    return final.chi2_per_dof > LEFT_ERROR and implausible(problem, final)


def known_probability(left: float, refuted: bool) -> float:
    """How far the names can be trusted, from the share of the discrepancy that they leave."""
    if refuted:
        return 0.4
    return float(1.0 / (1.0 + (left / 0.15) ** 2))
