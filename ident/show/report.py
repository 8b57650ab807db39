"""report.html: one self-contained page."""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, select_autoescape

from ident.show.figures import evidence_figure, frf_figure, trace_figure, where_figure
from ident.verdict import Diagnosis

MAX_FRFS = 3
MAX_TRACES = 2


def write_report(diagnosis: Diagnosis, path: Path) -> None:
    """Render the template with the figures of a diagnosis."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=select_autoescape(["j2", "html"])
    )
    joints = diagnosis.joints
    html = environment.get_template("report.html.j2").render(
        d=diagnosis,
        v=diagnosis.verdict,
        frfs=[(view.operating_point, frf_figure(view, joints)) for view in diagnosis.frf[:MAX_FRFS]],
        where=where_figure(diagnosis.spectrum, joints) if diagnosis.spectrum else None,
        evidence={p.cause: evidence_figure(p) for p in diagnosis.evidence},
        traces=[(t.segment, trace_figure(t, joints)) for t in diagnosis.traces[:MAX_TRACES]],
    )
    path.write_text(html, encoding="utf-8")
