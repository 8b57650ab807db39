"""Laws that move the arm by which they are moved: the periodic steady state."""

from __future__ import annotations

import numpy as np

from ident.hypotheses.kernels import CABLE, HYSTERESIS, LINK, Law, along_motion, loop_sweep
from ident.mixing import MEMORY, mixed
from ident.motion import Steady

SWEEPS = 25  # periods at most until the steady state
# change of the torque from one to the next, over the largest, that ends them: derivatives are differences
STEADY = 1e-7
# the same of one that is solved again until it agrees with others: of the parameters that show least, as the recoil of
# a hysteresis, derivatives are then off by up to a hundredth
STEADY_BESIDE_OTHERS = 1e-6


def steady_loop(
    law: Law,
    linear: np.ndarray,
    rate: np.ndarray,
    modes: np.ndarray,
    guess: np.ndarray | None = None,
    *,
    near: Steady | None = None,
    alone: bool = True,
    returns: float = 1.0,
    step: float = 1.0,
) -> Steady:
    """A law in steady state with the arm.

    ``x = linear - r * h(x, x')`` with ``r`` the compliance of the arm at the law, as a sum of modes stepped
    with a first-order hold: ``x+ = decay x + gain_old h + gain_new h+``. The velocity is that of the modes
    (residues add up to zero: a torque does not step a velocity). Records are stepped side by side, each until it
    repeats; where a sweep begins is mixed from those before, and with it what a law remembers: an element that hardly
    yields creeps for many periods.

    Args:
        linear, rate: (S, T) position and velocity without the law, rad, rad/s; the latter for laws that see it alone.
        modes: (4, modes) complex, of ``kernels.modal_compliance``.
        guess: (modes, S) complex state from which to begin; rest where None.
        near: steady state of the same law in nearly the same motion, from which to begin instead, where it has as many
            points and modes.
        alone: whether no other law is solved until it agrees with this one.
        returns: share of the period from which on it is but a return that closes a motion, in which what yields comes
            to the ``start`` of the law; 1 where there is none.
        step: s, of time, for laws that lead.
    """
    code, _, b, k = law[:4]
    S, T = linear.shape
    enough = STEADY if alone else STEADY_BESIDE_OTHERS
    remembers = code in (HYSTERESIS, CABLE)
    shape = (*law.shape[:5], law.lead / step) if code == LINK else law.shape
    last = round(returns * T) if remembers else T
    unit = np.array([[1.0], [1.0], [k]])  # of what is remembered, in which it is a deflection
    poles, decay, _, _ = modes
    whole = (decay**T)[:, None]
    linear, rate = np.ascontiguousarray(linear.T), np.ascontiguousarray(rate.T)
    start = np.zeros((len(decay), S), complex) if guess is None else guess
    if near is not None and (near.torque.shape != (S, T) or near.start.shape != start.shape):
        near = None
    if near is not None:
        start, memory, part = near.start.copy(), near.memory.copy(), near.torque.T.copy()
    else:
        memory, part = _at_first(law, linear, rate, poles, start), np.zeros((T, S))
    left = np.arange(S)
    out, begun, remembered = np.zeros((T, S)), start.copy(), memory.copy()
    past: list[tuple[np.ndarray, np.ndarray]] = []
    for sweep in range(SWEEPS):
        before = memory.copy()
        begun[:, left], remembered[:, left] = start, before
        end, change = loop_sweep(*shape, linear, rate, modes, start, memory, part, last, b * law.start)
        # The state that the torque of this period repeats.
        move = (end - whole * start) / (1.0 - whole) - start
        moving = change > enough if sweep or near is not None else np.ones(len(left), bool)
        if remembers:
            start, move = np.vstack([start, before / unit]), np.vstack([move, (memory - before) / unit])
        past = [*past[-MEMORY:], (start.T, move.T)]
        if not np.all(moving):
            out[:, left[~moving]] = part[:, ~moving]
            left = left[moving]
            # The compiled code steps all records of a time side by side, and is compiled once for all layouts.
            part, memory, linear, rate = (np.ascontiguousarray(x[:, moving]) for x in (part, memory, linear, rate))
            past = [(z[moving], f[moving]) for z, f in past]
        if not len(left):
            break
        start = np.ascontiguousarray(mixed(past).T)
        if remembers:
            memory = unit * start[len(decay) :].real
            if code == HYSTERESIS:
                memory[2] = np.clip(memory[2], -b, b)
            start = start[: len(decay)].copy()
    out[:, left] = part
    return Steady(out.T.copy(), begun, remembered)


def _at_first(law: Law, linear: np.ndarray, rate: np.ndarray, poles: np.ndarray, start: np.ndarray) -> np.ndarray:
    """What a law remembers (3, S) at the end of periods (T, S), of modes in the state ``start``: deflection, the one
    before, or the velocity of a ``LINK``, and torque."""
    code, a, b, k = law[:4]
    x = linear[-1] - start.real.sum(axis=0)
    if code == LINK:
        v = rate[-1] - (poles @ start).real
        return np.stack([x, v, a * x + b * np.tanh(v / k)])
    return np.stack([x, x, a * x if code == CABLE else along_motion(law, x[:, None], np.zeros((len(x), 1)))[:, 0]])


def modal_state(torque: np.ndarray, omega: np.ndarray, step: float, modes: np.ndarray) -> np.ndarray:
    """State (modes, S) of modes one step before the period that a periodic torque keeps repeating.

    Args:
        torque: (S, L) spectrum, N m; omega: (L,) rad/s, the first of them zero; step: s.
    """
    _, decay, gain_old, gain_new = (m[:, None] for m in modes)
    z = np.exp(1j * omega * step)
    ahead, behind = ((gain_old + gain_new * u) / (u - decay) / u for u in (z, z.conj()))
    behind[:, 0] = 0.0
    return ahead @ torque.T + behind @ torque.conj().T
