"""`simgap frf`: FRFs and distortion levels as files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ident.dataset import Dataset
from ident.distortion import estimate_distortion
from ident.frf import estimate_frf
from ident.outputs import outputs_into
from ident.units import units_of_torques


def write_frf(dataset: Dataset, out: str | Path, estimator: str = "auto") -> dict[str, Any]:
    """Write ``frf.npz`` and ``frf.json``; returns the summary of the latter.

    Args:
        estimator: see ``estimate_frf``.
    """
    frf = estimate_frf(dataset, estimator=estimator)
    distortion = estimate_distortion(dataset, frf)
    magnitude = np.maximum(np.abs(frf.G), 1e-300)
    summary = {
        "estimator": frf.estimator,
        "operating_points": list(frf.operating_points),
        "lines": len(frf.lines),
        "band_hz": [float(frf.frequency[0]), float(frf.frequency[-1])],
        "realizations": frf.realizations,
        "periods": frf.periods,
        "not_used": list(frf.not_used),
        "median_relative_std": float(np.median(frf.total_std / magnitude)),
        "distortion_N_m": {
            kind: {
                joint: {
                    f"level {a:g}": _mean_of_known(getattr(distortion, kind)[:, i, j])
                    for i, a in enumerate(distortion.levels)
                }
                for j, joint in enumerate(dataset.joints)
            }
            for kind in ("excited", "noise", "even", "odd")
        },
        "distortion_unit": units_of_torques(dataset.robot),  # of a linear joint N, whatever the key above says
    }
    with outputs_into(out) as folder:
        np.savez_compressed(
            folder / "frf.npz",
            G=frf.G,
            covariance=frf.covariance,
            noise_std=frf.noise_std,
            total_std=frf.total_std,
            frequency=frf.frequency,
            q0=frf.q0,
            operating_points=np.array(frf.operating_points),
        )
        (folder / "frf.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return summary


def _mean_of_known(x: np.ndarray) -> float | None:
    """Mean over the operating points that know it; None, which JSON can say, where none does."""
    known = x[np.isfinite(x)]
    return float(known.mean()) if len(known) else None
