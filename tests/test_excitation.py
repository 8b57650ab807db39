"""Multisines and plans."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.excitation import crest_factor, make_plan, odd_random_grid, orthogonal_multisines, plan_from_toml, plan_to_toml


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 7))
def test_experiments_are_orthogonal_with_the_wanted_amplitudes(seed, n):
    rng = np.random.default_rng(seed)
    lines = np.array([3, 7, 11, 25])
    amplitudes = rng.uniform(0.5, 2.0, (4, n))
    r = orthogonal_multisines(rng, lines, amplitudes, 128, draws=5)
    R = 2 * np.fft.rfft(r, axis=1, norm="forward")[:, lines].transpose(1, 2, 0)
    product = R @ R.conj().swapaxes(1, 2) / n
    assert np.allclose(product, amplitudes[:, :, None] ** 2 * np.eye(n), atol=1e-9)
    rest = np.delete(np.fft.rfft(r, axis=1), lines, axis=1)
    assert np.abs(rest).max() < 1e-9 * np.abs(r).max() * 128


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_grid_is_odd_and_leaves_one_of_each_group_out(seed):
    lines, detection = odd_random_grid(np.random.default_rng(seed), 4000, 1000.0, (0.5, 70.0))
    assert np.all(lines % 2 == 1) and np.all(detection % 2 == 1) and not set(lines) & set(detection)
    odd = np.sort(np.concatenate([lines, detection]))
    for i in range(len(odd) // 4):
        assert np.isin(odd[4 * i : 4 * i + 4], detection).sum() == 1


def test_many_draws_lower_the_crest_factor():
    lines = np.arange(1, 200, 2)
    amplitudes = np.ones((len(lines), 6))
    few = [crest_factor(orthogonal_multisines(np.random.default_rng(s), lines, amplitudes, 1000, 6)) for s in range(8)]
    many = [crest_factor(orthogonal_multisines(np.random.default_rng(s), lines, amplitudes, 1000, 120)) for s in range(8)]
    assert np.mean(many) < np.mean(few) - 0.2


def test_a_plan_survives_its_file_and_repeats_by_seed(tmp_path, ur10):
    plan = make_plan(ur10, points=2, seed=3, period=500)
    plan_to_toml(plan, tmp_path / "plan.toml")
    again = plan_from_toml(tmp_path / "plan.toml")
    same = make_plan(ur10, points=2, seed=3, period=500)
    for a, b, c in zip(plan.experiments, again.experiments, same.experiments, strict=True):
        assert np.allclose(a.r, b.r, atol=1e-8) and np.array_equal(a.r, c.r)
        assert a.role == b.role and a.amplitude == b.amplitude
    assert {e.amplitude for e in plan.experiments} == {1.0, 0.5, 0.25}
    assert {e.role for e in plan.experiments} == {"identification", "validation"}
