"""Segments that no model is fitted to."""

from __future__ import annotations

from dataclasses import replace

from ident.dataset import Dataset

HELD_OUT_SHARE = 1.0 / 3.0  # of a single motion
LEAST_HELD_OUT = 2.0  # s of it


def with_held_out(dataset: Dataset) -> Dataset:
    """The dataset, its end held out where it is a single motion: nothing else would test what is named."""
    if len(dataset.segments) != 1:
        return dataset
    (whole,) = dataset.segments
    if whole.kind != "trajectory" or whole.role != "identification":
        return dataset
    cut = round((1.0 - HELD_OUT_SHARE) * whole.n_samples)
    if (whole.n_samples - cut) / dataset.sample_rate < LEAST_HELD_OUT:
        return dataset

    first = replace(whole, role="identification", **whole.part(slice(None, cut)))
    last = replace(whole, name=f"{whole.name}-end", role="validation", **whole.part(slice(cut, None)))
    return replace(dataset, segments=(first, last))


def not_fitted(dataset: Dataset) -> list[str]:
    """A line on motions for identification that stand beside multisines, of which alone a model is then made."""
    names = [s.name for s in dataset.select(role="identification", kind="trajectory")]
    if not names or not dataset.select(role="identification", kind="multisine"):
        return []
    those = names[0] if len(names) == 1 else f"{len(names)} motions, {names[0]} first"
    return [
        f"{those} of role identification: nothing is fitted to motions beside multisines; as validation they would test the model"
    ]
