"""Where shards are solved: in this process, in a pool of processes, or on a Dask cluster, behind one interface."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from threading import Thread
from time import sleep
from typing import TYPE_CHECKING, Any, TypeVar

from mor_bench.errors import InvalidInputError, MissingDependencyError, WorkerError

if TYPE_CHECKING:
    from distributed import Client

_T = TypeVar("_T")
_R = TypeVar("_R")

IN_FLIGHT = 2
"""Tasks per worker that are submitted at once: one is solved, one is there when that is done."""

CONNECT_S = 10
"""How long to wait for a cluster's scheduler, and for the first of its workers."""

KEPT = "Finished shards are kept, and the same command goes on from them."


@dataclass(frozen=True)
class Pool:
    """An executor, and how many tasks it should be given at once, which may change while it is used."""

    executor: Executor
    window: Callable[[], int]

    def in_any_order(self, function: Callable[[_T], _R], tasks: Iterable[_T]) -> Iterator[_R]:
        """Results as they come; no more tasks are drawn, and no more results held, than the window allows."""
        waiting: set[Future[_R]] = set()
        for task in tasks:
            waiting.add(self.executor.submit(function, task))
            while len(waiting) >= self.window():
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                while done:
                    yield done.pop().result()
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            while done:
                yield done.pop().result()


def check_pool(workers: int | None, cluster: str | None) -> None:
    """Check where to solve, before anything is done.

    Raises
    ------
    InvalidInputError
        If ``workers`` is less than 1, both are given, or the address does not read ``tcp://host:port``.
    """
    if workers is not None and workers < 1:
        raise InvalidInputError(f"`workers` must be an integer >= 1; got {workers}.")
    if cluster is not None and workers is not None:
        raise InvalidInputError(
            "`workers` and `cluster` exclude each other: a cluster has as many workers as were started."
        )
    if cluster is not None and not re.fullmatch(
        r"tcp://([^\s:/]+|\[[0-9a-fA-F:.]+\]):\d{1,5}", cluster
    ):
        raise InvalidInputError(
            f"`cluster` must be the address of a Dask scheduler, tcp://host:port; got {cluster!r}."
        )


@contextmanager
def open_pool(workers: int | None, cluster: str | None) -> Iterator[Pool]:
    """A pool of processes, as many as there are cores by default; or the cluster at an address; or, for one worker, this process."""
    if cluster is not None:
        with cluster_pool(cluster) as pool:
            yield pool
    elif workers == 1:
        yield Pool(_InThisProcess(), lambda: 1)
    else:
        with worker_pool(workers or os.cpu_count() or 1) as pool:
            yield pool


class _InThisProcess(Executor):
    """Runs a task where it is submitted."""

    def submit(self, fn: Callable[..., _R], /, *args: Any, **kwargs: Any) -> Future[_R]:
        future: Future[_R] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def _end_with(parent: int) -> None:
    """Let this worker end when its parent has died by a signal that no one can catch; otherwise it would wait for ever."""

    def watch() -> None:
        _wait_for_end_of_parent(parent)
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def _wait_for_end_of_parent(parent: int) -> None:
    if sys.platform == "win32":  # where a process keeps the number of a parent that is no more
        import ctypes

        synchronize, infinite = 0x00100000, 0xFFFFFFFF
        ctypes.windll.kernel32.WaitForSingleObject(
            ctypes.windll.kernel32.OpenProcess(synchronize, False, parent), infinite
        )
    else:
        while os.getppid() == parent:
            sleep(1.0)


@contextmanager
def worker_pool(workers: int) -> Iterator[Pool]:
    """Worker processes that need no `if __name__ == "__main__"` in the caller's script, and end with their parent.

    Raises
    ------
    WorkerError
        If one of them is killed.
    """
    from loky import ProcessPoolExecutor

    executor = ProcessPoolExecutor(
        max_workers=workers, initializer=_end_with, initargs=(os.getpid(),)
    )
    try:
        yield Pool(executor, lambda: IN_FLIGHT * workers)
    except BrokenExecutor as error:
        executor.shutdown(kill_workers=True)
        raise WorkerError(
            f"a worker process was killed; if there was too little memory, take fewer workers than {workers}. {KEPT}"
        ) from error
    except BaseException:
        executor.shutdown(kill_workers=True)
        raise
    executor.shutdown()


@contextmanager
def cluster_pool(address: str) -> Iterator[Pool]:
    """The workers of a Dask cluster; they may come and go, and what a lost one had is solved by another.

    Raises
    ------
    MissingDependencyError
        Without the extra `cluster`.
    WorkerError
        If the scheduler cannot be reached, is lost, or has no workers; if workers die again and again on the same shard; or
        if the cluster's mor-bench is another one.
    """
    try:
        from distributed import Client, KilledWorker
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"`cluster` needs {error.name}: pip install 'mor-bench[cluster]'"
        ) from error

    client = _connected(address, partial(Client, address, timeout=CONNECT_S, set_as_default=False))
    try:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            raise WorkerError(
                f"the Dask scheduler at {address} has no workers; start some with: dask worker {address}"
            ) from None
        _check_installed(client, address)
        yield Pool(
            client.get_executor(pure=False),
            lambda: IN_FLIGHT * max(1, sum(client.nthreads().values())),
        )
    except KilledWorker as error:
        raise WorkerError(
            f"workers of {address} died one after the other on the same shard; do they have enough memory? {KEPT}"
        ) from error
    except (CancelledError, OSError) as error:
        raise WorkerError(
            f"the connection to the Dask scheduler at {address} was lost. {KEPT}"
        ) from error
    finally:
        _close(client)


def _connected(address: str, connect: Callable[[], Client]) -> Client:
    """A client, or a `WorkerError` when its time is up: its own limit does not hold for a peer that accepts and stays silent."""
    made: Future[Client] = Future()

    def attempt() -> None:
        try:
            made.set_result(connect())
        except BaseException as error:
            made.set_exception(error)

    Thread(target=attempt, daemon=True).start()
    try:
        return made.result(CONNECT_S + 2)
    except (OSError, ValueError, TimeoutError) as error:
        raise WorkerError(
            f"no Dask scheduler answers at {address} within {CONNECT_S} s."
        ) from error


def _close(client: Client) -> None:
    """Close a client, without the page of traceback that it logs where the scheduler is gone."""
    log = logging.getLogger("distributed.client")
    before, log.disabled = log.disabled, True
    try:
        client.close()
    finally:
        log.disabled = before


def _check_installed(client: Client, address: str) -> None:
    """A worker that cannot import what it is sent would be silent for ever."""
    module = "mor_bench.snapshots.solve"
    try:
        found = [
            client.run_on_scheduler(find_spec, module),
            *client.run(find_spec, module).values(),
        ]
    except ModuleNotFoundError:
        found = [None]
    if None in found:
        raise WorkerError(
            f"the scheduler and the workers at {address} must have this version of mor-bench installed; some have not."
        )
