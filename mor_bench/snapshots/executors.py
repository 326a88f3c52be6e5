"""Executors that solve shards: this process, a process pool, or a Dask cluster."""

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
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from threading import Thread
from time import sleep
from typing import TYPE_CHECKING, Any, TypeVar

from mor_bench.errors import InvalidInputError, MissingDependencyError, WorkerError, check_count
from mor_bench.machine import SIGNAL_CHECK_S, usable_cores
from mor_bench.parent_death import end_with_parent

if TYPE_CHECKING:
    from distributed import Client

_T = TypeVar("_T")
_R = TypeVar("_R")

IN_FLIGHT = 2
"""Tasks per worker that are submitted at once: one is solved while another waits."""

CONNECT_S = 10
"""Timeout for a cluster's scheduler, and for its first worker, s."""

PARENT_CHECK_S = 0.2
"""Interval at which a worker looks for its parent, s."""

KEPT = "Finished shards are kept; run the same command again to continue."

_ADDRESS = r"tcp://([^\s:/]+|\[[0-9a-fA-F:.]+\]):\d{1,5}"


@dataclass(frozen=True)
class Pool:
    """An executor with a maximum number of submitted tasks, which may change over time."""

    executor: Executor
    window: Callable[[], int]

    def in_any_order(self, function: Callable[[_T], _R], tasks: Iterable[_T]) -> Iterator[_R]:
        """Yield results as they finish. Draw no more tasks than the window allows."""
        waiting: set[Future[_R]] = set()
        for task in tasks:
            waiting.add(self.executor.submit(function, task))
            while len(waiting) >= self.window():
                yield from self._finished(waiting)
        while waiting:
            yield from self._finished(waiting)

    @staticmethod
    def _finished(waiting: set[Future[_R]]) -> Iterator[_R]:
        done: set[Future[_R]] = set()
        while not done:
            done, _ = wait(waiting, timeout=SIGNAL_CHECK_S, return_when=FIRST_COMPLETED)
        waiting -= done
        while done:
            yield done.pop().result()


def check_pool(workers: int | None, cluster: str | None) -> None:
    """Check the options for parallel generation.

    Raises
    ------
    InvalidInputError
        If ``workers`` is less than 1, both are given, or the address is not ``tcp://host:port``.
    """
    check_count("workers", workers)
    if cluster is not None and workers is not None:
        raise InvalidInputError(
            "`workers` and `cluster` cannot be used together: a cluster uses all its workers."
        )
    if cluster is not None and not re.fullmatch(_ADDRESS, cluster):
        raise InvalidInputError(
            f"`cluster` must be the address of a Dask scheduler, tcp://host:port; got {cluster!r}."
        )


@contextmanager
def open_pool(workers: int | None, cluster: str | None) -> Iterator[Pool]:
    """Open the cluster at an address, this process for one worker, or a pool of processes.

    The default number of workers is the number of cores.
    """
    if cluster is not None:
        with cluster_pool(cluster) as pool:
            yield pool
    elif workers == 1:
        yield Pool(_InThisProcess(), lambda: 1)
    else:
        with worker_pool(workers or usable_cores()) as pool:
            yield pool


class _InThisProcess(Executor):
    """Runs each task when it is submitted."""

    def submit(self, fn: Callable[..., _R], /, *args: Any, **kwargs: Any) -> Future[_R]:
        future: Future[_R] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def _end_with(parent: int) -> None:
    """Make this worker exit after its parent was killed. Otherwise it would wait for ever."""
    end_with_parent(parent)  # on Linux at once, even in the middle of a solve

    def watch() -> None:
        _wait_for_end_of_parent(parent)
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def _wait_for_end_of_parent(parent: int) -> None:
    if sys.platform == "win32":  # getppid() keeps returning a dead parent there
        import ctypes

        synchronize, infinite = 0x00100000, 0xFFFFFFFF
        kernel = ctypes.windll.kernel32
        kernel.WaitForSingleObject(kernel.OpenProcess(synchronize, False, parent), infinite)
    else:
        while os.getppid() == parent:
            sleep(PARENT_CHECK_S)


@contextmanager
def worker_pool(workers: int) -> Iterator[Pool]:
    """Open a pool of worker processes that end with their parent.

    The caller's script needs no `if __name__ == "__main__"`.

    Raises
    ------
    WorkerError
        If a worker is killed.
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
            "a worker process was killed; if memory was short, use fewer workers than "
            f"{workers}. {KEPT}"
        ) from error
    except BaseException:
        with suppress(RuntimeError):  # a signal came before the pool's thread had started
            executor.shutdown(kill_workers=True)
        raise
    executor.shutdown()


@contextmanager
def cluster_pool(address: str) -> Iterator[Pool]:
    """Connect to a Dask cluster. If a worker is lost, another one solves its tasks again.

    Raises
    ------
    MissingDependencyError
        If the extra `cluster` is not installed.
    WorkerError
        If the scheduler cannot be reached, is lost, has no workers or lacks this version of
        mor-bench. Also if workers repeatedly die on the same shard.
    """
    try:
        from distributed import Client, KilledWorker
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"`cluster` needs {error.name}: pip install 'mor-bench[cluster]'"
        ) from error

    client = _connected(address, partial(Client, address, timeout=CONNECT_S, set_as_default=False))
    try:
        _wait_for_worker(client, address)
        _check_installed(client, address)
        yield Pool(
            client.get_executor(pure=False),
            lambda: IN_FLIGHT * max(1, sum(client.nthreads().values())),
        )
    except KilledWorker as error:
        raise WorkerError(
            f"workers of {address} died one after the other on the same shard; "
            f"do they have enough memory? {KEPT}"
        ) from error
    except (CancelledError, OSError) as error:
        raise WorkerError(
            f"the connection to the Dask scheduler at {address} was lost. {KEPT}"
        ) from error
    finally:
        _close(client)


def _connected(address: str, connect: Callable[[], Client]) -> Client:
    """Return a client. Its own timeout has no effect on a peer that accepts and stays silent."""
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
    """Close a client, without the traceback that it logs after the loss of its scheduler."""
    log = logging.getLogger("distributed.client")
    before, log.disabled = log.disabled, True
    try:
        client.close()
    finally:
        log.disabled = before


def _wait_for_worker(client: Client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError:
        raise WorkerError(
            f"the Dask scheduler at {address} has no workers; "
            f"start some with: dask worker {address}"
        ) from None


def _check_installed(client: Client, address: str) -> None:
    """Check that all workers can import the tasks; otherwise a worker would never answer."""
    module = "mor_bench.snapshots.solve"
    try:
        scheduler = client.run_on_scheduler(find_spec, module)
        found = [scheduler, *client.run(find_spec, module).values()]
    except ModuleNotFoundError:
        found = [None]
    if None in found:
        raise WorkerError(
            f"the scheduler and the workers at {address} must have this version of mor-bench "
            "installed; some do not."
        )
