"""FRF averages on synthetic closed loops: bias and covariance."""

import numpy as np
import pytest

from ident.frf import Blocks, _covariance, average


def closed_loop(rng, noise, M=12, P=2, F=60, n=2):
    """Spectra of a loop ``u = r - K y_m``, ``y_m = G u + v``: the noise circulates."""
    k = np.linspace(0.2, 2.0, F)
    G = np.empty((F, n, n), complex)
    G[:, 0, 0], G[:, 1, 1] = 1 / (1 + 1j * k), 2 / (2 + 1j * k)
    G[:, 0, 1] = G[:, 1, 0] = 0.2 / (1 + 2j * k)
    K = 0.8 * np.eye(n)
    T = np.array([[1, 1], [1, -1]]) / np.sqrt(2)
    phases = np.exp(2j * np.pi * rng.random((M, F, n, 1)))
    R = phases * T
    v = noise * (rng.normal(size=(M, P, F, n, n)) + 1j * rng.normal(size=(M, P, F, n, n))) / np.sqrt(2)
    S = np.linalg.inv(np.eye(n) + K @ G)
    U = S @ (R[:, None] - K @ v)
    Y = G @ U + v
    return G, Blocks(U, Y, R)


@pytest.mark.parametrize("estimator", ["h1", "jio", "ari", "har", "log"])
def test_all_averages_are_exact_without_noise(estimator):
    G, blocks = closed_loop(np.random.default_rng(0), 0.0)
    assert np.allclose(average(blocks, estimator), G, atol=1e-10)


def test_h1_has_the_largest_bias_under_feedback():
    rng = np.random.default_rng(1)
    bias = {}
    for estimator in ("h1", "jio", "ari", "har"):
        errors = []
        for _ in range(30):
            G, blocks = closed_loop(rng, 0.3, M=8)
            errors.append(average(blocks, estimator) - G)
        bias[estimator] = np.abs(np.mean(errors, axis=0)).mean()
    assert bias["h1"] > 2 * max(bias["jio"], bias["ari"], bias["har"])


def test_the_covariance_covers_the_scatter():
    rng = np.random.default_rng(2)
    inside = []
    for _ in range(40):
        G, blocks = closed_loop(rng, 0.03, M=6, P=4)
        estimate = average(blocks, "ari")
        noise, _ = _covariance(blocks, estimate)
        std = np.sqrt(np.einsum("fii->fi", noise).real)
        error = np.swapaxes(estimate - G, -1, -2).reshape(len(G), -1)
        inside.append(np.mean(np.abs(error) ** 2 < 3.0 * std**2))
    assert 0.93 < np.mean(inside) < 0.97


def test_realizations_lower_the_error_by_their_root():
    rng = np.random.default_rng(3)
    def rms(M):
        return np.sqrt(np.mean([np.abs(average((b := closed_loop(rng, 0.05, M=M))[1], "jio") - b[0]) ** 2 for _ in range(30)]))
    assert rms(16) / rms(4) == pytest.approx(0.5, rel=0.15)
