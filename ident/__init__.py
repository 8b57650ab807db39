"""Find what a robot simulation gets wrong: identification, attribution, extension, gain."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ident.dataset import Dataset, Segment
    from ident.dataset_io import load_dataset, save_dataset
    from ident.diagnosis import diagnose, diagnose_fully
    from ident.frf import estimate_frf
    from ident.identification import identify
    from ident.show.simulated_gain import simulated_gain

_HOMES = {
    "Dataset": "ident.dataset",
    "Segment": "ident.dataset",
    "load_dataset": "ident.dataset_io",
    "save_dataset": "ident.dataset_io",
    "diagnose": "ident.diagnosis",
    "diagnose_fully": "ident.diagnosis",
    "identify": "ident.identification",
    "estimate_frf": "ident.frf",
    "simulated_gain": "ident.show.simulated_gain",
}


def __getattr__(name: str) -> Any:
    """Names of the public API, imported on first use: ``sim`` needs only light parts of us."""
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'ident' has no attribute {name!r}")


__all__ = [
    "Dataset",
    "Segment",
    "diagnose",
    "diagnose_fully",
    "estimate_frf",
    "identify",
    "load_dataset",
    "save_dataset",
    "simulated_gain",
]
