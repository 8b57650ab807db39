"""Real machines: import, diagnosis, references and pictures of each data set, written to docs/real-data.md.

    python benchmarks/real_data.py --data ../shared/data
    python benchmarks/real_data.py --references            # published models and plain least squares alone: no
    diagnosis

Verdicts and figures in that page are what this prints; the words about machines and publishers are below.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from provenance import commit
from published import EMPS, References, drive_found, emps_relative_error, motions, references

from ident.convert import convert_logs
from ident.dataset import Dataset
from ident.dataset_io import load_dataset, save_dataset
from ident.diagnosis import MAX_SECONDS, diagnose_fully
from ident.show.figures import shown_joints, trace_figure
from ident.units import torque_unit, torque_units, unit_suffix
from ident.verdict import Diagnosis, Gain

COLOURS = "<style>svg { --ink: #16181a; --soft: #5c666f; --line: #dfe3e6; --before: #c0492f; --after: #1f6f8b; background: #ffffff }</style>"
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
    ),
    Machine(
        "kuka_kr300_dual_encoder",
        "kr300",
        (),
        "KUKA KR 300 R2500, two encoders on three axes",
        "J. Weigand, Robot_Identification (MIT). The bodies of the simulation are guesses. Known of the machine: a hydraulic and"
        " pneumatic counterbalance on axis 2, and link encoders that come 3.0 ms after those of the motors. No model of the"
        " publishers is at hand.",
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
        (
            "exciting_traj_positions.txt",
            "exciting_traj_time.txt",
            "exciting_traj_torques.txt",
            "exciting_traj_velocity.txt",
        ),
        "Franka Panda, joint torque sensors",
        "Gaz, Cognetti, Oliva, Robuffo Giordano and De Luca, IEEE RA-L 2019 (GPL-3.0, not shipped). Their model, version 1.0, was evaluated"
        " from their published expressions along this run (its torques are not part of this project); it knows no offsets of the sensors, and is told as it is and with those of the first"
        " half of the run. They fitted it to recordings of their own, which may hold this one, held-out half and all. Friction on the"
        " side of the sensor, with loops before it slips.",
        picture=False,
    ),
    Machine(
        "staubli_tx40",
        "tx40",
        (),
        "Staubli TX40, coupled wrist",
        "figaroh-examples (Apache-2.0 by its README). A-priori Coulomb friction of its configuration, joints 1 to 6:"
        " 7.14, 8.26, 6.34, 2.48, 3.03 and 0.28 N m; viscous 8.05, 5.53, 1.97, 1.11, 1.86 and 0.65 N m s/rad.",
    ),
)


@dataclass(frozen=True)
class Outcome:
    """What is known of a machine in the end; ``seconds`` of import and diagnosis."""

    machine: Machine
    dataset: Dataset
    result: Diagnosis
    plain: References | None
    seconds: float


def converted(machine: Machine, data: Path) -> Dataset:
    """Logs of a machine through the files that a user would make of them."""
    raw = data / machine.folder / "raw"
    files = [raw / f for f in machine.files] or sorted(p for p in raw.iterdir() if p.is_file())
    with tempfile.TemporaryDirectory() as folder:
        save_dataset(convert_logs(files, machine.robot, machine.folder), Path(folder) / "d")
        return load_dataset(Path(folder) / "d")


def outcome(machine: Machine, data: Path, seconds: float) -> Outcome:
    """Import, diagnosis and references of a machine."""
    began = time.perf_counter()
    dataset = converted(machine, data)
    result = diagnose_fully(dataset, max_seconds=seconds)
    took = time.perf_counter() - began
    return Outcome(machine, dataset, result, references(dataset, data / machine.folder), took)


def table_of(plain: References, gain: Gain | None, unit: str) -> list[str]:
    """Errors of all models on held-out data, over all joints and at each, as lines of a table."""
    several = len(plain.joints) > 1
    rows = [(r.name, r.over_all, r.left) for r in plain.found]
    if gain is not None:
        each = [gain.by_joint[name] for name in plain.joints]
        rows = [("first model", gain.over_all[0], [x.before for x in each]), *rows]
        rows += [("extended model", gain.over_all[1], [x.after for x in each])]
    head = ["left on held-out data", f"all, {unit}" if several else unit, *(plain.joints if several else ())]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, over_all, left in rows:
        lines.append("| " + " | ".join([name, f"{over_all:.4g}", *(f"{x:.3g}" for x in left if several)]) + " |")
    return [*lines, ""]


def judged(plain: References, gain: Gain, unit: str) -> str:
    """Where the extended model leaves more than the best reference, in a sentence or two."""
    best, ours = plain.best, gain.over_all[1]
    side = "less than" if ours <= best.over_all else "MORE than"
    text = f"The extended model leaves {ours:.4g} {unit}, {side} the best of the references ({best.name}, {best.over_all:.4g} {unit})."
    each = zip(plain.joints, best.left, (gain.by_joint[name].after for name in plain.joints), strict=True)
    worse = [f"{name} ({x:.3g} against {ref:.3g})" for name, ref, x in each if x > ref]
    return f"{text} It leaves more than that one at {', '.join(worse)}." if worse and len(plain.joints) > 1 else text


def comparison(found: Outcome) -> list[str]:
    """Lines of the page: references beside both models, and the publishers' own figure of merit where it can be had."""
    plain, gain = found.plain, found.result.verdict.gain
    if plain is None or gain is None:
        return ["No published model, and none that is plainer than the first one.", ""]
    unit = torque_unit(found.result.robot)
    lines = [f"Compared band: 0 to {plain.band_hz:.3g} Hz. Rms torque itself: {plain.size_over_all:.4g} {unit}.", ""]
    lines += [*table_of(plain, gain, unit), judged(plain, gain, unit), ""]
    own = drive_found(found.result) if found.machine.folder == "emps_drive" else None
    if own is not None:
        (held_out,) = (m for m in motions(found.dataset) if m.role == "validation")
        published = next(r for r in plain.found if r.published)
        theirs, ours = (emps_relative_error(drive, held_out) for drive in (EMPS, own))
        lines += [
            f"The publishers' figure of merit, relative error of the force below 40 Hz by their script, on the held-out run: {theirs:.2f} % with"
            f" their parameters, {ours:.2f} % with those found here, which were fitted below {plain.band_hz:.3g} Hz, where the relative"
            f" errors are {100 * published.over_all / plain.size_over_all:.2f} and {100 * gain.over_all[1] / plain.size_over_all:.2f} %.",
            "",
        ]
    return lines


