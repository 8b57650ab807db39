"""Real machines: import, diagnosis and pictures of each data set, written to docs/real-data.md.

    python benchmarks/real_data.py --data ../shared/data

Verdicts and figures in that page are what this prints; the words about machines and publishers are below.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from provenance import commit

from ident.convert import convert_logs
from ident.dataset_io import load_dataset, save_dataset
from ident.diagnosis import diagnose_fully
from ident.show.figures import trace_figure
from ident.units import torque_unit, torque_units, unit_suffix
from ident.verdict import Diagnosis

COLOURS = (
    "<style>svg { --ink: #16181a; --soft: #5c666f; --line: #dfe3e6; --before: #c0492f; --after: #1f6f8b; background: #ffffff }</style>"
)
PAGE = Path(__file__).parent.parent / "docs" / "real-data.md"


@dataclass(frozen=True)
class Machine:
    """A data set: folder (also the name of its map), robot, raw files (all where empty), and what is known of it.

    ``picture``: whether its licence lets a picture of the recording be shown here.
    """

    folder: str
    robot: str
    files: tuple[str, ...]
    title: str
    known: str
    max_causes: int = 3
    picture: bool = True


MACHINES = (
    Machine(
        "twomass_multisine_fditools",
        "twomass",
        ("MultisineTypeB.mat",),
        "Two-inertia bench, multisine",
        "Hori-Fujimoto Lab, FdiTools (MIT). Motor and load on a torsional coupling, random-phase odd multisine.",
    ),
    Machine(
        "emps_drive",
        "emps",
        ("DATA_EMPS.mat",),
        "EMPS, linear drive with ball screw",
        "Janot, Gautier and Brunot, Data Set and Reference Models of EMPS, 2019. Their least-squares model: mass 95.1 kg,"
        " viscous 203.5 N s/m, Coulomb friction 20.39 N with an offset of -3.16 N (-0.155 of it). The publishers' data also"
        " show a torque ripple tied to the position of the screw and friction that yields before it slips.",
        2,
    ),
    Machine(
        "kuka_kr300_dual_encoder",
        "kr300",
        (),
        "KUKA KR 300 R2500, two encoders on three axes",
        "J. Weigand, Robot_Identification (MIT). The bodies of the simulation are guesses. Known of the machine: a hydraulic and"
        " pneumatic counterbalance on axis 2, and link encoders that come 3.0 ms after those of the motors. No model of the"
        " publishers is at hand; a rigid model with friction, by least squares on two other runs, leaves 31 to 393 N m at the axes of"
        " a third (213 N m over all, link side, the whole band).",
        2,
    ),
    Machine(
        "ur10_unisa",
        "ur10_bare",
        (),
        "UR10, low-passed at 2 Hz",
        "University of Salerno, inverse-dynamics-solver (BSD-3-Clause); Petrone, Ferrentino and Chiacchio, IEEE TII 2025."
        " Coulomb and viscous friction are what its publishers find.",
    ),
    Machine(
        "panda_gaz_ral2019",
        "panda_bare",
        ("exciting_traj_positions.txt", "exciting_traj_time.txt", "exciting_traj_torques.txt", "exciting_traj_velocity.txt"),
        "Franka Panda, joint torque sensors",
        "Gaz, Cognetti, Oliva, Robuffo Giordano and De Luca, IEEE RA-L 2019 (GPL-3.0, not shipped). Their model leaves 0.06 to"
        " 0.33 N m on this run, sensor offsets of up to 0.4 N m in it; base parameters and friction fitted to the run itself leave 0.05 to"
        " 0.14 N m (the whole band). Friction on the side of the sensor, with loops before it slips.",
        1,
        picture=False,
    ),
    Machine(
        "staubli_tx40",
        "tx40",
        (),
        "Staubli TX40, coupled wrist",
        "figaroh-examples (Apache-2.0 by its README). A-priori Coulomb friction of its configuration, joints 1 to 6:"
        " 7.14, 8.26, 6.34, 2.48, 3.03 and 0.28 N m; viscous 8.05, 5.53, 1.97, 1.11, 1.86 and 0.65 N m s/rad.",
        1,
    ),
)


def diagnosed(machine: Machine, data: Path, seconds: float) -> Diagnosis:
    """Logs of a machine through the files that a user would make of them."""
    raw = data / machine.folder / "raw"
    files = [raw / f for f in machine.files] or sorted(p for p in raw.iterdir() if p.is_file())
    with tempfile.TemporaryDirectory() as folder:
        save_dataset(convert_logs(files, machine.robot, machine.folder), Path(folder) / "d")
        dataset = load_dataset(Path(folder) / "d")
        return diagnose_fully(dataset, max_causes=machine.max_causes, max_seconds=seconds)


def section(machine: Machine, result: Diagnosis, seconds: float) -> str:
    """A machine's part of the page."""
    v = result.verdict
    lines = [f"## {machine.title}", "", machine.known, "", f"**Verdict.** {v.sentence}", ""]
    lines += [f"{note}\n" for note in v.notes]
    if v.causes:
        lines += ["| cause | place | probability | parameters |", "|---|---|---|---|"]
        for c in v.causes:
            values = ", ".join(f"{k} {x.value:.4g} ± {x.std:.1g}{unit_suffix(x.unit)}" for k, x in c.parameters.items())
            lines.append(f"| {c.effect.replace('_', ' ')} | {c.joint} | {c.probability:.2f} | {values} |")
        lines.append("")
    if v.gain is not None:
        g = v.gain
        closed = "" if g.gap_closed is None else f", {g.gap_closed:.1%} of the gap to the noise"
        if g.gap_closed is not None and g.ci95 is not None:
            closed += f" (95 %: {g.ci95[0]:.1%} to {g.ci95[1]:.1%})"
        unit = torque_unit(result.robot)
        of = f" of {', '.join(g.joints)}" if g.of_some else ""
        lines += [f"Error{of} on held-out data ({g.method}): {g.before:.4g} → {g.after:.4g} {unit}{closed}; noise {g.noise_floor:.2g}.", ""]
        if len(g.by_joint) > 1:
            each = ", ".join(f"{name} {x.before:.3g} → {x.after:.3g}" for name, x in g.by_joint.items())
            lines += [f"All joints: {g.over_all[0]:.4g} → {g.over_all[1]:.4g} {unit}; {each}.", ""]
    if v.residual_description:
        lines += [v.residual_description, ""]
    for trace in result.traces[: int(machine.picture)]:
        picture = PAGE.parent / f"{machine.folder}.svg"
        # The figures of the report take their colours from its page.
        svg = trace_figure(trace, result.joints, torque_units(result.robot)).replace('version="1.1">', f'version="1.1">{COLOURS}', 1)
        picture.write_text(svg, encoding="utf-8")
        lines += [f"![Error of the torque on held-out motion, before and after]({picture.name})", ""]
    lines += [f"{seconds:.0f} s with `--max-causes {machine.max_causes}`.", ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--only", default="", help="folders, comma-separated; the page is then printed, not written, and pictures are")
    parser.add_argument("--max-seconds", type=float, default=300.0)
    args = parser.parse_args()
    only = set(filter(None, args.only.split(",")))
    parts = []
    PAGE.parent.mkdir(exist_ok=True)
    for machine in MACHINES:
        if only and machine.folder not in only:
            continue
        began = time.perf_counter()
        result = diagnosed(machine, args.data, args.max_seconds)
        parts.append(section(machine, result, time.perf_counter() - began))
        print(parts[-1], flush=True)
    if not only:
        head = (
            "# Real machines\n\nWhat `simgap convert` and `simgap diagnose` make of published recordings. Errors are root mean squares"
            " in the band that is compared, over the joints that carry most of the discrepancy as far as they are named, and over all.\n"
            f"Written by `python benchmarks/real_data.py`, commit {commit()}, two cores.\n\n"
        )
        PAGE.write_text(head + "\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
