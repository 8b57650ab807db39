"""Compiled code made once, after the installation: ``python -m ident.precompile``.

Else the first diagnosis makes it, which takes some twenty seconds longer.
"""

from __future__ import annotations

import numpy as np

from ident.chain import build_structure
from ident.compliance import link_compliance
from ident.hypotheses.friction import direction
from ident.hypotheses.kernels import BACKLASH, HYSTERESIS, Law, along_motion
from ident.hypotheses.loop import steady_loop
from ident.hypotheses.yielding import bristle, dipping_bristle
from ident.recursion import chain_of, newton_euler
from ident.varying import factorised, march
from robot_assets.robot import load_robot


def precompile() -> None:
    """Call what a diagnosis calls of compiled code, with next to no data."""
    still, mode = np.zeros((1, 4)), np.full((4, 1), 1e-3 + 0j)
    one, line = np.ones((1, 1)), np.zeros(1, complex)
    link_compliance(one, one, one[0], one[0], line, line)
    newton_euler(chain_of(build_structure(load_robot("twomass")).model), *np.zeros((3, 1, 1)))
    path = np.ones((1, 1, 1))
    march(factorised(path), path, path, 1e-3, 0.25, np.zeros(2), one[0], one, one.copy())
    direction(still, 1e-3)
    bristle(still, 1e-3, 1e-3, start=np.zeros(1))
    dipping_bristle(still, 1e-3, 1e3, np.ones((1, 4)))
    for law in (Law(BACKLASH, 1.0, 0.0, 1.0), Law(HYSTERESIS, 1.0, 1.0, 1.0)):
        along_motion(law, still, still)
        steady_loop(law, still, still, mode)


if __name__ == "__main__":
    precompile()
