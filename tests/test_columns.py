"""Columns kept as products against the same columns written out."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.columns import Columns, Products


@settings(max_examples=30, deadline=None)
@given(
    S=st.integers(1, 4),
    K=st.integers(1, 6),
    n=st.integers(1, 7),
    products=st.integers(0, 5),
    whole=st.integers(1, 4),
    seed=st.integers(0, 2**32 - 1),
)
def test_normal_equations_of_products(S, K, n, products, whole, seed):
    rng = np.random.default_rng(seed)

    def draw(*shape):
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    at = rng.permutation(products + whole)
    columns = Columns(
        Products(draw(K + 2, n, products), draw(S, K + 2, 3), rng.integers(0, 3, products)),
        at[:products],
        draw(S, K + 2, n, whole),
        at[products:],
    )
    whiten, residual = draw(K, n, n), draw(S, K, n)
    H, b = columns.normal(whiten, residual)
    J = np.einsum("lij,sljp->slip", whiten, columns.dense()[:, :K]).reshape(-1, products + whole)
    r = np.einsum("lij,slj->sli", whiten, residual).ravel()
    np.testing.assert_allclose(H, (J.conj().T @ J).real, rtol=1e-10, atol=1e-10 * max(1.0, np.abs(J).max() ** 2))
    np.testing.assert_allclose(b, (J.conj().T @ r).real, rtol=1e-10, atol=1e-9 * max(1.0, np.abs(J).max() ** 2))


def test_columns_take_the_place_of_others():
    rng = np.random.default_rng(0)
    columns = Columns(
        Products(rng.normal(size=(4, 2, 3)) + 0j, rng.normal(size=(2, 4, 3)) + 0j, np.arange(3)),
        np.array([0, 3, 1]),
        rng.normal(size=(2, 4, 2, 2)) + 0j,
        np.array([4, 2]),
    )
    new = {3: np.full((2, 4, 2), 3.0 + 0j), 2: np.full((2, 4, 2), 2.0 + 0j), 5: np.full((2, 4, 2), 5.0 + 0j)}
    out, before = columns.replaced(new).dense(), columns.dense()
    for c in range(6):
        np.testing.assert_array_equal(out[..., c], new[c] if c in new else before[..., c])
    assert columns.replaced({}) is columns
