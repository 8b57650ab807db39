"""Noise of the samples of torque and position: as a dataset gives it, or from its records."""

from __future__ import annotations

import numpy as np

from ident.dataset import Dataset, Segment
from ident.rest import difference_noise

# Over the signal, where differences of samples show less: filtered records.
LEAST_NOISE = {"q": 1e-7, "tau": 1e-3}


def declared_position_noise(dataset: Dataset) -> np.ndarray:
    """(n,) sample noise of the positions by the dataset, else by its robot; rad."""
    return np.asarray(dataset.robot.array("q_std") if dataset.q_std is None else dataset.q_std, float)


def recorded_noise(dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Sample noise of position and torque: as given, else from fourth differences of the identification segments.

    A torque that is not held from sample to sample may be made by a faster loop, of which the record holds single
    samples: what circulates there folds into all lines, and is noise beside that which is given.
    """
    return noise_of(dataset, "q"), noise_of(dataset, "tau")


def noise_of(dataset: Dataset, channel: str) -> np.ndarray:
    """(n,) noise of the samples of a channel, rad or N m (``recorded_noise``)."""
    given = given_noise(dataset, channel)
    if given is not None and (channel == "q" or dataset.input_hold == "zoh"):
        return given
    each = np.median([difference_noise(getattr(s, channel)) for s in _fitted(dataset)], axis=0)
    return np.maximum(each, least_noise(dataset, channel))


def given_noise(dataset: Dataset, channel: str) -> np.ndarray | None:
    """(n,) noise of the samples of a channel that the dataset gives, rad or N m; None where it does not."""
    given = dataset.q_std if channel == "q" else dataset.tau_std
    return np.asarray(given, float) if given is not None and np.all(given > 0) else None


def least_noise(dataset: Dataset, channel: str) -> np.ndarray:
    """(n,) noise of the samples of a channel that is taken at least, rad or N m: as given, else a small share of its
    signal."""
    given = given_noise(dataset, channel)
    if given is not None:
        return given
    size = np.median([np.std(getattr(s, channel), axis=0) for s in _fitted(dataset)], axis=0)
    return np.maximum(LEAST_NOISE[channel] * size, 1e-9 if channel == "q" else 1e-6)


def _fitted(dataset: Dataset) -> tuple[Segment, ...]:
    """The segments for identification; all where there are none."""
    return dataset.select(role="identification") or dataset.segments
