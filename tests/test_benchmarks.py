"""The blind benchmark hides effects of the sizes that it says."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.sizing import NEAR, TRIALS, brought_to


@given(
    at_one=st.floats(0.01, 1e4),
    power=st.floats(0.5, 2.0),
    bend=st.floats(0.0, 0.2),
    target=st.floats(3.0, 100.0),
)
def test_an_effect_is_brought_to_its_size(at_one, power, bend, target):
    """By few trials, also where its size grows as no power of its strength."""

    def size(strength: float) -> float:
        return at_one * strength**power * (1.0 + strength) ** -bend

    trials = []

    def stronger(factor: float) -> float:
        trials.append(factor)
        return factor

    found = brought_to(stronger, size, target)
    assert abs(np.log(size(found) / target)) < NEAR
    assert len(trials) <= TRIALS and trials[0] == 1.0


def test_the_nearest_of_an_effect_that_does_not_come_there():
    assert brought_to(lambda factor: factor, lambda strength: 200.0 + strength, 10.0) < 0.1
