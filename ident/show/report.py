"""report.html: one self-contained page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, select_autoescape

from ident.chain import INERTIAL
from ident.show.figures import (
    evidence_figure,
    frf_figure,
    frf_grid_figure,
    rounded,
    shown_joints,
    trace_figure,
    where_figure,
)
from ident.units import (
    has_one_torque_unit,
    parameter_unit,
    response_unit,
    torque_unit,
    torque_units,
    unit_suffix,
    units_of_torques,
)
from ident.verdict import LEFT_OUT, Diagnosis, FrfView, Value

MAX_FRFS = 3
MAX_TRACES = 2
KINDS = ("stiffness", "damping", "motor_inertia", "viscous_friction")


def write_report(diagnosis: Diagnosis, path: Path) -> None:
    """Render the template with the figures of a diagnosis."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=select_autoescape(["j2", "html"])
    )
    joints, robot, gain = diagnosis.joints, diagnosis.robot, diagnosis.verdict.gain
    of_gain = gain.joints if gain else ()
    html = environment.get_template("report.html.j2").render(
        d=diagnosis,
        v=diagnosis.verdict,
        kinds=KINDS,
        inertial=(*INERTIAL, "torque_offset"),
        unit=parameter_unit,
        rounded=rounded,
        unit_suffix=lambda unit: unbroken(unit_suffix(unit)),
        torque_unit=unbroken(torque_unit(robot, of_gain)),
        unit_of={name: unbroken(unit) for name, unit in units_of_torques(robot).items()},
        one_unit=has_one_torque_unit(robot),
        held_out=gain.segments if gain and gain.method != LEFT_OUT else (),
        response_unit=response_unit(robot),
        table=parameter_table(diagnosis.verdict.baseline),
        grid=[
            (view.operating_point, frf_grid_figure(view, joints)) for view in _worst(diagnosis.frf)[: len(joints) > 1]
        ],
        frfs=[
            (view.operating_point, frf_figure(view, joints, response_unit(robot))) for view in diagnosis.frf[:MAX_FRFS]
        ],
        where=where_figure(diagnosis.spectrum, joints, torque_unit(robot)) if diagnosis.spectrum else None,
        evidence={p.cause: evidence_figure(p) for p in diagnosis.evidence},
        traces=[
            (t.segment, trace_figure(t, joints, torque_units(robot), shown_joints(diagnosis.verdict, t, joints)))
            for t in diagnosis.traces[:MAX_TRACES]
        ],
    )
    path.write_text(html, encoding="utf-8")


def unbroken(text: str) -> str:
    """A text that stays on one line."""
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def parameter_table(baseline: dict[str, Value]) -> dict[str, dict[str, Value]]:
    """Baseline parameters by joint (or hinge) and kind."""
    rows: dict[str, dict[str, Value]] = {}
    for name, value in baseline.items():
        kind, place = name.split(".", 1)
        rows.setdefault(place, {})[kind] = value
    return rows


def _worst(views: tuple[FrfView, ...]) -> list[FrfView]:
    """Views by how far the baseline is from the measurement, in standard deviations."""

    def distance(view: FrfView) -> float:
        error = np.abs(view.measured - view.baseline) / np.maximum(view.measured_std, 1e-12)
        return -float(np.nanmedian(error))

    return sorted(views, key=distance)
