"""Causes against their rivals once more, beside all that was found after them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from ident.baseline import DETECTION_EXCESS, FAINT
from ident.evidence import Candidate, errors_by_joint, weigh
from ident.hypotheses import Hypothesis, catalogue, wider_forms
from ident.hypotheses.bodies import payload, payload_like
from ident.hypotheses.hypothesis import RIPPLE
from ident.model import Effect
from ident.parallel import Workers
from ident.problem import Problem, predictions
from ident.pruning import plainly_special, pruned, untold
from ident.refits import (
    FINALISTS,
    FIRST_STEPS,
    POLISH_STEPS,
    clip_to_bounds,
    either_turn,
    polish,
    refit,
    settled,
    to_compete,
    unsettled_at,
)
from ident.rounds import Round, outdone, temper_of
from ident.screening import screen, signal_scale
from ident.search import HOPELESS_RATIO, best_named
from ident.torque_fit import Fit

SAME_PERIOD = 0.01  # relative, of two ripples
REMATCH = 0.002  # probability from which a rival is weighed against a cause again at the end
ALIKE = (  # pairs that are hard to tell apart beside a cause that is missing
    {"torque_constant", "link_inertia"},
    {"torque_delay", "torque_lag"},
    {"sensor_delay", "sensor_lag"},
    {"cogging", "transmission_error"},
    {"backlash", "softening_stiffness"},
    {"coulomb_friction", "dress_pack"},
)


def weighed_again(problem: Problem, current: Fit, rounds: Sequence[Round], workers: Workers) -> tuple[Fit, list[Round]]:
    """``rematched``, and the model pruned where a rival has won: alone it may explain what the loser did beside
    others."""
    found, rounds = rematched(problem, current, rounds, workers)
    return found if found is current else pruned(problem, found), rounds


def rematched(problem: Problem, current: Fit, rounds: Sequence[Round], workers: Workers) -> tuple[Fit, list[Round]]:
    """Causes against their rivals once more, beside all that was found after them.

    In the round in which a cause is named those still missing blur what sets it apart from its rivals.
    """
    out = []
    for found in rounds:
        winner = found.candidates[0].hypothesis
        there = {e.hypothesis.key for e in current.model.effects}
        blurred = len(there) > 1 or outdone(found) or nearly_settled(problem, current, winner)
        blurred = blurred or bool(forms_to_try(problem, current, winner))
        if blurred and winner.key in there and not winner.decoy and not workers.late:
            current, found = contest(problem, current, found, workers)
        out.append(found)
    return current, out


def contest(problem: Problem, current: Fit, found: Round, workers: Workers) -> tuple[Fit, Round]:
    """The winner of a round and its rivals, each fitted in its place: the model with the best of them, and the
    round."""
    effects = current.model.effects
    there = {e.hypothesis.key for e in effects}
    winner = found.candidates[0].hypothesis
    others = tuple(e for e in effects if e.hypothesis.key != winner.key)
    own = next(e for e in effects if e.hypothesis.key == winner.key)

    def other(h: Hypothesis) -> bool:
        """Whether it is not there already: a body with its load is another one than without."""
        loaded = [x.options.get("with_load") for x in (h, own.hypothesis)]
        return h.key not in there or (h.key == winner.key and loaded[0] != loaded[1])

    rivals = [c.fit.model.effects[-1] for c in found.candidates[1:] if c.probability > REMATCH and other(c.hypothesis)]
    rivals = [e for _, e in best_named([(e.hypothesis, e) for e in rivals], FINALISTS, FINALISTS)]
    rivals += [
        e for e in alike(found, winner) if other(e.hypothesis) and all(e.hypothesis is not x.hypothesis for x in rivals)
    ]
    rivals += [*as_load(current, own, others), *elsewhere(problem, current, own, others)]
    rivals += [*wider(problem, current, own), *narrower(problem, own)]

    enough = to_compete(current.cost, current.count)

    def entered(effect: Effect) -> Fit | None:
        model = replace(current.model, effects=(*others, effect))
        return refit(problem, model, current.weights, current.remainders, aim=enough)

    def finished(entrant: Candidate) -> Candidate:
        last = entrant.fit
        if not last.converged:
            last = refit(problem, last.model, last.weights, last.remainders, POLISH_STEPS) or last
        return replace(entrant, fit=either_turn(problem, last, last.model.effects[-1]))

    entrants = [own, *rivals] if rivals else []
    fits = workers.map_in_time(entered, entrants, lambda e: f"again: {e.hypothesis.effect} at {e.hypothesis.place}")
    ran = [Candidate(e.hypothesis, r, 0.0) for e, r in zip(entrants, fits, strict=True) if r is not None]
    if len(ran) < 2 or ran[0].hypothesis is not own.hypothesis:
        return current, found
    near = in_reach(ran)
    ran = [new or c for c, new in zip(near, workers.map_in_time(finished, near), strict=True)]
    first = ran[0].fit
    kept = best_of_each(ran)
    names = {c.hypothesis.key for c in kept}
    ran = [c for c in kept if c.hypothesis is own.hypothesis or not same_as_special(problem, c, names)]
    excess = errors_by_joint(min((c.fit for c in ran), key=lambda r: r.cost).costs, current.counts, found.fall)
    weighed = weigh(ran, excess, found.falls, temper_of(found.before))
    best = weighed[0]
    if best.hypothesis.decoy:  # it takes probability from the name, and no place in the model
        best = next(c for c in weighed if c.hypothesis.key == own.hypothesis.key)
    elif best.fit is not first:
        current = polish(problem, best.fit)
    now: dict[tuple[str, str], float] = {}
    for c in weighed:
        now[c.hypothesis.key] = now.get(c.hypothesis.key, 0.0) + c.probability
    seen = {c.hypothesis.key for c in found.candidates}
    new = [c for c in weighed if c.hypothesis.key not in seen]
    new_form = best.hypothesis.key in seen and all(c.hypothesis is not best.hypothesis for c in found.candidates)
    old = [best if new_form and c.hypothesis.key == best.hypothesis.key else c for c in found.candidates]
    known = new + [replace(c, probability=now.pop(c.hypothesis.key, 0.0)) for c in old]
    known.sort(key=lambda c: (c.hypothesis.key != best.hypothesis.key, -c.probability))
    return current, replace(found, candidates=tuple(known))


def best_of_each(ran: Sequence[Candidate]) -> list[Candidate]:
    """The best fit of every name. A body with its load and without keep one each: as good, they may ask for very
    different changes; so do a law and its wider form, of which the former costs more and has fewer parameters."""
    best: dict[tuple, Candidate] = {}
    for c in sorted(ran, key=lambda c: c.fit.cost):
        h = c.hypothesis
        best.setdefault((h.key, h.options.get("with_load", False), "holds" in h.options), c)
    return list(best.values())


def in_reach(ran: Sequence[Candidate]) -> list[Candidate]:
    """The first of the entrants, and those that a few steps have not shown to be far behind the best."""
    best = min((c.fit for c in ran), key=lambda r: r.cost)
    left = max((HOPELESS_RATIO - 1.0) * (best.cost - best.count), (DETECTION_EXCESS - 1.0) * best.count)
    return [c for i, c in enumerate(ran) if i == 0 or c.fit.cost - best.cost <= left]


def same_as_special(problem: Problem, candidate: Candidate, ran: Collection[tuple[str, str]]) -> bool:
    """Whether a candidate is but the special case that it holds, which ran too: a cable that does not rub beside a
    spring."""
    h, model = candidate.hypothesis, candidate.fit.model
    return (h.options.get("absorbs"), h.place) in ran and (
        untold(candidate.fit, model.effects[-1]) or plainly_special(problem, model, model.effects[-1])
    )


def alike(found: Round, winner: Hypothesis) -> list[Effect]:
    """Effects at the joint of a winner that are hard to tell from it, as they were screened: the round may not have
    tried them."""
    twins = {e for pair in ALIKE if winner.effect in pair for e in pair - {winner.effect}}
    starts = [
        (s.hypothesis, s.start)
        for s in found.scores
        if s.hypothesis.effect in twins and s.hypothesis.joint == winner.joint and s.start is not None
    ]
    return [Effect(h, clip_to_bounds(h, start)) for h, start in starts[:1]]


def as_load(current: Fit, own: Effect, others: Sequence[Effect]) -> list[Effect]:
    """The load that would make of the body that carries one what a change of that body has made of it.

    To the data they are one: a linear step beside causes that were missing may have put the load below nothing.
    """
    h, robot = own.hypothesis, current.model.structure.robot
    if not h.options.get("carries_load") or any(e.hypothesis.effect == "payload" for e in others):
        return []
    with_change, without = (m.built[0] for m in (current.model, replace(current.model, effects=tuple(others))))
    p = payload_like(robot.payload_link, without, with_change)
    return [] if p is None else [Effect(payload(robot.payload_link), p)]


def elsewhere(problem: Problem, current: Fit, own: Effect, others: Sequence[Effect]) -> list[Effect]:
    """A ripple as it is screened beside all others: found beside causes that were missing its wave number may be
    another one's."""
    if not own.hypothesis.repeats:
        return []
    without = refit(
        problem, replace(current.model, effects=tuple(others)), current.weights, current.remainders, FIRST_STEPS
    )
    if without is None:
        return []
    preds = predictions(problem, without.model, without.remainders)
    scores = screen(problem, without, preds, [own.hypothesis])
    waves = [x for s in scores for x in (s, *s.near)]
    found = [Effect(own.hypothesis, clip_to_bounds(own.hypothesis, s.start)) for s in waves if s.start is not None]
    return [e for e in found if abs(e.value(RIPPLE) / own.value(RIPPLE) - 1.0) > SAME_PERIOD]


