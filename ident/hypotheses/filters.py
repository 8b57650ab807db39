"""Lags of first and of second order, of a current loop or of an encoder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ident.hypotheses.hypothesis import Parameter, sought

# of a lag, over its time constant: one that is stepped in time as long as that comes half of a step later or sooner
STEPPED = Parameter("stepped", "1", -0.5, 0.5, nuisance=True, center=0.0, spread=0.15, null=0.0)


def lag(p: Sequence[float], s: np.ndarray) -> np.ndarray:
    """What comes before a lag over what comes after: ``(1 + s T) exp(s T stepped)`` of a time constant ``T``, s."""
    return (1.0 + s * p[0]) * np.exp(s * p[0] * sum(p[1:]))


# of a lag of second order, over the square of its time constant: 1 / (4 zeta^2) of its damping ratio, at most 1/4 where
# it is two lags in a row
SQUARE = Parameter("square", "1", 0.0, 1.0, nuisance=True, center=0.25, spread=0.25, null=0.0, reported=True)
SQUARES = 0.15, 0.5  # at first


def second_order_lag(p: Sequence[float], s: np.ndarray) -> np.ndarray:
    """``lag`` of second order: ``1 + s T + square (s T)^2``."""
    x = s * p[0]
    return 1.0 + x + p[1] * x**2


def _from_late(p: np.ndarray, scale: object) -> list[np.ndarray]:
    return [np.array([p[0], square]) for square in SQUARES]


def form(effect: str, stepped: bool, second: bool) -> tuple[tuple[Parameter, ...], Callable, dict[str, Any]]:
    """Parameters of a lag beside its time constant, the filter, and options of its hypothesis.

    Args:
        effect: the delay that is nearly a special case of it where ``second``, beside the lag of first order.
        stepped: whether it may come by a share of the time constant later or sooner, as one that is stepped in time
            does by half of a step. Motions below the modes of the links do not show it.
        second: whether it is of second order, which between its two poles is part lag, part delay. Fitted where these
            leave more than noise.
    """
    if second:
        options = {"holds": effect, "widens": _from_late, "narrow": lambda p: np.array([p[0], 0.0])}
        return (SQUARE,), second_order_lag, {"filter": second_order_lag} | options
    return sought(STEPPED, stepped)[0], lag, {"filter": lag}