def summary(outcomes: Sequence[Outcome]) -> str:
    """The table at the head of the page."""
    head = [
        "data set",
        "band, Hz",
        "first model",
        "published model",
        "least squares",
        "extended model",
        "extended over best reference",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for found in outcomes:
        gain, plain, unit = found.result.verdict.gain, found.plain, torque_unit(found.result.robot)
        if gain is None:
            continue
        before, after = gain.over_all
        published = squares = ratio = band = "–"
        if plain is not None:
            fitted = [r.over_all for r in plain.found if not r.published]
            known = [r.over_all for r in plain.found if r.published]
            published = f"{min(known):.4g}" if known else "–"
            squares, band, ratio = f"{min(fitted):.4g}", f"{plain.band_hz:.3g}", f"{after / plain.best.over_all:.2f}"
        cells = [found.machine.title, band, f"{before:.4g} {unit}", published, squares, f"{after:.4g} {unit}", ratio]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def section(found: Outcome) -> str:
    """A machine's part of the page."""
    machine, result = found.machine, found.result
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
        lines += [
            f"Error{of} on held-out data ({g.method}): {g.before:.4g} → {g.after:.4g} {unit}{closed}; noise {g.noise_floor:.2g}.",
            "",
        ]
    lines += comparison(found)
    if v.residual_description:
        lines += [v.residual_description, ""]
    for trace in result.traces[: int(machine.picture)]:
        picture = PAGE.parent / f"{machine.folder}.svg"
        # The figures of the report take their colours from its page.
        shown = shown_joints(result.verdict, trace, result.joints)
        svg = trace_figure(trace, result.joints, torque_units(result.robot), shown).replace(
            'version="1.1">', f'version="1.1">{COLOURS}', 1
        )
        picture.write_text(svg, encoding="utf-8")
        lines += [f"![Error of the torque on held-out motion, before and after]({picture.name})", ""]
    lines += [f"{found.seconds:.0f} s.", ""]
    return "\n".join(lines)


HEAD = (
    "# Real machines\n\nWhat `simgap convert` and `simgap diagnose` make of published recordings, and what models leave that others made of them."
    " Errors are root mean squares of torque on held-out motion, in the band that is compared (its width is given in Hz), under the"
    " window that keeps the ends of a record out. All rows of a table are of the same recording, split, band, window and unit; numbers"
    " without a joint are over all joints. Written by `python benchmarks/real_data.py`, commit {commit}, two cores, with the defaults of `diagnose`.\n\n"
    "References (`benchmarks/published.py`, written apart from what `simgap` fits): models as their publishers give them, and two"
    " plain fits to the same identification data in the same band. *Least squares* has all base parameters of the rigid bodies, motor"
    " inertia, viscous and Coulomb friction and an offset of each torque; *bodies as described* has the drives and offsets alone. Of"
    " three truncations of small singular values the one that does best on the held-out data is told, which favours the reference."
    " Where a joint stands still dry friction balances the recorded torque up to its size, in these fits as in the extended model.\n\n"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument(
        "--only", default="", help="folders, comma-separated; the page is then printed, not written, and pictures are"
    )
    parser.add_argument(
        "--references", action="store_true", help="print what the references leave, and diagnose nothing"
    )
    parser.add_argument("--max-seconds", type=float, default=MAX_SECONDS)
    args = parser.parse_args()
    only = set(filter(None, args.only.split(",")))
    chosen = [m for m in MACHINES if not only or m.folder in only]
    if args.references:
        for machine in chosen:
            dataset = converted(machine, args.data)
            plain = references(dataset, args.data / machine.folder)
            if plain is not None:
                print(
                    f"{machine.title}, 0 to {plain.band_hz:.3g} Hz\n",
                    *table_of(plain, None, torque_unit(dataset.robot)),
                    sep="\n",
                )
        return
    outcomes, parts = [], []
    PAGE.parent.mkdir(exist_ok=True)
    for machine in chosen:
        outcomes.append(outcome(machine, args.data, args.max_seconds))
        parts.append(section(outcomes[-1]))
        print(parts[-1], flush=True)
    print(summary(outcomes))
    if not only:
        PAGE.write_text(HEAD.format(commit=commit()) + summary(outcomes) + "\n" + "\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
