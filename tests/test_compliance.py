"""Inverses of small matrices at many frequencies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.compliance import link_compliance


def dense(M, Kg, stiffness, damping, rate, square):
    return np.linalg.inv(square[:, None, None] * M + Kg + np.apply_along_axis(np.diag, -1, stiffness + rate * damping))


@settings(deadline=None)
@given(n=st.integers(1, 9), seed=st.integers(0, 2**32 - 1), each=st.booleans())
def test_links_yield_as_the_dense_inverse_says(n, seed, each):
    rng = np.random.default_rng(seed)
    root, gravity = rng.normal(size=(2, *((20,) if each else ()), n, n))
    M, Kg = root @ root.swapaxes(-1, -2) + np.eye(n), gravity + gravity.swapaxes(-1, -2)
    stiffness, damping = 10.0 ** rng.uniform(1.0, 5.0, n), 10.0 ** rng.uniform(-1.0, 1.0, n)
    rate = 1j * np.linspace(0.0, 300.0, 20)[:, None]
    found = link_compliance(M, Kg, stiffness, damping, rate[:, 0], rate[:, 0] ** 2)
    expected = dense(M, Kg, stiffness, damping, rate, rate[:, 0] ** 2)
    # Both lose digits near a resonance that is hardly damped.
    lost = np.linalg.cond(expected)[:, None, None] * np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert np.all(np.abs(found - expected) <= 1e-13 * lost)


def test_rows_are_exchanged_where_an_element_of_the_diagonal_vanishes():
    """As at the frequency at which one link alone, all others held, would resonate."""
    M, stiffness = np.array([[1.0, 0.5], [0.5, 2.0]]), np.array([4.0, 3.0])
    rate = np.array([2j])
    found = link_compliance(M, np.zeros((2, 2)), stiffness, np.zeros(2), rate, rate**2)
    assert found[0] == pytest.approx(np.linalg.inv([[0.0, -2.0], [-2.0, -5.0]]), abs=1e-15)


def test_a_chain_that_nothing_holds_is_singular():
    with pytest.raises(np.linalg.LinAlgError):
        link_compliance(np.eye(2), np.zeros((2, 2)), np.zeros(2), np.zeros(2), np.zeros(1, complex), np.zeros(1))


def test_what_is_not_a_number_stays_so():
    lines = np.ones(1, complex)
    assert np.all(np.isnan(link_compliance(np.eye(2) * np.nan, np.zeros((2, 2)), np.ones(2), np.ones(2), lines, lines)))
