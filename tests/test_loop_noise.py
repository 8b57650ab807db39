"""Noise of the position as laws of the gear pass it on: what weights say of it, and what it does to the law itself."""

from dataclasses import replace

import numpy as np
import pytest

from ident.extended import predict
from ident.hypotheses import catalogue
from ident.identification import set_up
from ident.law_noise import loop_noise
from ident.model import Effect, Model, along_record
from ident.problem import output_error
from ident.weights import make_weights

PERIODS = 4
NOISE = 0.025  # of samples of the deflection, over the width of the middle of the law
LAWS = {"backlash": lambda k, d: [0.3 * d, 0.0], "softening_stiffness": lambda k, d: [0.5 * k, 0.5 * d]}


@pytest.fixture(scope="module", params=LAWS)
def noisy(request, clean):
    """(problem, model, groups): a motion and the torque that a law answers it with, recorded with noise many times
    over."""
    problem = set_up(clean[0]).problem
    group, j = next(g for g in problem.groups if g.window is None), 0
    linear = Model(problem.structure, problem.nominal)
    h = next(
        h for h in catalogue(problem.structure) if h.key == (request.param, problem.structure.robot.joint_names[j])
    )
    deflection = group.to_time(predict(linear, group, problem.sampling).solution.delta[..., [j]]).std()
    model = replace(
        linear, effects=(Effect(h, np.array(LAWS[request.param](problem.nominal.stiffness[j], deflection))),)
    )
    truth = predict(model, group, problem.sampling)
    rng, samples = np.random.default_rng(5), problem.samples(group)
    q_std, tau_std = 0.6 * NOISE * deflection, 1e-4 * np.abs(truth.U[:, 1:]).max()
    groups = []
    for _ in range(12):
        draw = rng.normal(size=(4, len(group.U), PERIODS, *group.U.shape[1:])) / np.sqrt(2.0 * samples)
        draw[:, :, :, 0] = 0.0
        Q = group.Q[:, None] + q_std * (draw[0] + 1j * draw[1])
        U = truth.U[:, None] + tau_std * (draw[2] + 1j * draw[3])
        groups.append(replace(group, Q=Q.mean(axis=1), U=U.mean(axis=1), Q_periods=Q, U_periods=U))
    n = problem.structure.n
    return replace(problem, q_std=np.full(n, q_std), tau_std=np.full(n, tau_std)), model, groups


def left_at(problem, model, group):
    """Whitened squares that the noise leaves, by joint, 1 where weights know it."""
    part = replace(problem, groups=(group,))
    pred = predict(model, group, problem.sampling)
    white = make_weights(part, [pred], 0.0).apply(0, output_error(group, pred))[:, 1:]
    return np.mean(np.abs(white) ** 2, axis=(0, 1)) / 2.0


def test_weights_know_what_a_law_makes_of_the_noise(noisy, monkeypatch):
    """At the true model the residual is as large as they say; the mean stiffness of the gear alone says too little."""
    problem, model, groups = noisy
    left = np.mean([left_at(problem, model, g) for g in groups], axis=0)
    assert left == pytest.approx(np.ones(len(left)), abs=0.25)
    monkeypatch.setattr("ident.output_noise.loop_noise", lambda pred, group: None)
    assert np.mean([left_at(problem, model, g) for g in groups], axis=0)[0] > 1.3


def test_a_law_is_shown_the_signal_alone(noisy, monkeypatch):
    """The torque that it answers with is nearer that of the true motion than where it sees all of the noise."""
    problem, model, groups = noisy
    true = next(g for g in problem.groups if g.window is None)
    wanted = predict(model, true, problem.sampling).solution.torques.spring[..., 0]

    def off():
        answers = [predict(model, g, problem.sampling).solution.torques.spring[..., 0] for g in groups]
        return np.linalg.norm(np.mean(answers, axis=0) - wanted)

    shown = off()
    monkeypatch.setattr("ident.reactions.signal_share", lambda X, noise: np.ones(X.shape))
    assert shown < 0.8 * off()


def test_a_gear_within_its_dead_band_says_what_it_can(clean):
    """About a vertical axis nothing holds it there: its mean is free, and so no noise of it."""
    problem = set_up(clean[0]).problem
    group = next(g for g in problem.groups if g.window is None)
    h = next(h for h in catalogue(problem.structure) if h.key == ("backlash", "shoulder_pan_joint"))
    model = Model(problem.structure, problem.nominal, (Effect(h, np.array([0.05, 0.0])),))
    pred = predict(model, group, problem.sampling)
    weights = make_weights(replace(problem, groups=(group,)), [pred], 0.0)
    assert np.all(np.isfinite(pred.U)) and np.all(np.isfinite(weights.whiten[0]))


def test_what_else_is_at_the_joint_makes_no_noise_of_the_law(noisy):
    """A hysteresis that never yields is a spring, and a drive with an effect keeps a law that was taken along the
    record a loop."""
    problem, model, groups = noisy
    named, j = {h.key: h for h in catalogue(problem.structure)}, model.effects[0].hypothesis.joint
    place, k = problem.structure.robot.joint_names[j], problem.nominal.stiffness[j]

    def power(effects):
        pred = predict(replace(model, effects=effects), groups[0], problem.sampling)
        return np.mean(np.abs(loop_noise(pred, groups[0])[1:, j, j]))

    (law,) = model.effects
    constant = Effect(named["torque_constant", place], np.array([0.9]))
    assert power((replace(law, hypothesis=along_record(law.hypothesis)), constant)) == pytest.approx(
        power((law, constant)), rel=1e-6
    )
    spring = Effect(named["hysteresis", place], np.array([1e-3 * k, 1e6, 20.0, 0.0]))
    assert power((law, spring)) == pytest.approx(power((law,)), rel=0.1)
