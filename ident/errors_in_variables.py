"""Noise that both factors of a normal equation hold.

The measured position stands in the residual, ``e = U - Z Q``, and in its derivatives, ``-dZ Q``. Its noise is in both,
and the mean of ``(dZ Q)^H C^-1 e`` is not zero where the model is right: least squares end elsewhere, however long the
recording, and the further off the more lines hold noise alone (errors in variables; Soderstrom, Automatica 43, 2007).
The scatter between periods tells what the noise of the means adds to the cost and to its slope, and both are taken off:
what is left has its minimum where the model is right, whatever the weights.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ident.columns import Products
from ident.extended import Prediction, moves_plane, predict_at
from ident.group import Group
from ident.inverse import Sampling, make_plane
from ident.model import Model, is_linear
from ident.stiction import as_held

MOST = 0.9  # of the information on any direction of the coordinates, that may be taken off as noise
# what noise adds over all that there is, in some direction, that no scatter of its estimate explains
CERTAINLY_MORE = 1.5
LEAST = 1e-12  # information on a coordinate that is none
STEADY = 1e-10  # relative, of a normal matrix of which an inverse is taken


def scatter_costs(group: Group, pred: Prediction, whiten: np.ndarray, still: np.ndarray | None = None) -> np.ndarray:
    """(n,) what noise of the means adds to the whitened cost, by joint.

    Args:
        whiten: (K, n, n) of the compared lines; still: of ``held_share``.
    """
    Z = pred.sampled_impedance[: len(whiten)]
    assert group.scatter is not None
    torque, across, position = group.scatter
    mixed = across @ _adjoint(Z)
    covariance = as_held(torque - mixed - _adjoint(mixed) + Z @ position @ _adjoint(Z), still)
    return np.einsum("kij,kjl,kil->i", whiten, covariance, whiten.conj(), optimize=True).real


def scatter_slope(
    group: Group,
    pred: Prediction,
    whiten: np.ndarray,
    baseline: Products,
    others: Iterator[tuple[int, np.ndarray]],
    count: int,
) -> np.ndarray:
    """(p,) what it adds to ``J^H e`` of the normal equations, in the order of the coordinates.

    Args:
        baseline: of ``baseline_products``, of the first coordinates; its signals do not matter. Gears beside laws count
            as linear here, and with their mean slope in the cost: what that leaves is far below a deviation.
        others: coordinates and the derivatives (K, n, n) of the impedance by them.
        count: coordinates, p.
    """
    K = len(whiten)
    assert group.scatter is not None
    _, across, position = group.scatter
    shared = whiten @ (across - pred.sampled_impedance[:K] @ position)  # (K, n, n) whitened residual times position
    out = np.zeros(count)
    along = (shared @ _adjoint(signals_per_position(pred, K)))[..., baseline.of]
    gains = _whitened_gains(pred, whiten, baseline)
    out[: len(baseline.of)] = np.einsum("kic,kic->c", gains.conj(), along).real
    for i, slope in others:
        out[i] = np.vdot(whiten @ slope, shared).real
    return out


def scatter_information(group: Group, pred: Prediction, whiten: np.ndarray, baseline: Products) -> np.ndarray:
    """What it adds to ``J^H J`` of the coordinates of ``baseline``."""
    K = len(whiten)
    assert group.scatter is not None
    _, _, position = group.scatter
    signals = signals_per_position(pred, K)
    among = (signals @ position @ _adjoint(signals))[:, baseline.of][:, :, baseline.of]
    gains = _whitened_gains(pred, whiten, baseline)
    return np.einsum("kcd,kdc->cd", _adjoint(gains) @ gains, among).real


def trusted_share(information: np.ndarray, by_noise: np.ndarray) -> float:
    """Share of what noise adds that is taken off, 1 unless some direction of the coordinates would hold next to nothing
    then.

    0 where some coordinate is not felt, and where there would be more noise in a direction than there is of all: then
    the periods differ by more than noise, as those of a motor that creeps do.

    Args:
        information: normal matrix (p, p); by_noise: what noise adds to its first rows and columns.
    """
    # of a motor that is held nothing is left to take noise off
    if np.any(np.diag(information)[: len(by_noise)] < LEAST):
        return 0.0
    information, by_noise, _ = _scaled(information, by_noise)
    root = np.linalg.cholesky(information)
    largest = np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, by_noise).T)).max()
    return float(min(1.0, MOST / max(largest, 1e-300))) if largest < CERTAINLY_MORE else 0.0


def information_left(information: np.ndarray, by_noise: np.ndarray) -> np.ndarray:
    """(p, p) information on the coordinates, of which noise of the position is none: inverse covariance of the minimum.

    ``(H - D) H^-1 (H - D)``: what moves the minimum has the spread ``H``, and ``H - D`` is what holds it.

    Args:
        information, by_noise: ``H`` and ``D``, as of ``trusted_share``.
    """
    steadied, by_noise, size = _scaled(information, by_noise)
    left = information / np.outer(size, size) - by_noise
    return left @ np.linalg.solve(steadied, left) * np.outer(size, size)


def _scaled(information: np.ndarray, by_noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both in units in which the former has ones on its diagonal, made safe to invert, and the units."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    padded, q = np.zeros_like(information), len(by_noise)
    padded[:q, :q] = by_noise
    units = np.outer(size, size)
    return information / units + STEADY * np.eye(len(size)), padded / units, size


def signals_per_position(pred: Prediction, count: int) -> np.ndarray:
    """(count, m, n) signals of ``baseline_products`` per motor position: deflections, positions, elastic
    coordinates."""
    plane, par, structure = pred.about, pred.par, pred.structure
    links = (plane.A_inv[:count][:, :, structure.driven] * plane.C[:count, None]) @ par.coupling
    deflections = par.coupling - links[:, structure.driven]
    n = par.coupling.shape[1]
    elastic = links[:, np.asarray(structure.elastic, int)]
    return (
        np.concatenate([deflections, np.broadcast_to(np.eye(n), (count, n, n)), elastic], axis=1)
        * pred.filters[1][:count, None]
    )


def _whitened_gains(pred: Prediction, whiten: np.ndarray, baseline: Products) -> np.ndarray:
    return whiten @ (pred.filters[0][: len(whiten), :, None] * baseline.gains[: len(whiten)])


def impedance_slopes(
    model: Model,
    group: Group,
    pred: Prediction,
    sampling: Sampling,
    effect: int,
) -> Iterator[np.ndarray]:
    """Derivatives (K, n, n) of the impedance by the coordinates of an effect, of that number, that is linear; none of
    one that is not."""
    h, K = model.effects[effect].hypothesis, group.n_compared
    if not (is_linear(h) or moves_plane(h)):
        return
    held: dict[str, Any] = {"W": pred.solution.W, "torques": pred.solution.torques}
    elsewhere = pred.about is not pred.plane and (h.channel == "model" or moves_plane(h))
    for there, step in model.stepped[effect]:
        structure, par, plane = pred.structure, pred.par, pred.plane
        if h.channel == "model":
            structure, par = there.built
            plane = make_plane(structure, par, group, sampling)
        if elsewhere:
            moved = predict_at(there, structure, par, plane, group, sampling, **held)
        else:
            moved = replace(pred, model=there, structure=structure, par=par, plane=plane)
        yield (moved.sampled_impedance[:K] - pred.sampled_impedance[:K]) / step


def _adjoint(X: np.ndarray) -> np.ndarray:
    return X.conj().swapaxes(-1, -2)
