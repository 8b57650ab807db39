"""A first map of a log, guessed from names, shapes and ranges, for a person to edit.

``guess_files`` says what the files hold together, ``guess_names`` what a signal may be by its name, ``guess_units`` in
which unit and on which side of the gear, ``guess_time`` which one is the time; ``guess_text`` writes it down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ident.convert.guess_files import ReadLog, read_together
from ident.convert.guess_names import choose, families_of, score, words_of
from ident.convert.guess_order import joint_column
from ident.convert.guess_text import Guess, plain, render
from ident.convert.guess_time import FoundTime, find_time, is_time
from ident.convert.guess_units import Family, guess_scales, unwrapped
from ident.convert.reading import Survey, is_text, survey_log
from ident.convert.spelling import split_unit
from robot_assets.errors import DataError
from robot_assets.robot import Robot, linear_joints, load_robot

LONGEST_LIST = 300  # characters of the names in an error


@dataclass(frozen=True)
class GuessedMap:
    """The text of a map.

    Attributes:
        found: channel -> what was taken for it, in words.
        missing: required channels for which nothing was found: the map needs them.
        warnings: why something that is in the log was not used, in words.
    """

    text: str
    found: dict[str, str]
    missing: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def guess_map(
    files: Sequence[Path], robot: str | Path, *, encoding: str = "", progress: Callable[[str], None] = lambda text: None
) -> GuessedMap:
    """Guess the map of one or more logs of a robot.

    Args:
        encoding: of texts; empty where they tell it themselves.
        progress: told in words what is being done.

    Raises:
        DataError: for a log or robot that cannot be read, or where no signal is long enough.
    """
    arm = load_robot(robot)
    paths = [Path(f) for f in files]
    if not paths:
        raise DataError("files", "command line", "none", "at least one log")
    surveys = []
    for path in paths:
        progress(f"reading {path.name}")
        surveys.append(survey_log(path, encoding))
    progress("guessing the map")
    log = read_together(paths, surveys, arm)
    signals = log.long_signals() if log.parts else _one_time(log.long_signals())
    families = families_of(signals, log.units, arm, log.lists, log.unread)
    if log.clocks:
        time = FoundTime(rate=min(c.rate for c in log.clocks.values()))
    else:
        time = find_time(families, log.signals, log.dates, log.damaged, log.doubts)
    of_joints = [f for f in families if f.x.shape[1] == arm.n and f.name not in time.sources | log.dates]
    chosen, others = choose(of_joints, arm)
    if not {"tau", "q"} & set(chosen):
        raise _unlike_a_log(paths[0], surveys[0], families, time, arm)
    linear = linear_joints(arm)
    if not np.any(linear):
        chosen = {c: unwrapped(f) if c in ("q", "q_ref", "q_link") else f for c, f in chosen.items()}
    scales = guess_scales(chosen, arm, linear, time.rate)
    text = render(
        Guess(
            paths=paths,
            arm=arm,
            parts=log.parts,
            clocks=log.clocks,
            time=time,
            chosen=chosen,
            others=others,
            scales=scales,
            families=families,
            linear=linear,
            doubts=log.doubts,
            encoding=_common_encoding(paths, surveys),
        )
    )
    found = {c: ", ".join((f.name, *scales[c].options)) for c, f in chosen.items()} | _found_time(log, time)
    missing = tuple(c for c in ("tau", "q") if c not in chosen)
    return GuessedMap(text, found, missing, tuple(_warnings(log, time, chosen, missing)))


def _one_time(signals: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Signals of one file without repetitions of a time: structures of MATLAB have one each."""
    times: list[np.ndarray] = []
    out = {}
    for name, x in signals.items():
        if is_time(name):
            if any(np.array_equal(x.ravel(), t) for t in times):
                continue
            times.append(x.ravel())
        out[name] = x
    return out


def _common_encoding(paths: Sequence[Path], surveys: Sequence[Survey]) -> str:
    """The encoding of all texts; empty where they have several, each of which its file tells."""
    found = {s.encoding for path, s in zip(paths, surveys, strict=True) if is_text(path)}
    return found.pop() if len(found) == 1 else ""


def _unlike_a_log(path: Path, survey: Survey, families: Sequence[Family], time: FoundTime, arm: Robot) -> DataError:
    """What to say of a log in which neither a position nor a torque of all joints is found."""
    long = joint_column(survey.labels, survey.signals, arm.joint_names) if arm.n > 1 else None
    if long is not None:
        column, joint = (plain(x) for x in long)
        return DataError(
            "rows",
            str(path),
            f"rows of one joint each: {column} holds {joint}",
            f"a row for each time with columns for all joints: pivot the table by {column}",
        )
    names = ", ".join(plain(f.name) for f in families if f.name not in time.sources)
    return DataError(
        "signals",
        str(path),
        f"nothing that looks like a position or a torque of {arm.n} joints: {names[:LONGEST_LIST] or 'none'}",
        "names or units that tell, or a map by hand",
    )


def _found_time(log: ReadLog, time: FoundTime) -> dict[str, str]:
    """What was taken for the time, in words."""
    if log.clocks:
        sources = ", ".join(c.name for c in log.clocks.values())
    elif time.source is not None:
        sources = " + ".join((time.source, *(name for name, _ in time.plus)))
    else:
        return {}
    return {"time": f"{sources}, {time.rate:g} Hz" + (f"; {time.doubt}" if time.doubt else "")}


def _warnings(log: ReadLog, time: FoundTime, chosen: Mapping[str, Family], missing: Sequence[str] = ()) -> list[str]:
    """What a person should know about a guess, in words; of channels that are missing too."""
    lost = [] if time.lost is None else [f"no time: {time.lost[0]} {time.lost[2]}"]
    used = [name for family in chosen.values() for name, _ in family.sources if name in log.doubts]
    sought = [
        name
        for name in log.doubts
        if name not in used and any(_may_be(name, channel, log.units.get(name)) for channel in missing)
    ]
    sought += [name for name in log.doubts if time.source is None and name not in log.signals and is_time(name)]
    return [
        *lost,
        *log.warnings,
        *(f"{name} {log.doubts[name]}: the conversion will name it" for name in used),
        *(f"{plain(name)} has {plain(log.doubts[name])}: not used" for name in dict.fromkeys(sought)),
    ]


def _may_be(name: str, channel: str, unit: str | None) -> bool:
    """Whether a signal may be one of a channel, by its name and unit."""
    stem, own = split_unit(name)
    return score(words_of(stem), channel, unit or own) > 0
