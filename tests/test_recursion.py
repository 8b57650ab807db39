"""The compiled recursion against Pinocchio's own, on random chains."""

import numpy as np
import pinocchio as pin
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.recursion import BLOCK, chain_of, newton_euler, sines


def random_chain(rng: np.random.Generator, joints: int) -> pin.Model:
    """Branching revolute and prismatic joints about any axis."""
    model = pin.Model()
    model.gravity.linear = rng.normal(0.0, 9.0, 3)
    for i in range(joints):
        axis = rng.normal(size=3)
        kind = pin.JointModelPrismaticUnaligned if rng.random() < 0.3 else pin.JointModelRevoluteUnaligned
        at = model.addJoint(int(rng.integers(0, i + 1)), kind(axis / np.linalg.norm(axis)), pin.SE3.Random(), f"j{i}")
        model.appendBodyToJoint(at, pin.Inertia.Random(), pin.SE3.Identity())
    return model


@given(seed=st.integers(0, 2**31), joints=st.integers(1, 9), points=st.sampled_from([1, 7, BLOCK, BLOCK + 1, 700]))
@settings(max_examples=40, deadline=None)
def test_agrees_with_pinocchio(seed, joints, points):
    rng = np.random.default_rng(seed)
    model = random_chain(rng, joints)
    data = model.createData()
    motion = rng.normal(0.0, 2.0, (3, points, joints))
    expected = np.array([pin.rnea(model, data, *motion[:, k]) for k in range(points)])
    found = newton_euler(chain_of(model), *motion)
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


@given(
    size=st.sampled_from([1e-9, 1.0, 7.0, 1e3, 1e6]),
    at=st.sampled_from([0.0, np.pi / 4, np.pi / 2, np.pi, -np.pi, 100.0 * np.pi]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=60, deadline=None)
def test_sines_are_those_of_the_library(size, at, seed):
    """To a unit in the last place of one, about the ends of the quarters too."""
    angle = at + size * np.random.default_rng(seed).normal(size=(50, 3))
    sine, cosine = sines(angle)
    assert np.abs(sine - np.sin(angle)).max() < 2.3e-16 and np.abs(cosine - np.cos(angle)).max() < 2.3e-16


def test_sines_of_nothing_finite_are_no_numbers():
    sine, cosine = sines(np.array([[np.nan, np.inf, -np.inf, 0.0]]))
    assert np.array_equal(np.isnan(sine), [[True, True, True, False]]) and np.array_equal(
        np.isnan(cosine), np.isnan(sine)
    )
    assert sine[0, 3] == 0.0 and cosine[0, 3] == 1.0
