"""Two causes at once, where the one that explains most alone is neither of them.

Two causes at one joint can be far better than any alone, and one that is wrong the best of those alone: a motor that
delivers less than is recorded makes a bristle look like dry friction that is larger one way than the other. Rivals are
therefore tried beside a second cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ident.hypotheses import Hypothesis
from ident.parallel import Workers
from ident.problem import Problem, predictions
from ident.refits import FINALISTS, refit, reweighted
from ident.rounds import Round, weighed_round
from ident.screening import Score, screen
from ident.search import begin, best_named
from ident.torque_fit import Fit

SECONDS = 2  # causes that are tried beside each rival
# of the excess over noise that the cause named last leaves: what a linear step may leave for a pair to be tried, and
# what the pair may leave at most
PROMISED, PAIR_LEAVES = 0.5, 0.1


def beside_rivals(
    problem: Problem, current: Fit, rounds: Sequence[Round], hypotheses: Sequence[Hypothesis], workers: Workers
) -> tuple[list[Round], Round] | None:
    """The rounds with a rival of the cause that was named last in its place, and one in which a second cause at its
    joint explains nearly all that is left beside it; None where there are none such.

    Args:
        current: the model with the cause that was named last, beside which nothing answers.
        hypotheses: that may be beside that model.
    """
    if not rounds:
        return None
    last = rounds[-1]
    winner = last.candidates[0].hypothesis
    named = [
        (c.hypothesis, c) for c in last.candidates[1:] if not c.hypothesis.decoy and c.hypothesis.key != winner.key
    ]
    rivals = [c for _, c in best_named(named, FINALISTS, 0)]
    excess = current.cost - current.count
    allowed = PAIR_LEAVES * excess

    def seconds(stage: Fit) -> list[Score]:
        taken = {e.hypothesis.key for e in stage.model.effects}
        free = [h for h in hypotheses if h.joint == winner.joint and not h.decoy and h.key not in taken]
        scores = screen(problem, stage, predictions(problem, stage.model, stage.remainders), free)
        hopeful = [s for s in scores if stage.cost - s.gain - current.count <= PROMISED * excess]
        return [s for s in hopeful if s.start is not None][:SECONDS]

    def paired(of: tuple[Fit, Score]) -> Fit | None:
        stage, score = of
        model, _ = begin(problem, stage, score)
        return refit(problem, model, current.weights, stage.remainders, aim=current.count + allowed)

    stages = workers.map(lambda c: reweighted(problem, c.fit, current.weights), rivals)
    scores = workers.map(seconds, stages)
    pairs = [(i, s) for i, some in enumerate(scores) for s in some]
    fits = workers.map_in_time(
        paired,
        [(stages[i], s) for i, s in pairs],
        lambda of: (
            f"pair: {of[0].model.effects[-1].hypothesis.effect} and {of[1].hypothesis.effect} at {of[1].hypothesis.place}"
        ),
    )
    found = [(r.cost, i, s, r) for (i, s), r in zip(pairs, fits, strict=True) if r is not None]
    cost, best, _, _ = min(found, key=lambda x: x[0], default=(float("inf"), 0, None, None))
    if cost - current.count > allowed:
        return None
    ranked = sorted(((s.hypothesis, r) for _, i, s, r in found if i == best), key=lambda x: x[1].cost)
    rival = rivals[best]
    renamed = replace(last, candidates=(rival, *(c for c in last.candidates if c is not rival)))
    return [*rounds[:-1], renamed], weighed_round(stages[best], ranked, scores[best], {})
