"""Derivatives of the predicted torque, most of them products, and the normal equations of a fit.

A baseline parameter moves the torque of a line by a gain of the arm, the same in all segments, times
a signal of the motion, the same for all motors. Kept as products, the columns take a fraction of the
memory, and their inner products are sums over lines of small matrices.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Products:
    """Columns ``gains[l, :, c] * signals[s, l, of[c]]``.

    Attributes:
        gains: (K, n, p) complex; signals: (S, K, m) complex; of: (p,) signal of each column.
    """

    gains: np.ndarray
    signals: np.ndarray
    of: np.ndarray

    def dense(self) -> np.ndarray:
        """(S, K, n, p)."""
        return self.gains * self.signals[:, :, None, self.of]

    def pick(self, columns: np.ndarray) -> Products:
        """Some of the columns."""
        return Products(self.gains[..., columns], self.signals, self.of[columns])


@dataclass(frozen=True)
class Columns:
    """Columns of a Jacobian: ``products`` at coordinates ``product_at``, ``whole`` (S, K, n, b) at ``whole_at``."""

    products: Products
    product_at: np.ndarray
    whole: np.ndarray
    whole_at: np.ndarray

    def dense(self) -> np.ndarray:
        """(S, K, n, p), in the order of the coordinates."""
        out = np.empty((*self.whole.shape[:3], len(self.product_at) + len(self.whole_at)), complex)
        out[..., self.product_at] = self.products.dense()
        out[..., self.whole_at] = self.whole
        return out

    def replaced(self, columns: Mapping[int, np.ndarray]) -> Columns:
        """With other columns (S, K, n), or more, by their coordinates."""
        if not columns:
            return self
        new = np.array(list(columns))
        kept, left = ~np.isin(self.product_at, new), ~np.isin(self.whole_at, new)
        return Columns(
            self.products.pick(np.flatnonzero(kept)),
            self.product_at[kept],
            np.concatenate([self.whole[..., left], *(x[..., None] for x in columns.values())], axis=-1),
            np.concatenate([self.whole_at[left], new]),
        )

    def made_whole(self, dense: np.ndarray) -> Columns:
        """Other columns (S, K, n, p), in the order of the coordinates, none of them a product."""
        none = np.arange(0)
        return Columns(self.products.pick(none), none, dense, np.arange(dense.shape[-1]))

    def normal(self, whiten: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix (p, p) and right-hand side (p,) of real and imaginary parts.

        Args:
            whiten: (K, n, n) that makes residuals of a line white.
            residual: (S, K, n) of the lines 0..K-1 that are compared, not whitened.
        """
        K = len(whiten)
        signals = self.products.signals[:, :K].transpose(1, 2, 0)  # (K, m, S)
        signals = np.ascontiguousarray(signals[:, self.products.of])
        gains = np.matmul(whiten, self.products.gains[:K])
        whole = np.concatenate([self.whole[:, :K], residual[..., None]], axis=-1)
        S, b = len(whole), whole.shape[-1]
        whole = np.ascontiguousarray(whole.transpose(1, 2, 3, 0)).reshape(K, -1, b * S)
        whole = np.matmul(whiten, whole)
        flat = np.ascontiguousarray(whole.reshape(K, -1, b, S).transpose(2, 0, 1, 3)).reshape(b, -1).view(float)
        adjoint = gains.conj().transpose(0, 2, 1)
        among = np.matmul(adjoint, gains) * np.matmul(signals.conj(), signals.transpose(0, 2, 1))
        across = np.matmul(adjoint, whole).reshape(K, -1, b, S)
        across = np.einsum("lcs,lcbs->cb", signals.conj(), across, optimize=False).real
        own = flat @ flat.T
        at = np.concatenate([self.product_at, self.whole_at])
        H = np.empty((len(at), len(at)))
        H[np.ix_(at, at)] = np.block([[np.sum(among, axis=0).real, across[:, :-1]], [across[:, :-1].T, own[:-1, :-1]]])
        rhs = np.empty(len(at))
        rhs[at] = np.concatenate([across[:, -1], own[:-1, -1]])
        return H, rhs
