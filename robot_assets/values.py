"""Values of a TOML file, checked one by one: each wrong one is a single ``DataError``."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from robot_assets.errors import DataError

LARGEST = 1e15  # SI; anything above is no figure of an arm
MISSING: Any = object()


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        DataError: where it is missing, is no text or no TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))  # editors of Windows write a mark before it
    except UnicodeDecodeError as err:
        raise DataError(what, str(path), "bytes that are no UTF-8", "UTF-8 text") from err
    except OSError as err:
        raise DataError(what, str(path), str(err.strerror or err), f"a readable {path.name}") from err
    except (ValueError, RecursionError) as err:
        raise DataError(what, str(path), f"invalid TOML ({err})", "valid TOML") from err


def exists(path: Path) -> bool:
    """Whether a file stands there; a name that no file can have is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def instead_of_file(path: Path) -> str:
    """What stands where a file should, in words."""
    try:
        return "a folder" if path.is_dir() else "no file" if path.exists() else "no such file"
    except (OSError, ValueError):
        return "no such file"


def show(value: Any) -> str:
    """A value as an error quotes it."""
    if value is MISSING or value is None:
        return "no such key"
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 300:
        return f"a whole number of {value.bit_length()} bits"
    try:
        return repr(value)
    except ValueError:  # whole numbers of thousands of digits inside
        return f"a {type(value).__name__} of values out of range"


def text(table: dict, key: str, where: str, default: Any = MISSING) -> str:
    """A text that is not empty."""
    value = table.get(key, default)
    if not isinstance(value, str) or not value:
        raise DataError(key, where, show(value), "a text")
    return value


def choice(table: dict, key: str, where: str, allowed: tuple[str, ...], default: Any = MISSING) -> str:
    """One of some words."""
    value = table.get(key, default)
    if not isinstance(value, str) or value not in allowed:
        raise DataError(key, where, show(value), " or ".join(f'"{a}"' for a in allowed))
    return value


def number(
    table: dict,
    key: str,
    where: str,
    *,
    low: float = -LARGEST,
    high: float = LARGEST,
    above: bool = False,
    default: Any = MISSING,
) -> float:
    """A finite number from ``low`` (``above``: beyond it) to ``high``."""
    value = table.get(key, default)
    sound = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    if not sound or (above and value <= low):
        raise DataError(
            key,
            where,
            show(value),
            f"a number {'above' if above else 'from'} {low:g} {'and up ' if above else ''}to {high:g}",
        )
    return float(value)


def whole(table: dict, key: str, where: str, *, low: int, high: int = 2**53, default: Any = MISSING) -> Any:
    """A whole number from ``low``; ``default`` as it is where the key is absent."""
    if key not in table and default is not MISSING:
        return default
    value = table.get(key, MISSING)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise DataError(key, where, show(value), f"a whole number of at least {low}")
    return value


def vector(value: Any, key: str, where: str, n: int, expected: str = "") -> np.ndarray:
    """(n,) finite numbers."""
    sound = isinstance(value, list) and len(value) == n
    sound = sound and all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= LARGEST for v in value)
    if not sound:
        raise DataError(key, where, show(value), expected or f"{n} finite numbers")
    return np.array(value, float)


def tables(table: dict, key: str, where: str) -> list[dict]:
    """An array of tables; empty where the key is absent."""
    entries = table.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise DataError(f"[[{key}]]", where, show(entries), "an array of tables")
    return entries


def subtable(table: dict, key: str, where: str) -> dict:
    """A table; empty where the key is absent."""
    entry = table.get(key, {})
    if not isinstance(entry, dict):
        raise DataError(f"[{key}]", where, show(entry), "a table")
    return entry
