"""Steps in position found in the samples, and nowhere else."""

import numpy as np
import pytest

from ident.quantization import _blurred_grid, _exact_grid


def motion(rng, N=4000):
    t = np.arange(N) / 1000
    return 0.8 + sum(a * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for a, f in ((0.01, 2.25), (4e-3, 5.5), (1e-3, 11.0)))


@pytest.mark.parametrize("step", [2e-5, 6.1e-5, 2 * np.pi / 2**16])
@pytest.mark.parametrize("seed", range(3))
def test_a_rounded_position_shows_its_step(step, seed):
    rng = np.random.default_rng(seed)
    q = motion(rng)
    found = _exact_grid(np.round((q + 3e-6 * rng.normal(size=len(q))) / step) * step)
    assert found[0] == pytest.approx(step, rel=1e-3)
    blurred = _blurred_grid(np.round(q / step) * step + 2e-6 * rng.normal(size=len(q)), 2e-6)
    assert blurred[0] == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_a_smooth_position_with_noise_has_no_steps(seed):
    rng = np.random.default_rng(seed)
    q = motion(rng) + 3e-6 * rng.normal(size=4000)
    assert _exact_grid(q) is None and _blurred_grid(q, 3e-6) is None
