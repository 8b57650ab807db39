"""Independent pieces of work on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

Arguments = ParamSpec("Arguments")
Item = TypeVar("Item")
Result = TypeVar("Result")


def map_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """``[function(x) for x in items]`` on a thread per core, in order.

    Threads serve because the work is in compiled code that releases the interpreter's lock. The
    environment variable ``SIMGAP_THREADS`` sets another number: 1 where processes share the cores.
    """
    threads = int(os.environ.get("SIMGAP_THREADS", "0")) or os.cpu_count() or 1
    if threads == 1:
        return [function(x) for x in items]
    with ThreadPoolExecutor(max_workers=threads) as pool:
        return list(pool.map(function, items))


def one_thread_each(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Keeps linear algebra from starting threads of its own while ``function`` runs.

    Many small matrices on many threads would only wait for each other.
    """

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with threadpool_limits(1):
            return function(*args, **kwargs)

    return limited
