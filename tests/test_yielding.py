"""Elements that yield, against the differential equation, closed forms and each other."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.extended import predict
from ident.hypotheses import catalogue
from ident.hypotheses.friction import presliding_friction
from ident.hypotheses.slips import parallel_slips, slipping_friction
from ident.hypotheses.yielding import (
    SLIP,
    along_path,
    bristle,
    dipping_bristle,
    elastoplastic,
    yielded,
    yielding_point,
)
from ident.identification import set_up
from ident.model import Effect, Model
from sim import parse_effect
from tests.conftest import quick_experiment, small_plan, through_files

STIFFNESS, LIMIT = 80.0, 0.2
EXPONENTS = [(1.0, 0.0), (1.0, 1.0), (2.0, 0.5), (4.0, 1.2), (12.0, 0.0)]
AMPLITUDES = 0.6 * LIMIT / STIFFNESS * np.array([4.0, 0.0, 1.5, 0.0, 0.8])


def path(t):
    """Of period 1, and its rate."""
    phases = 2 * np.pi * np.arange(1, 6)[:, None] * t + np.arange(5)[:, None]
    return AMPLITUDES @ np.sin(phases), AMPLITUDES * 2 * np.pi * np.arange(1, 6) @ np.cos(phases)


def along(points, exponent, recoil):
    x, _ = path(np.arange(points) / points)
    return along_path((x - np.roll(x, 1))[None], STIFFNESS, LIMIT, exponent, recoil)[0]


@pytest.mark.parametrize(("exponent", "recoil"), EXPONENTS)
def test_it_follows_the_differential_equation(exponent, recoil):
    def rate(t, h):
        v = path(np.array([t]))[1][0]
        share = min(abs(h[0]) / LIMIT, 1.0) ** exponent
        return [STIFFNESS * v * (1.0 - share if v * h[0] > 0 else 1.0 + recoil * share)]

    t = np.arange(4000) / 4000
    expected = scipy.integrate.solve_ivp(rate, (-1.0, 1.0), [0.0], t_eval=t, rtol=1e-8, atol=1e-9, max_step=2e-3).y[0]
    assert along(4000, exponent, recoil) == pytest.approx(expected, abs=2e-4 * LIMIT)


@pytest.mark.parametrize(("exponent", "recoil"), EXPONENTS)
def test_the_step_is_of_second_order(exponent, recoil):
    fine = along(32000, exponent, recoil)
    errors = [np.std(along(n, exponent, recoil) - fine[:: 32000 // n]) for n in (500, 1000, 2000)]
    assert errors[0] / errors[2] > 8.0  # 16 but for the kinks where the path turns


def test_a_bristle_is_exact_over_steps_of_constant_velocity():
    """Dahl's closed form ``z = 1 - (1 + end) exp(-s)`` along a flank of a saw tooth (Dahl 1968), however long the
    steps."""
    length, speed, flank = 1e-3, 0.05, 5e-3
    for points in (8, 400):
        dt = flank / speed / points
        z = bristle(np.repeat([speed, -speed], points + 1)[None], dt, length)[0]
        end = np.tanh(0.5 * flank / length)  # of the loop that closes, from which the flank turns
        s = np.arange(points + 1) * speed * dt / length
        assert z[: points + 1] == pytest.approx(1.0 - (1.0 + end) * np.exp(-s), abs=0.1 / points)
        assert z[points] == pytest.approx(end, abs=1e-3)


def test_a_sharp_element_is_a_maxwell_slip():
    x, _ = path(np.arange(2000) / 2000)
    slip = elastoplastic(x[None], STIFFNESS, LIMIT)[0]
    assert along(2000, SLIP, 0.7) == pytest.approx(slip)
    assert along(2000, 0.99 * SLIP, 0.0) == pytest.approx(slip, abs=0.05 * LIMIT)
    held = np.clip(STIFFNESS * 1e-3 + np.zeros(1), -LIMIT, LIMIT)
    assert yielded(STIFFNESS, LIMIT, SLIP, 0.0, 0.0, 1e-3)[0] == pytest.approx(held[0])


@given(st.floats(0.5, 60.0), st.floats(0.0, 1.5), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))
@settings(max_examples=500, deadline=None)
def test_a_step_stays_within_the_limit_and_never_turns_against_its_path(exponent, recoil, start, step):
    h, dx = start * LIMIT, step * LIMIT / STIFFNESS
    new, slope = yielded(STIFFNESS, LIMIT, exponent, recoil, h, dx)
    assert abs(new) <= LIMIT * (1 + 1e-12) and slope >= 0.0
    assert (new - h) * np.sign(dx) >= -1e-12 * LIMIT
    further, _ = yielded(STIFFNESS, LIMIT, exponent, recoil, h, 1.1 * dx)
    assert (further - new) * np.sign(dx) >= -1e-9 * LIMIT


@given(
    st.floats(0.5, 60.0),
    st.floats(0.0, 1.5),
    st.floats(-1.0, 1.0),
    st.floats(-3.0, 3.0),
    st.floats(0.0, 0.5),
    st.floats(-2.0, 2.0),
)
@settings(max_examples=500, deadline=None)
def test_the_step_of_a_loop_solves_its_equation(exponent, recoil, start, free, give, near):
    """``dx + direct h(dx) = free`` with a compliance ``direct`` within a step of up to half of that of the element."""
    at = LIMIT / STIFFNESS
    dx, h = yielding_point(STIFFNESS, LIMIT, exponent, recoil, start * LIMIT, free * at, give / STIFFNESS, near * at)
    assert h == pytest.approx(yielded(STIFFNESS, LIMIT, exponent, recoil, start * LIMIT, dx)[0], abs=1e-4 * LIMIT)
    assert dx + give / STIFFNESS * h == pytest.approx(free * at, abs=1e-4 * at)


def test_a_bristle_goes_on_from_where_it_is_told():
    v = np.random.default_rng(2).normal(size=(2, 400))
    whole = bristle(v, 1e-3, 5e-3, start=np.array([0.7, -0.2]))
    assert whole[:, 0] == pytest.approx([0.7, -0.2])
    later = bristle(v[:, 150:], 1e-3, 5e-3, start=whole[:, 150])
    assert later == pytest.approx(whole[:, 150:], abs=1e-12)


def test_presliding_friction_is_the_lugre_law():
    """Bristle, its damping in bending, along a period of velocity: against its differential equation."""
    stiffness, coulomb, relaxation, T = 215.0, 0.58, 0.018, 2000

    def velocity(t):
        return 0.1 * np.sin(2 * np.pi * t) + 0.04 * np.cos(6 * np.pi * t)

    def rate(t, z):
        v = velocity(t)
        return v - stiffness * abs(v) / coulomb * z

    t = np.arange(T) / T
    found = scipy.integrate.solve_ivp(rate, (0.0, 2.0), [0.0], t_eval=1.0 + t, rtol=1e-10, atol=1e-13)
    expected = stiffness * (found.y[0] + relaxation * rate(t, found.y[0]))
    (law,) = presliding_friction(0, "axis").law(
        np.array([stiffness, coulomb, 1.0, relaxation]),
        SimpleNamespace(v=lambda j: velocity(t)[None], time_step=1.0 / T, group=SimpleNamespace(window=None)),
        0,
        1e4,
    )
    assert law == pytest.approx(expected, abs=2e-3 * coulomb)
    assert np.abs(law - stiffness * found.y[0]).max() > 0.2 * coulomb


@pytest.mark.slow
def test_the_record_says_what_friction_holds_where_a_motion_begins(ur10, tmp_path):
    """The motion that closes a recording was not made, and leaves nothing in the bristles."""
    hidden = parse_effect("presliding_friction@elbow_joint:stiffness=2000,coulomb=8", ur10)
    plan = small_plan(ur10, 3, points=1, levels=(1.0,), trajectory=True)
    setup = set_up(through_files(quick_experiment(plan, [hidden], seed=3), tmp_path))
    problem = setup.problem
    (group,) = (g for g in (*problem.groups, *setup.held_out) if g.window is not None)
    law = next(h for h in catalogue(problem.structure) if h.key == ("presliding_friction", "elbow_joint"))
    truth = Effect(law, np.array([2000.0, 8.0, 1.0, 0.0]))
    pred = predict(Model(problem.structure, problem.nominal, (truth,)), group, problem.sampling)
    left = np.abs(group.to_time(group.U - pred.U)[0, :, 2])[group.window > 0.99]
    second = round(1.0 / group.period_time * group.n_time)
    assert np.sqrt(np.mean(left[:second] ** 2)) < 0.02 * 8.0


def test_a_bristle_whose_limit_falls_with_speed_is_that_of_lugre():
    """Against the differential equation ``h' = k (v - |v| h / g(v))``, solved with small steps of another method."""
    stiffness, dt = 800.0, 1e-3
    t = np.arange(0.0, 2.0, dt)

    def velocity(t):
        return 0.04 * np.sin(np.pi * t) + 0.03 * np.sin(3.0 * np.pi * t + 1.0)

    def limit(v):
        return 0.6 + 0.7 * np.exp(-((v / 0.03) ** 2))

    def rate(t, h):
        return stiffness * (velocity(t) - np.abs(velocity(t)) * h / limit(velocity(t)))

    exact = scipy.integrate.solve_ivp(rate, (0.0, 4.0), [0.0], t_eval=2.0 + t, rtol=1e-9, atol=1e-10, method="LSODA")
    found = dipping_bristle(velocity(t)[None], dt, stiffness, limit(velocity(t))[None])[0]
    assert found == pytest.approx(exact.y[0], abs=2e-3)
    fast = np.abs(velocity(t)) > 0.9 * np.max(np.abs(velocity(t)))
    assert np.max(np.abs(found)) > 1.2 * np.max(np.abs(found[fast]))  # it falls, and late


