"""The command line: thin. Results to stdout, progress to stderr."""

from __future__ import annotations

import errno
import json
import secrets
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from robot_assets.errors import DataError
from robot_assets.values import exists

if TYPE_CHECKING:
    from ident.verdict import Diagnosis

NARROW = 80  # columns, below which the tables of rich cut the names of options
app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="Find what a robot simulation gets wrong.",
    rich_markup_mode=None if shutil.get_terminal_size().columns < NARROW else "rich",
)
Json = Annotated[bool, typer.Option("--json", help="Print the machine-readable result alone.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress.")]
Out = Annotated[Path, typer.Option("--out", help="Where to write.")]
INTERRUPTED = 130  # exit status, as of a command that SIGINT ended
FRF_ESTIMATORS = "auto, h1, jio, ari, har, log; lpm or lrm for fewer experiments than inputs."


def main() -> None:
    """Run; bad input ends in one line on stderr and exit status 2, an interrupt in one and 130."""
    try:
        # Without its own mode typer returns the status of what ends early; an interrupt has become such an end.
        status = app(standalone_mode=False)
    except DataError as err:
        sys.exit(_fail(str(err)))
    except (typer.Abort, KeyboardInterrupt):
        sys.exit(_fail("interrupted", INTERRUPTED))
    except Exception as err:
        if isinstance(err, OSError) and err.errno == errno.ENAMETOOLONG:  # of whatever path the command was given
            sys.exit(_fail(f"path: {err.filename}: found a name that is too long, expected one that a file can have"))
        if type(err).__name__ == "NoArgsIsHelpError":
            sys.exit(_fail("no command: one of those above is expected"))
        if type(err).__module__.startswith(("click", "typer")):
            sys.exit(_fail(err.format_message() if hasattr(err, "format_message") else str(err)))
        raise
    if status == INTERRUPTED:
        _fail("interrupted")
    if status:
        sys.exit(status)


def _fail(text: str, status: int = 2) -> int:
    print("simgap: " + " ".join(text.split()), file=sys.stderr)
    return status


@contextmanager
def _progress(quiet: bool) -> Iterator[tuple[Callable[[str], None], Callable[[float], None]]]:
    """Two reporters, of text and of a share done: a bar where stderr is a terminal."""
    console = Console(stderr=True)
    if quiet:
        yield (lambda text: None), (lambda share: None)
    elif console.is_terminal:
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console) as bar:
            task = bar.add_task("", total=None)
            yield (
                lambda text: bar.update(task, description=text),
                lambda share: bar.update(task, total=1.0, completed=share),
            )
    else:
        last = [-1]

        def say(text: str) -> None:
            sys.stderr.write(f"{text}\n")  # a line at once: pieces of work tell of themselves from several threads

        def share(done: float) -> None:
            if int(done * 10) > last[0]:
                last[0] = int(done * 10)
                say(f"simulated {done:.0%}")

        yield say, share


def _robot(name: str):
    from robot_assets.robot import load_robot

    return load_robot(name)


def _plan(robot, points: int, realizations: int, seed: int, levels: tuple[float, ...]):
    import numpy as np

    from ident.excitation import operating_points
    from sim.experiment import plan_experiment

    postures = operating_points(robot, points + 1, np.random.default_rng(seed))
    return plan_experiment(robot, postures, points=points, realizations=realizations, levels=levels, seed=seed)


