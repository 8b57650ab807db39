"""Fitted coordinates of a model: drives as logarithms, timing, effects as their hypotheses say; their names, prior and
steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.graybox import parameter_names
from ident.model import Effect, Model, is_along_record
from ident.problem import Problem

PRIOR_LOG_STD = 1.5  # of a baseline parameter about its starting guess, natural logarithm
PRIOR_TIMING = 0.25  # of the common timing offset, samples
TIMING_LIMIT = 0.6  # samples
SHIFTS = "spring", "link", "position"  # channels of effects that move the arm to another posture


def coordinate_names(model: Model) -> tuple[str, ...]:
    """Names of the fitted coordinates: baseline, timing, effects."""
    names = [*parameter_names(model.structure.robot), "timing"]
    for effect in model.effects:
        h = effect.hypothesis
        names += [h.coordinate(p.name) for p in h.parameters]
    return tuple(names)


def pack(model: Model) -> np.ndarray:
    """Fitted coordinates of a model."""
    parts = [model.par.to_log(), [model.par.timing]]
    for effect in model.effects:
        parts.append([q.to_internal(v) for q, v in zip(effect.hypothesis.parameters, effect.p, strict=True)])
    return np.concatenate([np.asarray(p, float) for p in parts])


def unpack(model: Model, x: np.ndarray, limit: float) -> Model:
    """The model at fitted coordinates ``x``."""
    m = len(model.par.to_log())
    par = replace(model.par.with_log(np.clip(x[:m], -40, 60)), timing=float(np.clip(x[m], -limit, limit)))
    effects, at = [], m + 1
    for effect in model.effects:
        ps = effect.hypothesis.parameters
        values = np.array([q.to_external(v) for q, v in zip(ps, x[at : at + len(ps)], strict=True)])
        effects.append(Effect(effect.hypothesis, values))
        at += len(ps)
    return Model(model.structure, par, tuple(effects))


def stepped(problem: Problem, model: Model, step: np.ndarray) -> Model:
    """The model after a step (p,) of its fitted coordinates, no longer than one of a fit."""
    m = len(model.par.to_log())
    step = np.concatenate([np.clip(step[:m], -1.0, 1.0), step[m : m + 1], clip_effects(model, step[m + 1 :])])
    return unpack(model, pack(model) + step, TIMING_LIMIT * problem.sampling.sample_time)


def shifts_posture(model: Model) -> bool:
    """Whether effects move the arm to another posture; along the record that says what the gear carries."""
    return any(e.hypothesis.channel in SHIFTS and not is_along_record(e.hypothesis) for e in model.effects)


def moves_geometry(effect: Effect, motion: bool) -> bool:
    """Whether an effect changes the geometric remainder to first order: a change of the arm, and along a motion an
    error of the position
    or a law of a gear, which shift gravity and inertia with them."""
    return effect.hypothesis.channel == "model" or (motion and effect.hypothesis.channel in ("position", "spring"))


def moves_links(model: Model) -> np.ndarray:
    """Which fitted coordinates change the motion of the links along given motor motion."""
    n, n_e = model.structure.n, len(model.structure.elastic)
    parts = [np.ones(2 * n, bool), np.zeros(2 * n, bool), np.ones(2 * n_e, bool), np.zeros(1, bool)]
    for effect in model.effects:
        inside = effect.hypothesis.channel not in ("motor", "drive")
        parts.append(np.full(len(effect.p), inside))
    return np.concatenate(parts)


def prior_of(problem: Problem, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Centre and weight (inverse variance) of the weak prior of each fitted coordinate."""
    ps = [q for effect in model.effects for q in effect.hypothesis.parameters]
    baseline = problem.nominal.to_log()
    centers = [
        q.prior_center(problem.nominal.stiffness[effect.hypothesis.joint])
        for effect in model.effects
        for q in effect.hypothesis.parameters
    ]
    center = np.concatenate([baseline, [0.0], centers])
    timing = (PRIOR_TIMING * problem.sampling.sample_time) ** -2
    return center, np.concatenate([np.full(len(baseline), PRIOR_LOG_STD**-2), [timing], [q.spread**-2 for q in ps]])


def clip_effects(model: Model, step: np.ndarray) -> np.ndarray:
    """Logarithmic coordinates move by at most a factor e^1.5 in a step."""
    log = np.array([q.log for e in model.effects for q in e.hypothesis.parameters], bool)
    return np.where(log, np.clip(step, -1.5, 1.5), step) if len(step) else step
