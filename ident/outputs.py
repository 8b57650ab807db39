"""Files written beside their place and moved into it when they are whole."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from robot_assets.errors import DataError


@contextmanager
def outputs_into(folder: str | Path) -> Iterator[Path]:
    """A scratch folder whose files replace those of ``folder`` one by one when all went well.

    Raises:
        DataError: where ``folder`` cannot be a folder.
    """
    target = Path(folder)
    if target.exists() and not target.is_dir():
        raise DataError("output", str(target), "a file", "a folder")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as err:
        raise DataError("output", str(target), str(err), "a folder that can be written") from err
    try:
        yield scratch
        target.mkdir(exist_ok=True)
        for file in sorted(scratch.iterdir()):
            os.replace(file, target / file.name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