@app.command()
def experiment(
    robot: str,
    out: Out,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="NAME@PLACE:key=value with more keys behind commas; several hide several. Without keys they have sizes of their own. Names, places, keys: docs/effects.md.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of excitation, noise and drives.")] = 0,
    realizations: Annotated[int | None, typer.Option(min=1, max=1000, show_default="1, or of the plan")] = None,
    points: Annotated[
        int | None,
        typer.Option(
            min=1, max=1000, help="Operating points for identification.", show_default="2, or those of the plan"
        ),
    ] = None,
    drives: Annotated[str, typer.Option(help='"nominal", or "drawn" within a factor of two.')] = "nominal",
    plan: Annotated[
        Path | None, typer.Option(help="A plan written by `simgap design`, or next_plan.toml of a diagnosis.")
    ] = None,
    one_recording: Annotated[
        bool,
        typer.Option(
            "--one-recording",
            help="All operating points in one run, moves between them included; cut into the dataset.",
        ),
    ] = False,
    link_encoders: Annotated[
        bool, typer.Option("--link-encoders", help="Record link encoders; done anyway where an effect sits in one.")
    ] = False,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Run the closed-loop multisine experiment on the MuJoCo plant and write a dataset."""
    import numpy as np

    from ident.dataset_io import check_target, save_dataset
    from ident.plan_file import plan_from_toml
    from sim import parse_effect, run_experiment
    from sim.experiment import draw_drives

    for option, given in (("--points", points), ("--realizations", realizations)):
        if plan is not None and given is not None:
            raise DataError(option, "command line", f"{given} beside --plan", "one of the two: the plan decides it")
    arm = _robot(robot)
    if drives not in ("nominal", "drawn"):
        raise DataError("--drives", "command line", drives, '"nominal" or "drawn"')
    hidden = [parse_effect(text, arm) for text in effect or []]
    figures = draw_drives(np.random.default_rng(seed + 1000), arm) if drives == "drawn" else None
    made = plan_from_toml(plan) if plan else _plan(arm, points or 2, realizations or 1, seed, (1.0, 0.5, 0.25))
    if made.robot.folder != arm.folder:
        raise DataError("--plan", str(plan), f"a plan for {made.robot.name}", f"one for {arm.name}")
    _check_out(check_target(out))
    run: dict[str, Any] = {"seed": seed, "drives": figures, "name": out.name, "link_encoders": link_encoders}
    summary: dict[str, Any] = {"dataset": str(out)}
    text = ""
    with _progress(quiet or json_) as (_, share):
        if one_recording:
            data, spent = _one_recording(made, hidden, progress=share, **run)
            summary["samples"], text = asdict(spent) | {"total": spent.total}, spent.text() + "\n"
        else:
            data = run_experiment(made, hidden, progress=share, **run)
    save_dataset(data, out)
    _print(summary | {"segments": len(data.segments)}, json_, f"{text}{len(data.segments)} segments in {out}")


def _one_recording(plan, effects, **run):
    """(dataset cut from one run of the plan, what its samples were spent on)."""
    from ident.cutting import cut_recording, schedule_plan, usage
    from sim.recording import run_recording

    schedule = schedule_plan(plan)
    return cut_recording(run_recording(schedule, effects, **run), schedule), usage(schedule)


@app.command()
def merge(
    datasets: list[Path],
    out: Out,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Several datasets of one robot as one, as the first data and those of next_plan.toml."""
    from ident.dataset_io import check_target, load_dataset, save_dataset
    from ident.merging import merged

    _check_out(check_target(out))
    data = merged([load_dataset(path) for path in datasets], name=out.name)
    save_dataset(data, out)
    points = len({s.operating_point for s in data.segments} - {None})
    _print(
        {"dataset": str(out), "segments": len(data.segments), "operating_points": points},
        json_,
        f"{len(data.segments)} segments at {points} operating points in {out}",
    )


@app.command()
def check(dataset: Path, json_: Json = False, quiet: Quiet = False) -> None:
    """Validate a dataset and print what it holds."""
    from ident.checking import inspect_dataset
    from ident.dataset_io import load_dataset

    report = inspect_dataset(load_dataset(dataset))
    _print(report.to_dict(), json_, report.text())


