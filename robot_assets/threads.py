"""How many threads a process of this project may use."""

from __future__ import annotations

import os

from robot_assets.errors import DataError

THREADS_VARIABLE = "SIMGAP_THREADS"


def thread_count() -> int:
    """Threads that a process uses: ``SIMGAP_THREADS``, else one per core.

    Raises:
        DataError: where that variable is not a whole number of threads.
    """
    given = os.environ.get(THREADS_VARIABLE, "")
    if not given:
        return os.cpu_count() or 1
    if not given.isdecimal() or int(given) == 0:
        raise DataError(THREADS_VARIABLE, "environment", given, "a whole number of threads, 1 or more")
    return int(given)
