"""What the extended model gains on data that it was not fitted to, and causes that these data refute."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.attribute import Attribution
from ident.extended import Prediction, predict
from ident.gain import Errors, measure_gain, segment_errors
from ident.graybox import Parameters
from ident.group import Group
from ident.identification import Setup
from ident.left_out import SEED, joined, refitted
from ident.parallel import Workers
from ident.problem import NOT_COMPUTED, Problem
from ident.pruning import without_effect
from ident.torque_fit import Fit
from ident.trust import fails_held_out, is_halved
from ident.units import torque_unit, units_of_torques
from ident.values import named_effects
from ident.verdict import LEFT_OUT, Gain

CARRIES = 0.8  # of the held-out error, that is left without a cause which does not carry over


@dataclass(frozen=True)
class HeldOut:
    """Gain on data that no model was fitted to.

    Attributes:
        judged: the same for what names are trusted by, of ``Errors.seen_along``.
        shown, pairs: groups to be shown, and their predictions before and after.
        told_by_torque: as of ``Errors``.
    """

    gain: Gain | None
    judged: Gain | None
    shown: tuple[Group, ...]
    pairs: Sequence[tuple[Prediction, Prediction]]
    told_by_torque: tuple[str, ...] = ()


def held_out(
    setup: Setup,
    nominal: Parameters,
    baseline: Fit,
    result: Attribution,
    renewed: bool,
    affected: Sequence[int],
    method: str,
    workers: Workers,
) -> HeldOut:
    """What the extended model gains on data that it was not fitted to: held-out segments, or points left out.

    Args:
        nominal, renewed: as of ``leave_one_out``.
        affected: joints over which errors are taken.
        method: how segments are held out, for the verdict.
    """
    problem, before, after = setup.problem, baseline.model, result.final.model
    if setup.held_out:
        errors, pairs = segment_errors(problem, setup.held_out, before, after)
        shown = tuple(g for g in setup.held_out if g.segments[0] in errors.segments)
    else:
        left_out = leave_one_out(setup, nominal, baseline, result, renewed, workers)
        g = problem.groups[0]
        shown, pairs = (g,), [(predict(before, g, problem.sampling), predict(after, g, problem.sampling))]
        if left_out is None:
            return HeldOut(None, None, shown, pairs)
        errors, method = left_out, LEFT_OUT
    units = units_of_torques(problem.structure.robot)
    gain, judged = (
        measure_gain(x, units, affected, method, np.random.default_rng(SEED)) for x in (errors, errors.seen_along())
    )
    return HeldOut(gain, judged, shown, pairs, errors.told_by_torque)


def leave_one_out(
    setup: Setup,
    nominal: Parameters,
    baseline: Fit,
    result: Attribution,
    renewed: bool,
    workers: Workers = Workers(),
) -> Errors | None:
    """Errors on one operating point after another, both models refitted without it; None of a single one.

    Args:
        nominal: starting guesses of the drives.
        baseline: the first model.
        renewed: whether the inertias of the links were found too.
    """
    problem = setup.problem
    # Records of one posture may differ in their periods; each motion is one of its own.
    of = [g.operating_point if g.window is None else i for i, g in enumerate(problem.groups)]
    points = tuple(dict.fromkeys(of))
    if len(points) < 2:
        return None

    def without(point: str | int) -> Errors:
        left_out, kept = (
            tuple(g for g, name in zip(problem.groups, of, strict=True) if (name == point) is out)
            for out in (True, False)
        )
        models = []
        for start in (baseline, result.final):
            remainders = [W for W, name in zip(start.remainders, of, strict=True) if name != point]
            found = renewed and start is result.final
            models.append(refitted(replace(problem, nominal=nominal), kept, start, found, remainders))
        return segment_errors(problem, left_out, *models, alone=False)[0]

    return joined(workers.map(without, points))


def without_denied(
    problem: Problem, result: Attribution, belied: Collection[tuple[str, str]]
) -> tuple[Attribution, list[str]]:
    """A result without the causes, found within the noise beside others, that held-out data deny, and a line on each.

    A cause that stands alone stays: something was seen, and it is not that.

    Args:
        belied: causes, by ``key``, that are denied (``trust.denied``).
    """
    lines = []
    for found in reversed(result.rounds):
        cause = found.candidates[0].hypothesis
        named = {e.hypothesis.key for e in named_effects(result.final)}
        if cause.key not in named or len(named) < 2 or cause.key not in belied:
            continue
        try:
            result = _without(problem, result, cause.key)
        except NOT_COMPUTED:
            continue
        lines.append(
            f"Taken back: {cause.effect} at {cause.place}, found within the noise. What it changes there does not show in held-out data."
        )
    return result, lines


def _without(problem: Problem, result: Attribution, key: tuple[str, str]) -> Attribution:
    """A result without one of its causes, the others fitted again."""
    rounds = tuple(r for r in result.rounds if r.candidates[0].hypothesis.key != key)
    return replace(result, final=without_effect(problem, result.final, key), rounds=rounds)


def taken_back(
    setup: Setup, result: Attribution, tested: Callable[[Attribution, bool], HeldOut]
) -> tuple[Attribution, HeldOut, list[str]]:
    """A result without the causes that held-out data refute, what it gains there, and a line on each that was taken
    back.

    A search that goes on where little is left adds to a law what that lacks in the records that it is fitted to, and
    may spoil it for others. Where held-out data refute the whole the causes found last go, as long as that predicts
    these data better; and all of them where the baseline does.

    Args:
        tested: ``held_out`` of a result, with the inertias that were found or without.
    """
    problem, robot = setup.problem, setup.problem.structure.robot
    test, lines = tested(result, True), []

    def told(what: str, gain: Gain, left: float) -> str:
        return (
            f"Taken back: {what}. Held-out data are predicted worse with than without: {gain.after:.3g} in place of {left:.3g}"
            f" {torque_unit(robot, gain.joints)}."
        )

    while test.judged is not None:
        named = {e.hypothesis.key for e in named_effects(result.final)}
        found = list({h.key: h for h in (r.candidates[0].hypothesis for r in result.rounds) if h.key in named}.values())
        halved = is_halved(problem, test.judged)
        refuted = test.judged.worse or fails_held_out(test.judged, result.final, result.left_share, halved)
        if not refuted or len(found) < 2:
            break
        last = found[-1]
        try:
            less = _without(problem, result, last.key)
            other = tested(less, True)
        except NOT_COMPUTED:
            break
        if other.judged is None or not other.judged.after < CARRIES * test.judged.after:
            break
        lines.append(told(f"{last.effect} at {last.place}", test.judged, other.judged.after))
        result, test = less, other
    if test.gain is not None and test.judged is not None and test.judged.worse:
        names = ", ".join(f"{e.hypothesis.effect} at {e.hypothesis.place}" for e in named_effects(result.final))
        lines.append(told(names or "what has no name", test.gain, test.gain.before))
        result = result.without_causes()
        test = tested(result, False)
    return result, test, lines
