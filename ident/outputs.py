"""Outputs written beside their place and put into it at one stroke: whoever kills a run finds the old ones or the
new."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from robot_assets.errors import DataError

AT_FDCWD, EXCHANGE = -100, 2  # of renameat2(2) on Linux; renamex_np(2) of macOS calls the latter RENAME_SWAP


@contextmanager
def outputs_into(folder: str | Path, without: Collection[str] = ()) -> Iterator[Path]:
    """A scratch folder that takes the place of ``folder`` when all went well; what else stood there stays.

    Args:
        without: files of an earlier run that do not stay.

    Raises:
        DataError: where ``folder`` cannot be a folder.
    """
    target = Path(folder)
    if target.exists() and not target.is_dir():
        raise DataError("output", str(target), "a file", "a folder")
    target = target.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as err:
        raise DataError("output", str(target), str(err), "a folder that can be written") from err
    try:
        yield scratch
        if target.is_dir() and _shared(target):
            _replace(scratch, target, without)
        else:
            for old in target.iterdir() if target.is_dir() else ():
                if old.name not in without and not (scratch / old.name).exists():
                    _link(old, scratch / old.name)
            take_place(scratch, target)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def take_place(new: Path, target: Path) -> None:
    """Let the folder ``new`` stand at ``target`` beside it, and delete one that stood there."""
    os.chmod(new, target.stat().st_mode if target.exists() else 0o755)
    if not target.exists():
        new.rename(target)
    elif _shared(target) or not _exchange(new, target):
        _replace(new, target, {p.name for p in target.iterdir()} - {p.name for p in new.iterdir()})
    shutil.rmtree(new, ignore_errors=True)


def _shared(target: Path) -> bool:
    """Whether others may stand or write in a folder, who would be left in the old one: then its files alone are
    replaced."""
    return Path.cwd().is_relative_to(target) or not all(p.is_file() for p in target.iterdir())


def _exchange(a: Path, b: Path) -> bool:
    """Two folders change places at one stroke; False where the system cannot."""
    if os.name != "posix":
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    first, second = os.fsencode(a), os.fsencode(b)
    if hasattr(libc, "renameat2"):
        return bool(libc.renameat2(AT_FDCWD, first, AT_FDCWD, second, EXCHANGE) == 0)
    if sys.platform == "darwin" and hasattr(libc, "renamex_np"):
        return bool(libc.renamex_np(first, second, EXCHANGE) == 0)
    return False


def _replace(new: Path, target: Path, without: Collection[str]) -> None:
    """File by file: each is the old one or the new one; those ``without`` go."""
    for file in sorted(new.iterdir()):
        os.replace(file, target / file.name)
    for name in without:
        (target / name).unlink(missing_ok=True)


def _link(old: Path, new: Path) -> None:
    """A second name of a file, or a copy where the disk knows none."""
    try:
        os.link(old, new, follow_symlinks=False)
    except OSError:
        shutil.copy2(old, new, follow_symlinks=False)
