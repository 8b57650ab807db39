"""Random damage: logs, maps, plans and URDFs are read, or give one clear line."""

from __future__ import annotations

import tempfile
import tomllib
from pathlib import Path

import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.convert import convert_logs
from ident.convert.guess import guess_map
from ident.dataset_io import load_dataset, save_dataset
from ident.plan_file import plan_from_toml
from robot_assets.errors import DataError
from robot_assets.from_urdf import write_robot
from tests.hostile import datasets, maps, sound

EXAMPLES = settings(max_examples=30, deadline=None, derandomize=True)
values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(min_size=1, max_size=8), inner, max_size=3),
    max_leaves=6,
)


def one_line(function, *args) -> bool:
    """Whether the function takes its arguments; an error is one line, any other passes through."""
    try:
        function(*args)
    except DataError as err:
        line = str(err)
        assert line.isprintable() and len(line) < 2000 and "found" in line and "expected" in line
        return False
    return True


def damage(data: bytes, cuts: list[tuple[float, int, bytes]]) -> bytes:
    """The bytes, at each place (a share of their length) so many taken out and others put in."""
    for at, count, new in cuts:
        k = int(at * len(data))
        data = data[:k] + new + data[k + count :]
    return data


def put(toml: dict, path: tuple, value) -> str | None:
    """The text of a TOML file with a value changed, None removing it; None where TOML cannot say it."""
    inner = toml
    for key in path[:-1]:
        if isinstance(key, str) and key not in inner:
            inner[key] = {}
        inner = inner[key]
    if value is None:
        inner.pop(path[-1], None)
    else:
        inner[path[-1]] = value
    try:
        text = tomlkit.dumps(toml)
        tomllib.loads(text)
    except (ValueError, TypeError, AttributeError):
        return None
    return text


def convert(folder: Path, log: Path, map_text: str) -> None:
    (folder / "map.toml").write_text(map_text, encoding="utf-8")
    data = convert_logs([log], folder / "pair", folder / "map.toml")
    save_dataset(data, folder / "out")
    load_dataset(folder / "out")


@pytest.mark.parametrize("suffix", [*sound.TABLES, *sound.BAGS])
@given(cuts=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=40)), min_size=1, max_size=4))
@settings(EXAMPLES, max_examples=10)
def test_a_damaged_log_is_read_or_refused(suffix, cuts):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sound.put_robot(folder)
        log = folder / f"log{suffix}"
        log.write_bytes(damage(sound.log_bytes(suffix), cuts))
        one_line(convert, folder, log, sound.BAG_MAP if suffix in sound.BAGS else sound.MAP)
        one_line(guess_map, [log], folder / "pair")


@given(path=st.sampled_from(sorted(maps.KEYS, key=str)), value=values)
@EXAMPLES
def test_a_map_with_any_value_is_read_or_refused(path, value):
    toml = tomllib.loads(sound.MAP)
    toml["columns"]["q_1"] = {"source": "x1"}
    if path[0] == "multisine":
        toml["multisine"] = {"period": 100, "part": [{"first": 1, "last": 2}], "excited_lines": [3, 5]}
    text = put(toml, path, value)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sound.put_robot(folder)
        (folder / "log.csv").write_bytes(sound.log_bytes(".csv"))
        if text is not None:
            one_line(convert, folder, folder / "log.csv", text)


@given(path=st.sampled_from(sorted(datasets.PLAN_KEYS, key=str)), value=values)
@EXAMPLES
def test_a_plan_with_any_value_is_read_or_refused(path, value):
    text = put(tomllib.loads(datasets.plan_text()), path, value)
    with tempfile.TemporaryDirectory() as name:
        if text is not None:
            (Path(name) / "plan.toml").write_text(text, encoding="utf-8")
            one_line(plan_from_toml, Path(name) / "plan.toml")


@given(
    cuts=st.lists(
        st.tuples(
            st.floats(0, 1), st.integers(0, 12), st.text(st.characters(codec="utf-8"), max_size=12).map(str.encode)
        ),
        min_size=1,
        max_size=3,
    )
)
@EXAMPLES
def test_a_damaged_urdf_is_read_or_refused(cuts):
    with tempfile.TemporaryDirectory() as name:
        urdf = Path(name) / "arm.urdf"
        urdf.write_bytes(damage(sound.URDF.encode(), cuts))
        one_line(write_robot, urdf, Path(name) / "out")
