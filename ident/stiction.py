"""Motors that dry friction holds: where, and what is left of noise and of derivatives there.

The friction of a motor at rest is what the drive asks of it. As long as that is below its size nothing of the torque is
left: neither an error of the model nor noise, and no parameter changes that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.fft

from ident.extended import Prediction
from ident.group import Group
from ident.model import is_dry
from ident.reactions import beside

PROBE = 1e-6  # of the torque, by which a drive asks for less to see what is held
LEFT_HELD = 0.3  # of the noise of a motor that is held, that counts: when it is held is not known to the sample


def held(pred: Prediction, group: Group) -> np.ndarray | None:
    """(S, T, n) where dry friction at rest balances all that a drive asks of it; None where it holds no motor."""
    dry = [e for e in pred.model.effects if is_dry(e)]
    if group.rest is None or not any(np.any(group.rest[..., e.hypothesis.joint]) for e in dry):
        return None
    motion, out = pred.motion(), np.zeros_like(group.rest)
    for effect in dry:
        j, k = effect.hypothesis.joint, pred.par.stiffness[effect.hypothesis.joint]
        seen = beside(pred.model.effects, effect, motion)
        less = np.zeros(pred.U.shape)
        less[:, 0, j] = PROBE * np.abs(pred.U[..., j]).max()
        # Where the drive asks for a little less the friction of a motor that is held gives less; what is beyond its
        # size does not.
        answers = effect.hypothesis.law(effect.p, seen, j, k) - effect.hypothesis.law(
            effect.p, replace(seen, beside=seen.beside + less), j, k
        )
        out[..., j] |= group.rest[..., j] & (answers > 0.5 * less[:, :1, j])
    return out


def held_share(pred: Prediction, group: Group) -> np.ndarray | None:
    """(T, n, n) share of the noise of two joints, by the time between them, that dry friction at rest leaves; None
    where it holds no motor.

    A motor that is held takes from its friction whatever the drive asks, noise and all: there next to nothing is left.
    """
    still = held(pred, group)
    if still is None:
        return None
    M = scipy.fft.fft(np.where(still, LEFT_HELD, 1.0), axis=1, norm="forward")
    return scipy.fft.ifft(np.einsum("ski,skj->kij", M, M.conj()) / len(M), axis=0, norm="forward")


def as_held(S: np.ndarray, share: np.ndarray | None) -> np.ndarray:
    """Covariance (K, n, n) of lines of stationary noise, of which time-varying shares are left (``held_share``): those
    of other lines mix in."""
    if share is None:
        return S
    K, T = len(S), len(share)
    whole = np.zeros_like(share)
    whole[:K] = S
    whole[K : 2 * K] = S[-1].real  # what is above goes on as at the last line
    whole[T - 2 * K + 1 :] = whole[1 : 2 * K][::-1].conj()
    correlation = scipy.fft.ifft(whole, axis=0, norm="forward") * share
    return scipy.fft.fft(correlation, axis=0, norm="forward")[:K]


def as_free(columns: np.ndarray, still: np.ndarray, group: Group) -> np.ndarray:
    """Derivatives (S, K, p) of the torque of a motor by coordinates, as far as it is free.

    Args:
        still: (S, T) of ``held``, of that motor.
    """
    felt = np.any(columns, axis=(0, 1))
    along = group.to_time(columns[..., felt])
    along[still] = 0.0
    out = np.zeros_like(columns)
    out[..., felt] = group.to_lines(along)[:, : columns.shape[1]]
    return out
