"""Other bodies and an elastic base sought together with the drives, where these have ended at what cannot be theirs.

A large change of the chain moves all resonances: least squares turn drives to where no linear step leads back, and what
the logarithms of the spectra tell of the drives alone is as wrong. With the change they have a valley again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.hypotheses import Hypothesis
from ident.log_spectra import looked_at, valley
from ident.model import Effect, Model
from ident.parallel import Workers
from ident.problem import NOT_COMPUTED, Problem
from ident.torque_fit import Fit, anneal

SOUGHT = "base_elasticity", "payload", "link_inertia"
PLACES = 0.425, 0.13  # resonances over the highest line, from which hinges are sought: in the band, and below
RATIO = 0.05  # of damping there
LIGHT = 0.03  # of the mass of the arm, that a payload is begun at
TELLS = 0.7  # mean cost of logarithms over that without a change, up to which a change is fitted
MOST = 3  # that are fitted


def sought_afresh(
    problem: Problem, current: Fit, hypotheses: Sequence[Hypothesis], workers: Workers
) -> list[tuple[Hypothesis, Fit]]:
    """Changes of the chain whose logarithms agree clearly better than those of drives alone, fitted with the drives from
    there."""
    spectra = looked_at(problem)
    if not spectra:
        return []
    effects = current.model.effects
    bare = Model(problem.structure, problem.nominal, effects)
    begun = [
        (h, replace(bare, effects=(*effects, Effect(h, p))))
        for h in hypotheses
        if h.effect in SOUGHT and not h.decoy
        for p in starts(problem, h)
    ]
    found = workers.map_in_time(
        lambda x: valley(problem, spectra, x[1]), begun, lambda x: f"afresh: {x[0].effect} at {x[0].place}"
    )
    best: dict[int, tuple[float, Hypothesis, Model]] = {}
    for (h, _), result in zip(begun, found, strict=True):
        if result is not None and (id(h) not in best or result[1] < best[id(h)][0]):
            best[id(h)] = result[1], h, result[0]
    drives_alone = valley(problem, spectra, replace(bare, effects=()))[1]
    chosen = sorted((x for x in best.values() if x[0] < TELLS * drives_alone), key=lambda x: x[0])[:MOST]

    def fitted(x: tuple[float, Hypothesis, Model]) -> Fit | None:
        near = replace(problem, nominal=x[2].par)  # where the drives are held at first
        try:
            return anneal(near, x[2], progress=workers.until_late)
        except NOT_COMPUTED:
            return None

    fits = workers.map_in_time(fitted, chosen, lambda x: f"from there: {x[1].effect} at {x[1].place}")
    return [(h, r) for (_, h, _), r in zip(chosen, fits, strict=True) if r is not None]


def starts(problem: Problem, h: Hypothesis) -> list[np.ndarray]:
    """Parameters from which a change of the chain is sought: a hinge with its resonance in the band and below, a body as
    described, a light payload."""
    group = problem.groups[0]
    if "hinge" in h.options:
        highest = float(group.omega[group.n_compared - 1])
        return [h.options["hinge"](problem.structure, group, share * highest, RATIO) for share in PLACES]
    nulls = [q.null for q in h.parameters]
    if None not in nulls:
        return [np.array(nulls, float)]
    mass = LIGHT * sum(body.mass for body in problem.structure.model.inertias)
    return [h.options["start"](np.array([mass, 0.0, 0.0, 0.0]))]
