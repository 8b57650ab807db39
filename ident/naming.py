"""What effects are called: a law may be so near to a special case of it that it goes by that name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ident.evidence import Candidate
from ident.group import Group
from ident.model import Effect

MOVES = 0.1  # of the largest motion of a joint, from which it moves


def called(effect: Effect, groups: Sequence[Group], stiffness: np.ndarray) -> tuple[str, Mapping[str, str]]:
    """The name under which an effect is told, and those of parameters that are called otherwise there.

    Args:
        groups: records whose motion says how near to a special case it is.
        stiffness: (n,) of the gears, N m/rad, which says so too.
    """
    h = effect.hypothesis
    if "called" not in h.options:
        return h.effect, {}
    return h.options["called"](effect.p, usual_swing(groups, h.joint), stiffness[h.joint]) or (h.effect, {})


def told_name(candidate: Candidate, groups: Sequence[Group]) -> str:
    """``called`` of a candidate; "unknown" of what is no effect of the catalogue."""
    h = candidate.hypothesis
    if h.decoy:
        return "unknown"
    tried = [e for e in candidate.fit.model.effects if e.hypothesis.key == h.key]
    return called(tried[0], groups, candidate.fit.model.par.stiffness)[0] if tried else h.effect


def usual_swing(groups: Sequence[Group], joint: int) -> float:
    """Rms motion of a joint about its mean, rad or m: the median over records in which it moves."""
    rms = np.sqrt(2.0 * np.concatenate([np.sum(np.abs(g.Q[:, 1:, joint]) ** 2, axis=1) for g in groups]))
    return float(np.median(rms[rms >= MOVES * rms.max()]))
