"""What the installation compiles is what a diagnosis calls."""

import numpy as np

from ident.compliance import _inverses
from ident.hypotheses.kernels import BACKLASH, HYSTERESIS, Law, along_motion, loop_sweep, smooth_sign
from ident.hypotheses.loop import steady_loop
from ident.hypotheses.yielding import along_path, following, onward
from ident.precompile import precompile
from ident.recursion import recursion, sines

COMPILED = (_inverses, loop_sweep, smooth_sign, along_path, following, onward, recursion, sines)


def test_records_that_settle_at_different_times_call_for_no_more_code():
    """Of records side by side those that repeat are taken out, which leaves arrays of another layout."""
    precompile()
    before = [len(f.signatures) for f in COMPILED]
    assert all(before)
    t = 2.0 * np.pi * np.arange(64) / 64
    linear = np.outer([0.0, 1e-3, 3e-3], np.sin(t))
    pole, step = -5.0 + 300.0j, 1e-3
    decay = np.exp(pole * step)
    gain = 1e-3 * (decay - 1.0) / pole
    modes = np.array([[pole], [decay], [0.5 * gain], [0.5 * gain]])
    for law in (Law(BACKLASH, 1e-3, 0.0, 1e3), Law(HYSTERESIS, 1e3, 0.5, 1e3)):
        torque = steady_loop(law, linear, np.zeros_like(linear), modes).torque
        assert torque.shape == linear.shape and np.any(torque[2])
        along_motion(law, linear, np.zeros_like(linear))
    assert [len(f.signatures) for f in COMPILED] == before
