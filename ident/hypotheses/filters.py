"""First-order lags, of a current loop or of an encoder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.hypotheses.hypothesis import Parameter

# of a lag, over its time constant: one that is stepped in time as long as that comes half of a step later or sooner
STEPPED = Parameter("stepped", "1", -0.5, 0.5, nuisance=True, center=0.0, spread=0.15, null=0.0)


def lag(p: Sequence[float], s: np.ndarray) -> np.ndarray:
    """What comes before a lag over what comes after: ``(1 + s T) exp(s T stepped)`` of a time constant ``T``, s."""
    return (1.0 + s * p[0]) * np.exp(s * p[0] * sum(p[1:]))
