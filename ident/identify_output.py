"""`simgap identify`: parameters with standard deviations and correlations as files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ident.chain import build_structure
from ident.dataset import Dataset
from ident.estimate import ESTIMATORS, fit_frf
from ident.frf import estimate_frf
from ident.graybox import Parameters
from ident.identification import identify
from ident.lost_samples import with_lost_samples_filled
from ident.outputs import outputs_into
from ident.units import linear_names, parameter_unit
from ident.values import baseline_values
from robot_assets.errors import DataError


def identify_and_write(
    dataset: Dataset, out: str | Path, estimator: str, progress: Callable[[str], None], frf_estimator: str = "auto"
) -> dict[str, Any]:
    """Fit and write ``parameters.json``.

    Args:
        estimator: "nls", "wnls", "lls" or "wlls" on FRFs, or "ml" on the torque residual.
        frf_estimator: of the FRFs; see ``estimate_frf``.

    Raises:
        DataError: for an estimator that there is not, or data without full FRFs.
    """
    dataset, _ = with_lost_samples_filled(dataset)
    if estimator == "ml":
        _, result = identify(dataset, progress=progress)
        values, undetermined = baseline_values(result)
        parameters = {k: asdict(v) for k, v in values.items()}
        names, covariance = list(result.names), result.covariance()
        extra = {"chi2_per_dof": result.chi2_per_dof}
    elif estimator in ESTIMATORS:
        progress("frequency responses")
        frf = estimate_frf(dataset, estimator=frf_estimator)
        progress(f"fitting by {estimator}")
        fit = fit_frf(
            build_structure(dataset.robot),
            frf,
            Parameters.nominal(dataset.robot),
            sample_time=1.0 / dataset.sample_rate,
            hold=dataset.input_hold,
            estimator=estimator,
        )
        x, std = np.exp(fit.parameters.to_log()), np.sqrt(np.maximum(np.diag(fit.covariance), 0))
        names, covariance, undetermined = list(fit.names), fit.covariance, fit.undetermined
        linear = linear_names(dataset.robot)
        parameters = {
            n: {"value": float(v), "std": float(v * s), "unit": parameter_unit(n, linear)}
            for n, v, s in zip(names[:-1], x, std[:-1], strict=True)
        }
        extra = {"cost": fit.cost}
    else:
        raise DataError("--estimator", "command line", repr(estimator), f"one of {(*ESTIMATORS, 'ml')}")
    d = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    result_dict = {
        "estimator": estimator,
        "parameters": parameters,
        "not_identified": list(undetermined),
        "correlation": {"names": names, "matrix": (covariance / np.outer(d, d)).round(6).tolist()},
        **extra,
    }
    with outputs_into(out) as folder:
        (folder / "parameters.json").write_text(json.dumps(result_dict, indent=2) + "\n", encoding="utf-8")
    return result_dict
