"""Maps: every key odd, files that are no map."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path

import tomlkit

from tests.hostile import sound
from tests.hostile.case import ACCEPTED, REFUSED, Case

WRONG = {
    "nothing": [], "a truth": True, "a text": "x", "no text": "", "a negative": -1, "zero": 0, "NaN": float("nan"),
    "infinity": float("inf"), "a huge number": 10**40, "a long text": "y" * 5000, "a path": "../../etc/passwd",
    "a table": {"a": 1}, "control characters": "a\n\x1b[2Jb",
}  # fmt: skip
# Key -> (path in the map, values of WRONG that are sound there).
KEYS: dict[tuple[str | int, ...], set[str]] = {
    ("sample_rate",): set(),
    ("input_hold",): set(),
    ("time", "source"): set(),
    ("time", "unit"): set(),
    ("time", "plus"): {"nothing"},
    ("time", "nonsense"): set(),
    ("multisine", "nonsense"): set(),
    ("columns",): set(),
    ("columns", "q_1"): set(),
    ("columns", "q_1", "source"): set(),
    ("columns", "q_1", "unit"): set(),
    ("columns", "q_1", "sign"): {"a negative"},
    ("columns", "q_1", "scale"): {"a negative"},
    ("columns", "q_1", "offset"): {"a negative", "zero"},
    ("columns", "q_1", "gear"): {"a negative"},
    ("columns", "q_1", "side"): set(),
    ("columns", "q_1", "torque_constant"): {"a negative"},
    ("columns", "q_1", "index"): {"zero"},
    ("columns", "q_1", "unwrap"): {"a truth"},
    ("columns", "q_1", "plus"): {"nothing"},
    ("columns", "q_9"): set(WRONG) & set(),
    ("files",): set(),
    ("files", "pos"): set(),
    ("roles",): set(),
    ("roles", "log"): set(),
    ("split",): set(),
    ("multisine",): set(),
    ("multisine", "period"): set(),
    ("multisine", "part"): set(),
    ("multisine", "excited_lines"): {"nothing"},
    ("multisine", "excited_from"): set(),
    ("multisine", "excited_threshold"): {"zero"},
    ("multisine", "operating_point"): {"a text", "a long text", "a path", "control characters"},
    ("nonsense",): set(),
}
BARE = {
    "files": {"pos": "log.csv"},
    "multisine": {"period": 100, "part": [{"first": 1, "last": 2}], "excited_lines": [3, 5]},
}


def cases() -> Iterator[Case]:
    """All of them."""
    for path, fine in KEYS.items():
        for name, value in WRONG.items():
            yield map_case(f"map {'.'.join(map(str, path))} {name}", path, value, ACCEPTED if name in fine else REFUSED)
    yield from texts()


def map_case(id_: str, path: tuple, value, outcome: str) -> Case:
    def make(folder: Path) -> list[str]:
        (folder / "log.csv").write_bytes(sound.log_bytes(".csv"))
        data = tomllib.loads(sound.MAP)
        data["columns"]["q_1"] = {"source": "x1"}
        inner = data
        for key in path[:-1]:
            inner = inner.setdefault(key, deepcopy(BARE.get(key, {})))
        inner[path[-1]] = value
        return sound.convert(folder, "log.csv", map_text=tomlkit.dumps(data))

    # What a map asks of a log is a fault of the pair: the error may name either.
    return Case(id_, make, "", outcome)


def texts() -> Iterator[Case]:
    def text(id_: str, content: str | bytes, names: str = "map.toml") -> Case:
        def make(folder: Path) -> list[str]:
            (folder / "log.csv").write_bytes(sound.log_bytes(".csv"))
            args = sound.convert(folder, "log.csv")
            (folder / "map.toml").write_bytes(content if isinstance(content, bytes) else content.encode())
            return args

        return Case(f"map {id_}", make, names)

    good = sound.MAP
    yield text("empty", "")
    yield text("of bytes", bytes(range(256)))
    yield text("of zeros", bytes(3000))
    yield text("in UTF-16", good.encode("utf-16"))
    yield text("cut", good[:70])
    yield text("a key twice", good + good)
    yield text("nested without end", "x = " + "[" * 20000)
    yield text("a number of 10000 digits", "sample_rate = " + "9" * 10000 + good[19:])
    yield text(
        "a part without end",
        good + "[multisine]\nperiod = 100\n[[multisine.part]]\nfirst = 1\nlast = 9000000000000000\n",
        "log.csv",
    )
    yield text("a part backwards", good + "[multisine]\nperiod = 100\n[[multisine.part]]\nfirst = 2\nlast = 1\n")
    yield text(
        "lines beyond Nyquist",
        good + "[multisine]\nperiod = 100\nexcited_lines = [80]\n[[multisine.part]]\nfirst = 1\nlast = 2\n",
    )
    yield text("a short part", good + "[multisine]\nperiod = 5\n[[multisine.part]]\nfirst = 1\nlast = 1\n", "log.csv")

    def given(id_: str, *names: str, robot: str | None = None) -> Case:
        def make(folder: Path) -> list[str]:
            (folder / "log.csv").write_bytes(sound.log_bytes(".csv"))
            args = sound.convert(folder, "log.csv")
            args[args.index("--map") + 1] = names[0] if names else args[args.index("--map") + 1]
            if robot is not None:
                args[args.index("--robot") + 1] = robot
            return args

        return Case(id_, make, "")

    yield given("map that is a folder", ".")
    yield given("map that is a device", "/dev/null")
    yield given("map by a path to a shipped one", "../maps/emps_drive")
    yield given("map of no name", "")
    yield given("map with a null", "a\x00b")
    yield given("map of a long name", "m" * 5000)
    yield given("robot of no name", robot="")
    yield given("robot with a null", robot="a\x00b")
    yield given("robot of a long name", robot="r" * 5000)
    yield given("robot by a path with dots", robot="../../../../etc")
    yield given("robot that is a file", robot="map.toml")
    for value in ("sample_rate = 1e-3", "sample_rate = 1e7"):

        def odd(folder: Path, value=value) -> list[str]:
            (folder / "log.csv").write_bytes(sound.log_bytes(".csv"))
            return sound.convert(folder, "log.csv", map_text=sound.MAP.replace("sample_rate = 500.0", value))

        yield Case(f"map {value} with stamps", odd, "log.csv")