@app.command()
def frf(
    dataset: Path,
    out: Out,
    estimator: Annotated[str, typer.Option(help=FRF_ESTIMATORS)] = "auto",
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Nonparametric FRFs, covariances and nonlinear distortion levels."""
    from ident.dataset_io import load_dataset
    from ident.frf_output import write_frf

    data = load_dataset(dataset)
    _check_out(out)
    summary = write_frf(data, out, estimator)
    spare = summary["not_used"]
    without = (
        f"; not used: {len(spare)} segments in sets of fewer experiments than inputs, {spare[0]} first" if spare else ""
    )
    _print(summary, json_, f"FRFs of {len(summary['operating_points'])} operating points in {out}{without}")


@app.command()
def identify(
    dataset: Path,
    out: Out,
    estimator: Annotated[str, typer.Option(help="wlls, lls, wnls, nls (FRF), or ml (torque residual).")] = "wlls",
    frf: Annotated[str, typer.Option("--frf", help=FRF_ESTIMATORS)] = "auto",
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Gray-box parameters with standard deviations and correlations."""
    from ident.dataset_io import load_dataset
    from ident.identify_output import identify_and_write

    data = load_dataset(dataset)
    _check_out(out)
    with _progress(quiet or json_) as (say, _):
        result = identify_and_write(data, out, estimator, say, frf)
    _print(result, json_, _parameter_table(result["parameters"]))


@app.command()
def design(
    robot: str,
    out: Annotated[Path, typer.Option("--out", help="The plan, for `simgap experiment --plan`.")],
    points: Annotated[int, typer.Option(min=1, max=1000, help="Operating points for identification.")] = 15,
    candidates: Annotated[int, typer.Option(min=1, max=1_000_000, help="Postures to choose from.")] = 8000,
    criterion: Annotated[str, typer.Option(help="D, A or E.")] = "D",
    draws: Annotated[
        int, typer.Option(min=1, max=1000, help="Of the parameters from a prior; 1: the nominal ones.")
    ] = 1,
    level: Annotated[list[float] | None, typer.Option(help="Excitation level; several, largest first.")] = None,
    realizations: Annotated[int, typer.Option(min=1, max=1000)] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of candidates and excitation.")] = 0,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Optimal operating points and excitation for the next experiment."""
    from ident.design_output import write_design

    arm = _robot(robot)
    options = {"points": points, "candidates": candidates, "criterion": criterion, "draws": draws, "seed": seed}
    _check_out(out.absolute().parent)
    with _progress(quiet or json_) as (say, _):
        summary, text = write_design(arm, out, tuple(level or (1.0,)), say, realizations=realizations, **options)
    _print(summary, json_, text)


@app.command()
def diagnose(
    dataset: Path,
    out: Out,
    max_causes: Annotated[int, typer.Option(min=0)] = 4,
    max_seconds: Annotated[
        float, typer.Option(min=0.0, help="After which no further search for causes begins.")
    ] = 480.0,
    executor: Annotated[
        str, typer.Option(help="Where candidates are fitted: threads, processes, processes:N or dask://HOST:PORT.")
    ] = "threads",
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Everything: verdict.json, report.html, recording.rrd, model.toml and model.xml."""
    from ident.dataset_io import load_dataset
    from ident.diagnosis import diagnose_fully
    from ident.parallel import open_executor
    from ident.show.outputs import write_outputs

    data = load_dataset(dataset)
    _check_out(out)
    with open_executor(executor) as pool, _progress(quiet or json_) as (say, _):
        result = diagnose_fully(data, max_causes=max_causes, max_seconds=max_seconds, progress=say, executor=pool)
        say("writing report and recording")
        write_outputs(result, out)
    _print(result.verdict.to_dict(), json_, _verdict_text(result, out))


@app.command()
def demo(
    out: Out,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of the hidden effect and everything else; drawn where absent.")
    ] = None,
    real: Annotated[str | None, typer.Option(help="Diagnose shipped real data instead, by name.")] = None,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """A UR10 experiment with an effect drawn at random and hidden, and its diagnosis."""
    import numpy as np

    from ident.dataset_io import load_dataset, save_dataset
    from ident.diagnosis import diagnose_fully
    from ident.show.outputs import write_outputs
    from sim import draw_effect, run_experiment
    from sim.effects import parameters_of
    from sim.experiment import draw_drives

    if real is not None and seed is not None:
        raise DataError("--seed", "command line", f"{seed} beside --real", "one of the two: real data are not drawn")
    _check_out(out)
    if real is not None:
        return _demo_real(real, out, json_, quiet)
    seed = secrets.randbelow(100_000) if seed is None else seed
    rng = np.random.default_rng(seed)
    arm = _robot("ur10")
    hidden = draw_effect(rng, arm, names=DEMO_EFFECTS)
    figures = draw_drives(rng, arm)
    with _progress(quiet or json_) as (say, share):
        say(f"seed {seed}: simulating the plant with a hidden effect")
        data = run_experiment(
            _plan(arm, 2, 1, seed, DEMO_LEVELS),
            [hidden],
            seed=seed,
            drives=figures,
            name=f"demo-{seed}",
            progress=share,
        )
        with tempfile.TemporaryDirectory() as folder:
            save_dataset(data, Path(folder) / "dataset")
            data = load_dataset(Path(folder) / "dataset")
            result = diagnose_fully(data, progress=say)
        say("writing report and recording")
        write_outputs(result, out)
    parameters = parameters_of(hidden)
    truth = {"effect": hidden.name, "place": hidden.place, "parameters": parameters}
    shown = ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in parameters.items())
    text = _verdict_text(result, out) + f"\nTruth (seed {seed}): {hidden.name} at {hidden.place}, {shown}"
    _print({"seed": seed, "truth": truth, "verdict": result.verdict.to_dict()}, json_, text)


DEMO_LEVELS = (1.0, 0.4)  # of the excitation: two tell linear effects from others, in less time than three
DEMO_EFFECTS = (
    "coulomb_friction",
    "cogging",
    "torque_constant",
    "torque_delay",
    "hardening_stiffness",
    "payload",
)


def _demo_real(name: str, out: Path, json_: bool, quiet: bool) -> None:
    from ident.dataset_io import load_dataset
    from ident.diagnosis import diagnose_fully
    from ident.show.outputs import write_outputs

    shipped = Path(__file__).parent / "real"
    known = sorted(p.parent.name for p in shipped.glob("*/dataset.toml"))
    if name not in known:
        raise DataError("--real", "command line", name, f"one of {known}")
    data = load_dataset(shipped / name)
    with _progress(quiet or json_) as (say, _):
        result = diagnose_fully(data, progress=say)
        write_outputs(result, out)
    _print(result.verdict.to_dict(), json_, _verdict_text(result, out))


@app.command("robot")
def robot_folder(
    urdf: Path,
    out: Out,
    lock: Annotated[
        list[str] | None, typer.Option("--lock", help="JOINT or JOINT=POSITION: does not move; several lock several.")
    ] = None,
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """A robot folder from a URDF, with starting guesses of the drives to edit."""
    from robot_assets.from_urdf import write_robot

    locked: dict[str, float | None] = {}
    for entry in lock or []:
        name, given, value = entry.partition("=")
        try:
            locked[name] = float(value) if given else None
        except ValueError as err:
            raise DataError("--lock", "command line", entry, "JOINT or JOINT=POSITION") from err
    made, warnings = write_robot(urdf, out, locked)
    rows = [f"{made.n} driven joints in {out / 'robot.toml'}; edit the figures marked GUESS"]
    rows += [
        f"  {j.name}: {j.torque_limit:.4g} torque limit, {j.motor_inertia:.3g} motor inertia, {j.stiffness:.3g} stiffness"
        for j in made.joints
    ]
    result = {"robot": str(out), "joints": list(made.joint_names), "locked": made.locked, "warnings": list(warnings)}
    _print(result, json_, "\n".join([*rows, *(f"warning: {w}" for w in warnings)]))


@app.command()
def convert(
    files: list[Path],
    robot: Annotated[str, typer.Option(help="A name in robot_assets or a robot folder.")],
    map_: Annotated[
        Path,
        typer.Option(
            "--map", help="Which columns hold what: a file, or a shipped map by name; with --guess, the file to write."
        ),
    ],
    out: Annotated[Path | None, typer.Option("--out", help="Where to write the dataset.")] = None,
    guess: Annotated[
        bool, typer.Option("--guess", help="Write a first map to edit, from names, shapes and ranges.")
    ] = False,
    encoding: Annotated[
        str, typer.Option(help="Of text logs, with --guess, which writes it into the map: where names are no UTF-8.")
    ] = "",
    json_: Json = False,
    quiet: Quiet = False,
) -> None:
    """Real logs (CSV, text, Parquet, MATLAB, NPZ, MCAP and rosbag2 with JointState) into the dataset format."""
    from ident.convert import convert_logs
    from ident.dataset_io import check_target, save_dataset

    if guess:
        return _guess(files, robot, map_, encoding, json_, quiet)
    if encoding:
        raise DataError("--encoding", "command line", "no --guess", f'encoding = "{encoding}" in the map')
    if out is None:
        raise DataError("--out", "command line", "no such option", "where to write the dataset, or --guess")
    check_target(out)
    notes: list[str] = []
    with _progress(quiet or json_ or _soon_read(files)) as (say, _):
        data = convert_logs(files, robot, map_, name=out.name, say=notes.append, progress=say)
        say(f"writing {out}")
        save_dataset(data, out)
    text = "\n".join([f"{len(data.segments)} segments in {out}", *(f"  {note}" for note in notes)])
    _print({"dataset": str(out), "segments": len(data.segments), "changed": notes}, json_, text)


LARGE_LOG = 50e6  # bytes, below which a log is read before progress could be read


def _soon_read(files: list[Path]) -> bool:
    return sum(f.stat().st_size for f in files if exists(f)) < LARGE_LOG


def _guess(files: list[Path], robot: str, out: Path, encoding: str, json_: bool, quiet: bool) -> None:
    from ident.convert.encoding import known_encoding
    from ident.convert.guess import guess_map

    stated = known_encoding(encoding, "--encoding", "command line") if encoding else ""
    if out.exists():
        raise DataError("--map", str(out), "a file that is there already", "a new file: --guess overwrites no map")
    with _progress(quiet or json_ or _soon_read(files)) as (say, _):
        guessed = guess_map(files, robot, encoding=stated, progress=say)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        beside = out.with_name(f".{out.name}.part")
        beside.write_text(guessed.text, encoding="utf-8")
        beside.replace(out)
    except OSError as err:
        raise DataError("--map", str(out), str(err.strerror or err), "a file that can be written") from err
    rows = [f"first map in {out}; check it, above all the lines marked EDIT"]
    rows += [f"  {channel}: {what}" for channel, what in guessed.found.items()]
    rows += [f"warning: {text}" for text in guessed.warnings]
    rows += [f"warning: nothing looks like {channel}: name it in the map" for channel in guessed.missing]
    result = {
        "map": str(out),
        "found": guessed.found,
        "missing": list(guessed.missing),
        "warnings": list(guessed.warnings),
    }
    _print(result, json_, "\n".join(rows))


@app.command()
def show(folder: Path) -> None:
    """Open the recording of a diagnosis in the rerun viewer."""
    import subprocess

    from ident.show.recording import check_recording

    recording = folder / "recording.rrd"
    check_recording(recording)
    raise typer.Exit(subprocess.call([sys.executable, "-m", "rerun", str(recording)]))


def _check_out(out: Path) -> None:
    there = next(p for p in (out, *out.absolute().parents) if p.exists())
    if not there.is_dir():
        raise DataError("--out", str(out), "a file" if there == out else f"{there}, which is a file", "a folder")
    try:
        # Tried, since rights alone do not tell: the whole job would be done for nothing.
        with tempfile.TemporaryDirectory(dir=there, prefix=".simgap-"):
            pass
    except OSError as err:
        raise DataError("--out", str(out), f"{there}, in which nothing can be written", "a folder") from err


def _print(data: dict[str, Any], json_: bool, text: str) -> None:
    print(json.dumps(data, indent=2) if json_ else text)


def _verdict_text(diagnosis: Diagnosis, out: Path) -> str:
    from ident.units import has_one_torque_unit, torque_unit, unit_suffix

    verdict = diagnosis.verdict
    lines = [verdict.sentence]
    for cause in verdict.causes:
        values = ", ".join(f"{k} {v.told:.4g} ± {v.std:.2g}{unit_suffix(v.unit)}" for k, v in cause.parameters.items())
        lines.append(f"  {cause.effect} at {cause.joint}, probability {cause.probability:.3f}: {values}")
        lines += [f"    or {a.effect} at {a.joint}, {a.probability:.3f}" for a in cause.alternatives]
    if verdict.gain is not None:
        g = verdict.gain
        of = f" at {', '.join(g.joints)}" if g.of_some else ""
        told = g.of_some and has_one_torque_unit(diagnosis.robot)
        over_all = f"; of all joints {g.over_all[0]:.4g} -> {g.over_all[1]:.4g}" if told else ""
        unit = torque_unit(diagnosis.robot, g.joints)
        lines.append(
            f"Torque error on held-out data{of}: {g.before:.4g} -> {g.after:.4g} {unit}, noise {g.noise_floor:.4g}{over_all}"
        )
    lines.append(f"Unexplained: {verdict.unexplained_verdict} ({verdict.unexplained_share:.2%})")
    if verdict.residual_description:
        lines.append(verdict.residual_description)
    lines += verdict.notes
    if verdict.next_experiment:
        lines.append(verdict.next_experiment)
    return "\n".join([*lines, f"Report: {out / 'report.html'}"])


def _parameter_table(parameters: dict[str, dict]) -> str:
    table = Table("parameter", "value", "sigma", "sigma %", "unit")
    for name, v in parameters.items():
        share = 100 * v["std"] / abs(v["value"]) if v["value"] else float("nan")
        table.add_row(name, f"{v['value']:.6g}", f"{v['std']:.2g}", f"{share:.2g}", v["unit"])
    console = Console(width=100)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


if __name__ == "__main__":
    main()
