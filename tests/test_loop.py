"""Laws in steady state with the arm that they move."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.extended import predict
from ident.hypotheses import catalogue, kernels, wider_forms
from ident.hypotheses.loop import modal_state, steady_loop
from ident.hypotheses.yielding import along_path, elastoplastic, onward
from ident.model import Effect
from tests.conftest import over_steps

PERIOD, POINTS = 2.0, 12000  # s, of the grid
M, D, K = np.array([[1.0, 0.2], [0.2, 0.5]]), np.diag([1.5, 0.8]), np.array([[4e3, -5e2], [-5e2, 2e3]])
LAWS = {
    "cubic": kernels.Law(kernels.CUBIC, 4e8, 0.0, 4e3),
    "softening": kernels.Law(kernels.SOFTENING, 2.5e3, 1e-3, 4e3),
    "backlash": kernels.Law(kernels.BACKLASH, 6e-4, 0.0, 2e3),
    "loose backlash": kernels.Law(kernels.BACKLASH, 6e-4, 0.8, 2e3),
    "hysteresis": kernels.Law(kernels.HYSTERESIS, 1e3, 0.5, 4e3),
    "rounded hysteresis": kernels.Law(kernels.HYSTERESIS, 1e3, 0.5, 4e3, 2.0, 0.3),
    "cable": kernels.Law(kernels.LINK, 300.0, 0.8, 0.01),
    "cable that leads": kernels.Law(kernels.LINK, 300.0, 0.8, 0.02, lead=2e-3),
    "cable that yields": kernels.Law(kernels.CABLE, 300.0, 0.8, 900.0),
}
MODES = kernels.modal_compliance(M, D, K, 0, PERIOD / POINTS)
OMEGA = 2 * np.pi * np.arange(POINTS // 2 + 1) / PERIOD


def spectrum(x):
    return np.fft.rfft(x, axis=-1) / POINTS


def in_time(X):
    return np.fft.irfft(X * POINTS, POINTS, axis=-1)


def compliance():
    s = 1j * OMEGA[:, None, None]
    return np.linalg.inv(s**2 * M + s * D + K)[:, 0, 0]


def free_motion(records=3, lines=25, size=2e-3, seed=0):
    rng = np.random.default_rng(seed)
    X = np.zeros((records, len(OMEGA)), complex)
    X[:, 1 : lines + 1] = rng.normal(size=(records, lines, 2)) @ [1.0, 1.0j]
    x = in_time(X)
    return spectrum(size * x / np.abs(x).max(axis=1, keepdims=True))


def loop(law, X, guess=None):
    return steady_loop(law, in_time(X), in_time(1j * OMEGA * X), MODES, guess, step=PERIOD / POINTS).torque


def rate_of(law, X):
    """What the torque of a law turns with, rad/s."""
    return in_time(1j * OMEGA * X * (1.0 + 1j * OMEGA * law.lead))


def law_along(law, x, v):
    code, a, b, k, exponent, recoil = law.shape
    if code == kernels.LINK:
        return a * x + b * np.tanh(v / k)
    if code == kernels.CABLE:
        return a * x + elastoplastic(x, k, b)
    if code == kernels.CUBIC:
        return a * x**3
    if code == kernels.SOFTENING:
        return (a - k) * np.clip(x, -b, b)
    if code == kernels.BACKLASH:
        # The flanks carry what the gear has beyond the dead band, and do not pull.
        contact = np.where(np.abs(x) > 0.5 * a, k * (np.abs(x) - 0.5 * a) + b * v * np.sign(x), 0.0)
        return np.maximum(contact, 0.0) * np.sign(x) - k * x - b * v
    return along_path(x - np.roll(x, 1, axis=1), a, b, exponent, recoil)


def test_a_linear_law_is_solved_as_linear_algebra_does():
    X = free_motion()
    expected = 300.0 * X / (1.0 + 300.0 * compliance())
    found = spectrum(loop(kernels.Law(kernels.LINK, 300.0, 0.0, 0.01), X))
    assert found == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("name", LAWS)
def test_the_torque_is_that_of_the_law_where_it_moves_the_arm(name):
    X = free_motion()
    h = loop(LAWS[name], X)
    H = spectrum(h)
    there = X - compliance() * H
    expected = law_along(LAWS[name], in_time(there), rate_of(LAWS[name], there))
    assert np.std(h - expected) < 5e-3 * np.std(expected)
    assert np.std(in_time(compliance() * H)) > 0.03 * np.std(in_time(X))  # the law does move the arm


@pytest.mark.parametrize("name", LAWS)
def test_a_law_along_a_motion_is_the_law_and_its_mean_slope_what_a_small_step_does(name):
    law, X = LAWS[name], free_motion()
    x, v, step = in_time(X), in_time(1j * OMEGA * X), 1e-7
    h = kernels.along_motion(law, x, v)
    if law.code in (kernels.BACKLASH, kernels.SOFTENING):
        assert h == pytest.approx(over_steps(lambda x: law_along(law, x, v), x), abs=1e-3 * np.abs(h).max())
        _, half = kernels.middle_of(law.code, law.a, law.b, law.k)
        near = np.abs(np.diff(x, axis=1, append=x[:, :1])).max() + law.b * np.abs(v) / law.k * (
            law.code == kernels.BACKLASH
        )
        alone = np.abs(np.abs(x) - half) > near  # steps without a kink
        assert 0.1 < alone.mean() < 1.0
        assert h[alone] == pytest.approx(law_along(law, x, v)[alone], abs=1e-9 * np.abs(h).max())
    else:
        assert h == pytest.approx(law_along(law, x, v), abs=1e-9 * np.abs(h).max())
    slope = kernels.mean_slope(law, x)
    if law.code in (kernels.HYSTERESIS, kernels.CABLE):  # of what yields: the line nearest to its loops
        moving = x - x.mean(axis=1, keepdims=True)
        left = h - slope[:, None] * moving
        assert np.mean(left * moving, axis=1) == pytest.approx(0.0, abs=1e-9 * np.mean(np.abs(h * moving)))
    else:
        standing = np.zeros_like(v)  # a damper does not see where it is
        change = kernels.along_motion(law, x + step, standing) - kernels.along_motion(law, x - step, standing)
        assert slope == pytest.approx(np.mean(change, axis=1) / (2 * step), rel=0.01)


@pytest.mark.parametrize("name", LAWS)
def test_where_a_loop_begins_does_not_matter(name):
    X = free_motion()
    cold = loop(LAWS[name], X)
    near = modal_state(spectrum(1.1 * cold), OMEGA, PERIOD / POINTS, MODES)
    assert loop(LAWS[name], X, near) == pytest.approx(cold, abs=2e-4 * np.abs(cold).max())


@pytest.mark.parametrize("name", LAWS)
def test_a_loop_goes_on_from_a_steady_state_near_by(name, monkeypatch):
    """Where nothing has changed a single period says so; where the motion has, it ends where it does from rest."""
    law, X = LAWS[name], free_motion()
    periods = []
    monkeypatch.setattr("ident.hypotheses.loop.loop_sweep", lambda *a: periods.append(1) or kernels.loop_sweep(*a))
    first, other = ((in_time(size * X), in_time(1j * OMEGA * size * X), MODES) for size in (1.0, 1.001))
    step = PERIOD / POINTS
    steady = steady_loop(law, *first, step=step)
    from_rest = len(periods)
    again = steady_loop(law, *first, near=steady, step=step)
    assert len(periods) == from_rest + 1
    assert again.torque == pytest.approx(steady.torque, abs=2e-7 * np.abs(steady.torque).max())
    moved, expected = (steady_loop(law, *other, near=near, step=step).torque for near in (steady, None))
    assert moved == pytest.approx(expected, abs=2e-4 * np.abs(expected).max())
    assert np.abs(expected - steady.torque).max() > 5e-4 * np.abs(expected).max()


def test_an_element_that_hardly_yields_is_followed_to_where_it_creeps(monkeypatch):
    """The mean of its torque moves a little in each period, for hundreds of them where it is only run on."""
    X = free_motion(6)
    law = kernels.Law(kernels.HYSTERESIS, 1e3, 2.0, 4e3, 10.0)
    found = loop(law, X)
    monkeypatch.setattr("ident.hypotheses.loop.SWEEPS", 500)
    assert found == pytest.approx(loop(law, X), abs=1e-6 * np.abs(found).max())


@pytest.mark.parametrize("name", ["hysteresis", "rounded hysteresis", "cable that yields"])
@pytest.mark.parametrize("start", [0.0, 0.9, -0.6])
def test_what_yields_begins_a_motion_where_it_is_told_to(name, start):
    """Over what was recorded it follows its law from there; the return leads it back, which swings the arm no more than
    the law does."""
    law = LAWS[name]._replace(start=start)
    X, recorded = free_motion(lines=6), 0.8
    h = steady_loop(law, in_time(X), in_time(1j * OMEGA * X), MODES, returns=recorded).torque
    x = in_time(X - compliance() * spectrum(h))
    _, a, b, k, exponent, recoil = law.shape
    spring, stiffness = (a, k) if law.code == kernels.CABLE else (0.0, a)
    expected = spring * x + onward(
        np.diff(x, axis=1, prepend=x[:, -1:]), stiffness, b, exponent, recoil, np.full(len(x), start * b)
    )
    last = int(recorded * POINTS)
    assert np.std((h - expected)[:, :last]) < 5e-3 * np.std(expected)
    assert (h - spring * x)[:, -1] == pytest.approx(start * b, abs=1e-3 * b)
    assert np.abs(np.diff(h, axis=1)).max() < 0.02 * np.ptp(h)


def test_records_do_not_see_each_other():
    X = free_motion(4)
    together = loop(LAWS["cable"], X)
    for i in range(4):
        assert loop(LAWS["cable"], X[i : i + 1])[0] == pytest.approx(together[i], abs=1e-4)


def test_modes_return_to_the_state_that_a_torque_repeats():
    h = in_time(free_motion(2, lines=400, size=1.0))
    _, decay, old, new = (m[:, None] for m in MODES)
    start = z = modal_state(spectrum(h), OMEGA, PERIOD / POINTS, MODES)
    for t in range(POINTS):
        z = decay * z + old * h[:, t - 1] + new * h[:, t]
    assert z == pytest.approx(start, abs=1e-9 * np.abs(start).max())


@given(
    st.floats(0, 1e3),
    st.floats(0, 50),
    st.floats(1e-6, 1),
    st.floats(-1, 1),
    st.floats(-3, 3),
    st.floats(0, 1e-3),
    st.floats(0, 1.0),
)
@settings(max_examples=300, deadline=None)
def test_torque_of_a_cable_at_a_point(stiffness, friction, turn, q, v, dq, dv):
    h = kernels.link_point(stiffness, friction, turn, q, v, dq, dv)
    slope = 1.0 + stiffness * dq + friction * dv / turn  # of the equation in h, at most
    miss = h - stiffness * (q - dq * h) - friction * np.tanh((v - dv * h) / turn)
    assert abs(miss) <= 1e-7 * (abs(h) + friction) * slope + 1e-300


@pytest.mark.parametrize("turned", [False, True])
def test_loops_go_on_from_the_steady_states_of_their_own_laws(identified, monkeypatch, turned):
    """In whatever order a model has them."""
    _, setup, result = identified
    named = {h.key: h for h in catalogue(setup.problem.structure)}
    soft, cable = named["softening_stiffness", "elbow_joint"], named["dress_pack", "wrist_2_joint"]
    sizes = {"low_stiffness": 0.6 * result.model.par.stiffness[2], "transition": 1e-4, "stiffness": 20.0}
    effects = tuple(
        Effect(h, np.array([sizes.get(q.name, 0.0 if q.lower <= 0.0 else 0.1) for q in h.parameters]))
        for h in (soft, cable)
    )
    model, group = replace(result.model, effects=effects), setup.problem.groups[0]
    begun: list = []

    def spied(law, *args, near=None, **kwargs):
        begun.append((law.code, near))
        return steady_loop(law, *args, near=near, **kwargs)

    monkeypatch.setattr("ident.reactions.steady_loop", spied)
    first = predict(model, group, setup.problem.sampling)
    made = first.solution.torques.steady
    assert set(made) == {soft.key, cable.key} and begun[0][1] is None
    begun.clear()
    other = replace(model, effects=effects[::-1] if turned else effects)
    again = predict(other, group, setup.problem.sampling, W=first.solution.W, torques=first.solution.torques)
    own = {True: soft.key, False: cable.key}
    assert all(near is made[own[code == kernels.SOFTENING]] for code, near in begun[:2])
    assert np.abs(again.U - first.U).max() < 1e-5 * np.abs(first.U).max()


def test_a_cable_that_hangs_elsewhere_is_a_spring_with_rest_there_where_it_does_not_rub(identified):
    _, setup, result = identified
    at_elbow = [h for h in catalogue(setup.problem.structure) if h.place == "elbow_joint"]
    spring = [h for h in at_elbow if h.effect == "gravity_spring"][-1]
    *_, cable = wider_forms(spring)
    smooth = {"stiffness": 20.0, "rest_angle": 0.4, "friction": 1e-9, "smoothing_velocity": 1e-2}
    group, effects = setup.problem.groups[0], (spring, cable)
    effects = [Effect(h, np.array([smooth.get(q.name, 0.0) for q in h.parameters])) for h in effects]
    models = [result.model, *(replace(result.model, effects=(e,)) for e in effects)]
    bare, first, other = (predict(m, group, setup.problem.sampling).U for m in models)
    assert np.abs(other - first).max() < 1e-6 * np.abs(first - bare).max()