@pytest.mark.parametrize("spread", [0.05, 0.7, 2.0])
def test_slips_in_parallel_add_up_to_one_element(spread):
    each, limits = parallel_slips(STIFFNESS, LIMIT, spread)
    assert each * len(limits) == pytest.approx(STIFFNESS) and limits.sum() == pytest.approx(LIMIT)
    assert np.std(np.log(limits)) == pytest.approx(spread, rel=0.15)


def test_slips_in_parallel_yield_as_far_as_one_element_and_close_their_small_loops():
    """Masing: from where it turns back the torque follows the first curve, twice as large (Iwan 1966)."""
    at = np.concatenate([np.linspace(0, 1, 400), np.linspace(1, -1, 800), np.linspace(-1, 0, 400)])
    far = 20.0 * LIMIT / STIFFNESS * at[None]
    motion = SimpleNamespace(q=lambda j: far, group=SimpleNamespace(window=None), time_step=1e-3)
    law = slipping_friction(0, "axis").law
    p = np.array([STIFFNESS, LIMIT, 0.7, 0.0])
    assert np.abs(law(p, motion, 0, 1.0)).max() == pytest.approx(LIMIT)
    small = 0.8 * LIMIT / STIFFNESS * at[None]
    motion.q = lambda j: small
    loop = law(p, motion, 0, 1.0)[0]
    down, x = loop[400:1200], small[0, 400:1200]
    motion.q, motion.group.window = (lambda j: 0.5 * (x[0] - x)[None]), np.ones(800)  # at rest where it begins
    first = law(p, motion, 0, 1.0)[0]
    assert np.abs(down - (down[0] - 2.0 * first)).max() < 0.01 * LIMIT
    one = elastoplastic(small, STIFFNESS, LIMIT)[0]
    assert np.ptp(loop) < np.ptp(one)  # what gives early has yielded
