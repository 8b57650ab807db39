"""Independent pieces of work: on the cores of this machine, or wherever an executor takes them."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from multiprocessing import get_context
from typing import ParamSpec, TypeVar

import cloudpickle
from threadpoolctl import threadpool_limits

from robot_assets.errors import DataError
from robot_assets.threads import THREADS_VARIABLE, thread_count

Arguments = ParamSpec("Arguments")
Item = TypeVar("Item")
Result = TypeVar("Result")

ANSWER = 10.0  # s that a scheduler has to answer
GRACE = 60.0  # s after a deadline, that a piece of work which has begun has to end


class TimeIsUp(RuntimeError):
    """A piece of work was given up for want of time."""


def map_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """``[function(x) for x in items]`` on a thread per core, in order.

    Threads serve because the work is in compiled code that releases the interpreter's lock. The
    environment variable ``SIMGAP_THREADS`` sets another number: 1 where processes share the cores.

    Raises:
        DataError: where that variable is not a whole number of threads.
    """
    threads = thread_count()
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


@dataclass(frozen=True)
class Workers:
    """Where the large pieces of a diagnosis run, and who is told.

    Results do not depend on where: a piece is the same computation everywhere.

    Attributes:
        executor: any of ``concurrent.futures``; threads of this process, one per core, where None.
        progress: told of every piece of work in a line.
        deadline: of ``time.monotonic``, after which no search is begun that can be left out.
    """

    executor: Executor | None = None
    progress: Callable[[str], None] | None = None
    deadline: float = math.inf

    @property
    def late(self) -> bool:
        """Whether the time is used up."""
        return time.monotonic() > self.deadline

    @property
    def until_late(self) -> Callable[[str], None]:
        """For the progress of a long fit: raises ``TimeIsUp`` some time after the deadline.

        Of an executor, whose pieces begin together, none is given up.
        """
        last = self.deadline + GRACE if self.executor is None else math.inf

        def check(_: str) -> None:
            if time.monotonic() > last:
                raise TimeIsUp("the time for the search is used up")

        return check

    def for_half(self) -> Workers:
        """The same, for half of the time that is left."""
        now = time.monotonic()
        return replace(self, deadline=now + 0.5 * max(self.deadline - now, 0.0))

    def say(self, text: str) -> None:
        """Tell whoever asked for progress."""
        if self.progress is not None:
            self.progress(text)

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], label: Callable[[Item], str] | None = None
    ) -> list[Result]:
        """``[function(x) for x in items]``, in order.

        Args:
            label: what to say of an item when it begins, or when it is handed to the executor.
        """
        if self.executor is None:
            return map_threads(lambda item: function(self._told(item, label)), items)
        # Effects hold functions made on the spot, which the pickle of the standard library cannot send.
        packed = cloudpickle.dumps(function)
        futures = [
            self.executor.submit(_run_packed, packed, cloudpickle.dumps(self._told(item, label))) for item in items
        ]
        return [cloudpickle.loads(future.result()) for future in futures]

    def map_in_time(
        self, function: Callable[[Item], Result], items: Iterable[Item], label: Callable[[Item], str] | None = None
    ) -> list[Result | None]:
        """``map``, with None for items of this process that the deadline comes before."""
        if self.executor is not None:
            return list(self.map(function, items, label))
        return map_threads(lambda item: None if self.late else function(self._told(item, label)), items)

    def _told(self, item: Item, label: Callable[[Item], str] | None) -> Item:
        if label is not None:
            self.say(label(item))
        return item


@one_thread_each
def _run_packed(function: bytes, item: bytes) -> bytes:
    return cloudpickle.dumps(cloudpickle.loads(function)(cloudpickle.loads(item)))


@contextmanager
def open_executor(text: str) -> Iterator[Executor | None]:
    """The executor that a command line asks for.

    Args:
        text: "threads" (None: of this process), "processes" or "processes:N", or "dask://HOST:PORT",
            the scheduler of a Dask cluster whose workers have simgap installed.

    Raises:
        DataError: where it is none of these, or no scheduler answers.
    """
    kind, _, rest = text.partition(":")
    if text == "threads":
        yield None
    elif kind == "processes" and (rest == "" or (rest.isdecimal() and int(rest) > 0)):
        workers = int(rest) if rest else os.cpu_count() or 1
        # A fork would copy the locks of threads that run now.
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_share_cores) as pool:
            try:
                yield pool
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)  # nobody takes what else was handed out
                raise
    elif kind == "dask" and rest.startswith("//") and rest[2:]:
        with _dask(rest[2:]) as executor:
            yield executor
    else:
        raise DataError("--executor", "command line", text, "threads, processes, processes:N or dask://HOST:PORT")


def _share_cores() -> None:
    os.environ[THREADS_VARIABLE] = "1"
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # an interrupt from the keyboard reaches all: one of them tells of it


@contextmanager
def _dask(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as err:
        raise DataError("--executor", "this installation", "no Dask", "pip install 'simgap[dask]'") from err
    try:
        client = Client(f"tcp://{address}", timeout=ANSWER)
    except (OSError, ValueError) as err:
        raise DataError(
            "--executor", f"dask://{address}", "no scheduler that answers", "a running Dask scheduler"
        ) from err
    with client:
        yield client.get_executor(pure=False)
