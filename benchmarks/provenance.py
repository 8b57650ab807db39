"""Which state of the project a result is of."""

from __future__ import annotations

import subprocess


def commit() -> str:
    """Short name of the commit that is checked out, with a plus where files differ from it."""
    found = subprocess.run(["git", "describe", "--always", "--dirty=+"], capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"
