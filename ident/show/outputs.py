"""All files of a diagnosis."""

from __future__ import annotations

from pathlib import Path

from ident.outputs import outputs_into
from ident.plan_file import plan_to_toml
from ident.show.export import write_mjcf, write_model_toml
from ident.show.recording import write_recording
from ident.show.report import write_report
from ident.verdict import Diagnosis

NEXT_PLAN = "next_plan.toml"


def write_outputs(diagnosis: Diagnosis, out: str | Path) -> None:
    """verdict.json, report.html, recording.rrd, model.toml and model.xml, and next_plan.toml where an
    experiment would separate what the data do not; all or none.
    """
    with outputs_into(out, without=(NEXT_PLAN,)) as folder:
        diagnosis.verdict.save(folder)
        write_report(diagnosis, folder / "report.html")
        write_recording(diagnosis, folder / "recording.rrd")
        write_model_toml(diagnosis, folder / "model.toml")
        write_mjcf(diagnosis, folder / "model.xml")
        if diagnosis.next_plan is not None:
            plan_to_toml(diagnosis.next_plan, folder / NEXT_PLAN)