def wider(problem: Problem, current: Fit, effect: Effect) -> list[Effect]:
    """Laws that may hold an effect as a special case, at several shapes: a linear step may not lead there."""
    laws = wider_laws(problem, current, effect.hypothesis)
    if not laws:
        return []
    preds = predictions(problem, current.model, current.remainders)
    scale = signal_scale(problem, preds, effect.hypothesis.joint, ())
    return [Effect(x, clip_to_bounds(x, p)) for x in laws for p in x.options["widens"](effect.p, scale)]


def narrower(problem: Problem, effect: Effect) -> list[Effect]:
    """The law of the catalogue that a wider form of the same name holds: beside what was missing it may do as well."""
    h = effect.hypothesis
    if "narrow" not in h.options:
        return []
    plain = next(
        x
        for x in catalogue(problem.structure, motions_alone=problem.motions_alone)
        if x.key == h.key
        and "holds" not in x.options
        and all(x.options.get(form) == h.options.get(form) for form in ("turns", "yields"))
    )
    return [Effect(plain, clip_to_bounds(plain, h.options["narrow"](effect.p)))]


def wider_laws(problem: Problem, current: Fit, h: Hypothesis) -> list[Hypothesis]:
    """Laws that hold another as a special case, where its shape can be what is missing."""
    laws = forms_to_try(problem, current, h)
    if nearly_settled(problem, current, h):
        laws += [
            x
            for x in catalogue(problem.structure, motions_alone=problem.motions_alone)
            if (x.options.get("absorbs"), x.place) == h.key and "widens" in x.options
        ]
    others = {e.hypothesis.key for e in current.model.effects} - {h.key}
    return [x for x in laws if x.key not in others]


def forms_to_try(problem: Problem, current: Fit, h: Hypothesis) -> list[Hypothesis]:
    """``wider_forms`` where the joint of a law has more than noise left, which no other joint answers for; in motions
    alone, below the modes of the links, of bundles only: a spring with the friction of its joint looks like one.
    """
    if h.joint < 0 or not unsettled_at(current, h.joint):
        return []
    forms = wider_forms(h, leads=not problem.motions_alone)
    return [x for x in forms if x.effect == h.effect == "dress_pack"] if problem.motions_alone else forms


def nearly_settled(problem: Problem, current: Fit, h: Hypothesis) -> bool:
    """Whether a little more than noise is left, as a whole or at the joint of a law, so that its shape can be what is
    missing; or the noise itself is what the law has left."""
    left = problem.noise_left or not settled(current) or (h.joint >= 0 and unsettled_at(current, h.joint))
    return left and current.chi2_per_dof <= FAINT
