"""One hostile input and what has to come of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

REFUSED, ACCEPTED, EITHER = "refused", "accepted", "either"


@dataclass(frozen=True)
class Case:
    """A command line over files that it writes first.

    Attributes:
        make: writes into an empty folder and gives the arguments of ``simgap``.
        names: what the error must name, "" where it is an option alone.
        outcome: REFUSED: one line and status 2. ACCEPTED: odd, but sound: status 0. EITHER: damage that may
            have missed what is read; what is then written must be a dataset that loads.
        alone: needs a process of its own, whose memory is limited.
    """

    id: str
    make: Callable[[Path], list[str]]
    names: str
    outcome: str = REFUSED
    alone: bool = False


def flips(data: bytes, seed: int, count: int = 3) -> bytes:
    """The bytes with some of their bits turned, by a generator of ``seed``."""
    import numpy as np

    rng = np.random.default_rng(seed)
    out = bytearray(data)
    for k in rng.integers(len(out), size=count):
        out[k] ^= 1 << int(rng.integers(8))
    return bytes(out)
