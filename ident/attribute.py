"""From a discrepancy to causes: detect, score, refit, compare, look again, stop.

Each round screens every hypothesis at every place against the current model, refits the few that
explain most together with the baseline and all causes found before, and weighs them by their
evidence. What is left over at the end decides whether the names can be trusted: decoys for what
the catalogue lacks compete with the names, and a residual far above the noise takes probability
from all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.baseline import DETECTION_EXCESS, FAINT, HOPELESS, discrepancy_p_value, implausible, loud
from ident.contests import forms_to_try, weighed_again
from ident.faint import SEEN, hidden
from ident.follow_up import as_loops, companions, from_other_motions
from ident.hypotheses import Hypothesis, catalogue
from ident.left_out import carries_over, with_error_as_noise
from ident.model import Effect
from ident.pairs import beside_rivals
from ident.parallel import Workers
from ident.problem import Problem
from ident.pruning import plainer, plainly_special, pruned, renamed, untold, without_shadows
from ident.refits import (
    beside_its_error,
    polish,
    reweighted,
    settled,
)
from ident.rounds import (
    MIN_EVIDENCE,
    Round,
    answers,
    attribute_once,
    beside_unclear,
    left_share,
    outdone,
    shadows,
    told_share,
    with_name,
)
from ident.search import worth_a_hinge, worth_a_refit
from ident.torque_fit import Fit

DETECTION_LEVEL = 1e-4  # p-value below which there is a discrepancy
DOUBTED_LEVEL = 1e-2  # the same where the drives that fit cannot be those of this arm
# share of the discrepancy up to which a decoy explains what laws of causes lack, and belies no name
LEFT_TO_DECOYS = 0.03
LEFT_TO_PAIRS = 0.03  # the same, from which two causes are sought at once
# of what causes explain at a joint, left there by errors of a hundredth in their laws: no other is sought loudly
LAWS_LEAVE = 1e-4


@dataclass(frozen=True)
class Attribution:
    """Result: the baseline fit, rounds, and the final fit.

    Attributes:
        detected: whether there is a discrepancy: clear, or one that noise as a whole hides and a cause explains.
        clear: whether the baseline leaves more than noise as a whole or anywhere loudly.
        p_value: of the discrepancy by noise alone.
        unknown: whether something without a name explains what no cause does.
    """

    baseline: Fit
    detected: bool
    clear: bool
    p_value: float
    rounds: tuple[Round, ...]
    final: Fit
    unknown: bool

    @property
    def left_share(self) -> float:
        """Share of the discrepancy (excess over noise) that no cause explains."""
        return left_share(self.baseline, self.final)

    def without_causes(self) -> Attribution:
        """What is left of the result where its causes are refuted: an unknown cause of a clear discrepancy, and
        nothing where they alone had shown one."""
        p_value = discrepancy_p_value(self.baseline)
        return replace(self, detected=self.clear, p_value=p_value, rounds=(), final=self.baseline, unknown=self.clear)

    @property
    def nameless(self) -> Round | None:
        """The last round if a law without a name has won it."""
        best = self.rounds[-1].candidates[0].hypothesis if self.rounds else None
        return self.rounds[-1] if best and best.decoy and not best.options.get("baseline") else None


@dataclass(frozen=True)
class Task:
    """What stays the same throughout a search.

    Attributes:
        problem: records with their own noise.
        clear: whether the baseline leaves more than noise as a whole or anywhere loudly.
        workers: where candidates are fitted.
    """

    problem: Problem
    baseline: Fit
    clear: bool
    workers: Workers


@dataclass(frozen=True)
class Search:
    """A search between two rounds.

    Attributes:
        problem: records, with what is left at joints that were given up as noise there.
        current: the model with all causes so far.
        hypotheses: those that may still be asked.
        p_value: of the discrepancy that was detected.
        rounds: a cause each; those of an effect found at several joints at once are one of ``causes``.
        looped: the last fit of which the laws of the gear were made loops.
        unknown: whether a decoy explains what no cause does.
        over: whether nothing is left to ask.
    """

    problem: Problem
    current: Fit
    hypotheses: tuple[Hypothesis, ...]
    p_value: float
    rounds: tuple[Round, ...] = ()
    causes: int = 0
    looped: Fit | None = None
    unknown: bool = False
    over: bool = False


@dataclass(frozen=True)
class Question:
    """Hypotheses of a round.

    Attributes:
        faint: whether what is left is noise as a whole, and they are asked for what that would hide.
        by_joint: whether torques of joints are told apart, as along measured motions.
        p_value: of the discrepancy that they are asked for.
    """

    hypotheses: tuple[Hypothesis, ...]
    faint: bool
    by_joint: bool
    p_value: float


def attribute(
    problem: Problem,
    baseline: Fit,
    *,
    max_causes: int = 4,
    hypotheses: Sequence[Hypothesis] | None = None,
    known: Attribution | None = None,
    until: Callable[[Fit], bool] | None = None,
    workers: Workers = Workers(),
) -> Attribution:
    """Find the causes of what the baseline does not explain.

    Args:
        max_causes: rounds at most; an effect found at several joints at once is one of them.
        known: causes of the same records that were found beside more noise, from which the search goes on.
        until: whether a model with the causes so far shows that the search must begin anew, beside something else.
        workers: where candidates are fitted.
    """
    if hypotheses is None:
        held = problem.sampling.hold == "zoh"
        hypotheses = catalogue(problem.structure, motions_alone=problem.motions_alone, held=held)
    every = tuple(hypotheses)
    p_value = discrepancy_p_value(baseline)
    level = DOUBTED_LEVEL if implausible(problem, baseline) else DETECTION_LEVEL
    clear = p_value < level and (baseline.chi2_per_dof > DETECTION_EXCESS or bool(np.any(loud(baseline))))
    task = Task(problem, baseline, clear, workers)
    search = Search(problem, baseline, every, p_value)
    if known is not None and known.final.model.effects:
        search = carried_on(search, known, workers)
    while search.causes < max_causes and not search.over and not workers.late:
        search = next_round(task, search)
        if until is not None and until(search.current):
            break
    current, rounds = at_the_end(task, search, every)
    left = {e.hypothesis.key for e in current.model.effects}
    kept = tuple(r for r in rounds if r.candidates[0].hypothesis.decoy or r.candidates[0].hypothesis.key in left)
    unknown = search.unknown or any(outdone(r) and told_share(baseline, r) > LEFT_TO_DECOYS for r in kept)
    return Attribution(
        baseline, clear or bool(kept), clear, search.p_value if kept else p_value, kept, current, unknown
    )


def next_round(task: Task, search: Search) -> Search:
    """The search after one more question: with another cause, at other joints, or over."""
    if settled(search.current) and search.looped is not search.current:
        # Along the record noise is taken large, and hides other causes.
        looped = as_loops(search.problem, search.current, task.workers)
        search = replace(search, current=looped, looped=looped)
    question = next_question(task, search)
    if not question.hypotheses:
        return replace(search, over=True)
    search = replace(search, p_value=question.p_value)
    rounds = answered(task, search, question)
    if rounds:
        return with_cause(task, search, question, rounds)
    if not question.by_joint:
        return replace(search, over=True)
    return elsewhere(search, int(np.argmax(search.current.costs - search.current.counts)))


def next_question(task: Task, search: Search) -> Question:
    """What to ask of what is left: all that may be there still, or what noise as a whole would hide."""
    problem, current = search.problem, search.current
    told = task.baseline.costs - current.costs
    quiet_as_a_whole = settled(less_errors_of_laws(current, told)) and not np.any(loud(current, told))
    if task.clear and not quiet_as_a_whole:
        by_joint = problem.motions_alone and current.chi2_per_dof > FAINT
        return Question(search.hypotheses, False, by_joint, search.p_value)
    if problem is not task.problem or not search.hypotheses:
        return Question((), True, False, search.p_value)
    task.workers.say("what the noise as a whole would hide")
    asked, by_chance = hidden(problem, current, search.hypotheses, told)
    found_before = task.clear or search.rounds or not asked
    return Question(tuple(asked), True, False, search.p_value if found_before else by_chance)


def answered(task: Task, search: Search, question: Question) -> tuple[Round, ...]:
    """The rounds with that which answers a question as the last; none where nothing does."""
    problem, current, workers, faint = search.problem, search.current, task.workers, question.faint
    workers.say(f"cause {search.causes + 1}: screening {len(question.hypotheses)} hypotheses")
    # What is left beside a cause is mostly what its law lacks, and no hinge unless little is left; what is faint
    # shows none everywhere.
    bare = np.inf if search.rounds or faint else worth_a_hinge(current)
    least = 0.0 if faint else worth_a_refit(current)
    quiet = frozenset() if faint else shadows(problem, current, search.rounds)
    asked, left_at = question.hypotheses, np.flatnonzero(current.costs > DETECTION_EXCESS * current.counts)
    if quiet and quiet.issuperset(left_at.tolist()):
        # What the laws of causes lack is no hinge, and there are many of these.
        asked = tuple(h for h in asked if "hinge" not in h.options)
    found = attribute_once(problem, current, asked, workers, least, bare, quiet)
    if not answers(found) and current.chi2_per_dof > HOPELESS and not workers.late:
        found = beside_unclear(problem, current, found, question.hypotheses, workers, bare)
    if answers(found, SEEN if faint else MIN_EVIDENCE):
        return (*search.rounds, found)
    if faint or workers.late or left_share(task.baseline, current) <= LEFT_TO_PAIRS:
        return ()
    pair = beside_rivals(problem, current, search.rounds, search.hypotheses, workers)
    return () if pair is None else (*pair[0], pair[1])


def with_cause(task: Task, search: Search, question: Question, rounds: tuple[Round, ...]) -> Search:
    """The search with one more cause, all others fitted and weighed beside it; at other joints where it does not carry
    over to parts of the motions that are left out.

    Args:
        rounds: that of the cause as the last.
    """
    problem, workers = search.problem, task.workers
    found = with_name(rounds[-1])
    winner = found.candidates[0]
    best = winner.hypothesis
    nameless = best.decoy and not best.options.get("of_record")
    # Beside causes of single joints of a motion it is another one: they are trusted by what is left where they sit.
    nameless = nameless and not (question.by_joint and search.rounds)
    unknown = nameless and left_share(task.baseline, search.current) > LEFT_TO_DECOYS
    after = replace(
        search,
        rounds=(*rounds[:-1], found),
        causes=search.causes + 1,
        unknown=search.unknown or unknown,
    )
    if best.decoy and not best.options.get("baseline"):
        return replace(after, over=True) if not question.by_joint or best.on_chain else elsewhere(after, best.joint)
    current = from_other_motions(problem, polish(problem, winner.fit), workers)
    if (current.chi2_per_dof > FAINT and not best.decoy) or best.options.get("of_record"):
        current, more = companions(problem, current, winner, search.hypotheses)
        after = replace(after, rounds=(*after.rounds, *more))
    effects = current.model.effects
    current = plainer(problem, current, search.hypotheses, set(), after.rounds)
    found_rounds = renamed(after.rounds, effects, current.model.effects)
    taken = {e.hypothesis.key for e in (*effects, *current.model.effects)}
    current = pruned(problem, current)
    if problem.motions_alone and current.chi2_per_dof > FAINT and not best.decoy:
        workers.say("parts of the motions left out")
        joint = int(np.argmax(found.falls))
        if not carries_over(problem, search.current, current, joint, workers):
            rest = tuple(h for h in search.hypotheses if h.key != best.key)
            return elsewhere(replace(search, hypotheses=rest), joint)
    if forms_to_try(problem, current, best):
        # What its plain form lacks would hide what is left, or be taken for another cause.
        current, last = weighed_again(problem, current, found_rounds[-1:], workers)
        found_rounds = [*found_rounds[:-1], *last]
    if len(found_rounds) > 1:
        # What is sought next would make up for a cause that was named wrongly as long as this one was missing.
        current, earlier = weighed_again(problem, current, found_rounds[:-1], workers)
        found_rounds = [*earlier, found_rounds[-1]]
    left = tuple(h for h in untaken(search.hypotheses, current.model.effects) if h.key not in taken)
    return replace(after, current=current, rounds=tuple(found_rounds), hypotheses=left)


def at_the_end(task: Task, search: Search, every: Sequence[Hypothesis]) -> tuple[Fit, list[Round]]:
    """All causes beside each other and the noise of the records: those that the last ones made needless, rivals,
    special cases, and the last fit.

    Args:
        every: hypotheses that were asked at first.
    """
    problem, workers, current, rounds = task.problem, task.workers, search.current, list(search.rounds)
    if search.problem is not problem:
        current = polish(problem, current)
    if search.looped is not current and not workers.late:
        current = as_loops(problem, current, workers)
    current = without_shadows(problem, current, rounds, workers)
    current, rounds = weighed_again(problem, current, rounds, workers)
    effects = current.model.effects
    # What a cause had that sets it apart from its special case may have been what one that was found later does.
    itself = [e for e in effects if not (plainly_special(problem, current.model, e) or untold(current, e))]
    if len(itself) < len(effects) and not workers.late:
        current = plainer(problem, current, every, {e.hypothesis.key for e in itself}, rounds)
        rounds = renamed(rounds, effects, current.model.effects)
    return beside_its_error(problem, current), rounds


def elsewhere(search: Search, joint: int) -> Search:
    """A search of motions that goes on at other joints than one at which what is left follows no law of the catalogue:
    there it counts as noise from then on.

    Along measured motions the torque of one joint tells nothing of that of another.
    """
    left = tuple(h for h in search.hypotheses if h.joint != joint)
    if len(left) == len(search.hypotheses):
        return replace(search, over=True)
    other = with_error_as_noise(search.problem, search.current, joint)
    return replace(search, problem=other, current=polish(other, search.current), hypotheses=left)


def carried_on(search: Search, known: Attribution, workers: Workers) -> Search:
    """A search begun with causes that were found beside other noise, fitted and weighed beside that of its problem."""
    problem = search.problem
    current = polish(problem, known.final)
    there = {e.hypothesis.key for e in current.model.effects}
    rounds = []
    for found in known.rounds:
        if found.candidates[0].hypothesis.key in there:
            seen = tuple(replace(c, fit=reweighted(problem, c.fit, current.weights)) for c in found.candidates)
            rounds.append(replace(found, before=reweighted(problem, found.before, current.weights), candidates=seen))
    current, rounds = weighed_again(problem, current, rounds, workers)
    return replace(
        search,
        current=current,
        rounds=tuple(rounds),
        hypotheses=untaken(search.hypotheses, current.model.effects),
        causes=len({r.candidates[0].hypothesis.effect for r in rounds}),
    )


def untaken(hypotheses: Sequence[Hypothesis], effects: Sequence[Effect]) -> tuple[Hypothesis, ...]:
    """Hypotheses that may be sought beside effects: a special case of what is there already would only share its size
    with it."""
    taken: set[tuple[str | None, str]] = {e.hypothesis.key for e in effects}
    taken |= {(e.hypothesis.options.get("absorbs"), e.hypothesis.place) for e in effects}
    loaded = any(effect == "payload" for effect, _ in taken)
    return tuple(h for h in hypotheses if h.key not in taken and not (loaded and h.options.get("carries_load")))


def less_errors_of_laws(current: Fit, told: np.ndarray) -> Fit:
    """A fit as if it left no more than noise at joints where that may be errors of the laws of causes there.

    Args:
        told: (n,) fall of the cost by joint that causes have brought.
    """
    own = [e.hypothesis.joint for e in current.model.effects if not e.hypothesis.on_chain]
    laws = np.zeros(len(told))
    laws[own] = LAWS_LEAVE * np.maximum(told[own], 0.0)
    return replace(
        current,
        costs=np.where(current.costs - current.counts < laws, np.minimum(current.costs, current.counts), current.costs),
    )
