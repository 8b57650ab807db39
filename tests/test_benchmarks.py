"""The blind benchmark hides effects of the sizes that it says."""

import numpy as np
from hypothesis import example, given
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


@given(limit=st.floats(-3.0, 3.0), target=st.floats(3.0, 100.0))
@example(limit=1.65625, target=30.5)  # secants that lead from one end to the other and back
def test_an_effect_that_does_nothing_up_to_a_strength_and_soon_too_much(limit, target):
    """As a torque limit, beyond which the arm falls: it is sought between."""

    def size(strength: float) -> float:
        over = np.log(strength) - limit
        return 0.0 if over < 0.0 else np.inf if over > 0.6 else 200.0 * over

    assert 0.5 < size(brought_to(lambda factor: factor, size, target)) / target < 2.0
