"""The process that a method runs in while it is compared: it fits or loads, predicts and is timed, and holds no reference.

It is given the scene and the training snapshots, and forces when they are to be predicted; the displacements that answer
the test forces stay with the parent, which scores. Requests come pickled through the pipe from the parent; answers, which
a third party's code may have touched, go back as JSON.
"""

from __future__ import annotations

import gc
import json
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, BinaryIO

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mor_bench.scene.scene import Scene
    from mor_bench.surrogate import Surrogate

SETTLE_QUERIES = 3
"""Untimed queries before each round, after which the caches are the method's own again."""

WARM_UP_QUERIES = 20
WARM_UP_S = 2.0

PROGRAM_EVENTS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.startfile")
"""Audit events of launching a program, which would not be under this process's seal."""

FILE_EVENTS = (
    "open", "os.listdir", "os.scandir", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.link", "os.symlink", "os.truncate", "shutil.rmtree",
)  # fmt: skip


class Seal:
    """Keeps a process out of folders: those of the datasets and of results, which hold what the method must predict.

    It stops Python's ways to a file and the launching of programs, not native code. What is proof against that too is a
    test set that does not exist before the method is fitted (`--test-seed`).
    """

    def __init__(self, folders: list[str]) -> None:
        folders = [os.path.realpath(folder) for folder in folders]
        self._opened: list[str] = []
        opened, prefixes = self._opened, tuple(folder + os.sep for folder in folders)

        def check(path: object) -> None:
            if not isinstance(path, str | bytes | os.PathLike):
                return
            real = os.path.realpath(os.fsdecode(path)) + os.sep
            if real.startswith(prefixes) and real[:-1] not in opened:
                raise PermissionError(f"{os.fsdecode(path)}: a method may not look at datasets and results while it is compared.")

        def refuse(event: str, arguments: tuple[Any, ...]) -> None:
            if event in FILE_EVENTS:
                for argument in arguments[:2]:
                    check(argument)
            elif event in PROGRAM_EVENTS:
                raise PermissionError(f"{event}: a method may not start programs while it is compared.")

        sys.addaudithook(refuse)
        _guard_hdf5(check)

    def open(self, path: Path) -> None:
        """Let one file be opened after all."""
        self._opened.append(os.path.realpath(path))


def _guard_hdf5(check: Callable[[object], None]) -> None:
    """HDF5 opens files without Python's knowledge."""
    import h5py

    unguarded = h5py.h5f.open

    def guarded(name: bytes, *arguments: Any, **keywords: Any) -> Any:
        check(name)
        return unguarded(name, *arguments, **keywords)

    h5py.h5f.open = guarded


def peak_memory_bytes() -> int:
    """The most memory that this process has had resident."""
    try:
        with open("/proc/self/status", encoding="ascii") as status:  # getrusage tells the parent's peak, where that is higher
            return next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        import psutil

        info = psutil.Process().memory_info()
        return int(getattr(info, "peak_wset", info.rss))


class Session:
    """One method of one configuration; each public function answers a request."""

    method: Surrogate
    queries: NDArray[np.float64]

    def begin(self, path: list[str], scene: Scene, sealed: list[str]) -> dict[str, Any]:
        """Take over the parent's import path and keep out of some folders."""
        self.scene = scene
        self._seal = Seal(sealed)
        sys.path[:] = path
        return {}

    def check(self, surrogate: str, configurations: list[dict[str, Any]], where: str) -> dict[str, Any]:
        """Import a class and check knobs against it."""
        from mor_bench.specs import check_parameters, load_class

        loaded = load_class(surrogate)
        for configuration in configurations:
            check_parameters(loaded, configuration, where)
        return {}

    def fit(
        self, surrogate: str, parameters: dict[str, Any], train: Path, model: Path, threads: int, limit_s: float
    ) -> dict[str, Any]:  # fmt: skip
        """Fit on the snapshots of a folder and save."""
        from mor_bench.errors import MorBenchError
        from mor_bench.harness.handover import read_snapshots
        from mor_bench.harness.timing import pinned_threads
        from mor_bench.specs import load_class
        from mor_bench.surrogate import make_surrogate

        method = make_surrogate(load_class(surrogate), parameters)
        method.time_limit_s = limit_s
        with pinned_threads(threads):
            snapshots = read_snapshots(train, self.scene) if method.needs_snapshots else None
            start = perf_counter()
            method.fit(self.scene, snapshots)
            seconds = perf_counter() - start
        self.method = method
        saved = True
        try:
            method.save(model)
        except MorBenchError:
            saved = False
        return {
            "fit_s": seconds,
            "fit_memory_bytes": peak_memory_bytes(),
            "model_bytes": model.stat().st_size if saved else None,
            "needs_snapshots": method.needs_snapshots,
            "parameters": method.parameters,
        }

    def load(self, surrogate: str, model: Path) -> dict[str, Any]:
        """Read a fitted model."""
        from mor_bench.specs import load_class
        from mor_bench.surrogate import load_fitted

        self.method = load_fitted(model, load_class(surrogate), self.scene)
        return {}

    def predict(self, forces: Path, out: Path, threads: int) -> dict[str, Any]:
        """Predict all forces of a file, writing the displacements to another."""
        import numpy as np

        from mor_bench.harness.handover import predict_all
        from mor_bench.harness.timing import pinned_threads

        self._seal.open(forces)
        self._seal.open(out)
        loads = np.load(forces, mmap_mode="r", allow_pickle=False)
        answers = np.lib.format.open_memmap(out, mode="w+", dtype=np.float64, shape=loads.shape)
        with pinned_threads(threads):
            predict_all(self.method, loads, answers)
        answers.flush()
        return {}

    def flag(self, forces: Path) -> dict[str, Any]:
        """Which loads the method says are out of its training range; None if it does not know its range."""
        import numpy as np

        from mor_bench.errors import UnknownRangeError

        self._seal.open(forces)
        loads = np.load(forces, mmap_mode="r", allow_pickle=False)
        flagged: list[bool] = []
        try:
            for start in range(0, len(loads), 256):
                flagged += self.method.out_of_range(np.array(loads[start : start + 256])).tolist()
        except UnknownRangeError:
            return {"flagged": None}
        return {"flagged": flagged}

    def cost(self, forces: Path, n: int) -> dict[str, Any]:
        """What a query costs on any machine: the mean over some loads."""
        import numpy as np

        from mor_bench.harness.cost import cost_of

        self._seal.open(forces)
        loads = np.load(forces, mmap_mode="r", allow_pickle=False)
        chosen = np.linspace(0, len(loads) - 1, min(n, len(loads))).astype(int)
        return {"cost": cost_of(self.method, np.array(loads[chosen]))}

    def warm(self, forces: Path, threads: int) -> dict[str, Any]:
        """Take the queries into memory and answer some of them."""
        import numpy as np

        from mor_bench.harness.timing import pinned_threads

        self._seal.open(forces)
        self.queries = np.load(forces, allow_pickle=False)
        with pinned_threads(threads):
            start = perf_counter()
            for i in range(WARM_UP_QUERIES):
                self.method.predict(self.queries[-1 - i % len(self.queries)])
                if perf_counter() - start > WARM_UP_S:
                    break
        return {"memory_bytes": peak_memory_bytes()}

    def time(self, first: int, n: int, floor_s: float, most_s: float, threads: int) -> dict[str, Any]:
        """Wall times of single queries, ms, from one on: n and at least for a time, but for no longer than another.

        The garbage collector runs as it would for a user; its part of each query is told apart.
        """
        from mor_bench.harness.timing import pinned_threads

        times: list[float] = []
        collecting: list[float] = []
        clock = _CollectorClock()
        predict, queries = self.method.predict, self.queries
        begun = process_time()
        with pinned_threads(threads):
            for i in range(SETTLE_QUERIES):
                predict(queries[(first - 1 - i) % len(queries)])
            gc.callbacks.append(clock)
            cpu, start = process_time(), perf_counter()
            try:
                while True:
                    query = queries[(first + len(times)) % len(queries)]
                    clock.seconds = 0.0
                    before = perf_counter()
                    predict(query)
                    after = perf_counter()
                    times.append(1e3 * (after - before))
                    collecting.append(1e3 * clock.seconds)
                    if after - start > most_s or (len(times) >= n and after - start > floor_s):
                        break
            finally:
                gc.callbacks.remove(clock)
            wall, cpu = perf_counter() - start, process_time() - cpu
        return {"latency_ms": times, "gc_ms": collecting, "cpu_s": cpu, "wall_s": wall, "cpu_all_s": process_time() - begun}

    def throughput(self, sizes: list[int], floor_s: float, most_s: float, threads: int) -> dict[str, Any]:
        """Queries per second in batches of some sizes; None where one batch would take longer than a time."""
        import numpy as np

        from mor_bench.harness.timing import pinned_threads

        rates: dict[str, float | None] = {}
        expected = 0.0
        with pinned_threads(threads):
            for size in sizes:
                batch = self.queries[np.arange(size) % len(self.queries)]
                if expected * size > most_s:
                    rates[str(size)] = None
                    continue
                start, n = perf_counter(), 0
                while n == 0 or perf_counter() - start < floor_s:
                    self.method.predict(batch)
                    n += size
                expected = (perf_counter() - start) / n
                rates[str(size)] = 1 / expected
        return {"throughput": rates}


class _CollectorClock:
    """How long garbage collections took, as one of `gc.callbacks`."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._start = 0.0

    def __call__(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self._start = perf_counter()
        else:
            self.seconds += perf_counter() - self._start


def _answer(session: Session, request: dict[str, Any]) -> dict[str, Any]:
    """What a request yields, or the error that it ends with; and the warnings on the way."""
    from mor_bench.errors import MorBenchError

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            answer = getattr(session, request.pop("do"))(**request)
        except MorBenchError as error:
            answer = {"error": type(error).__name__, "message": str(error)}
        except (Exception, SystemExit) as error:  # third parties' code runs here
            answer = {"error": None, "message": f"crashed with {type(error).__name__}: {error}"}
    notes = list(dict.fromkeys(str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)))
    return {**answer, "warnings": notes}


def _read(requests: BinaryIO, queue: SimpleQueue[dict[str, Any]]) -> None:
    """Pass requests on; when the parent is gone, end at once, whatever the method is doing."""
    while True:
        try:
            queue.put(pickle.load(requests))
        except (EOFError, OSError):
            os._exit(1)


def work(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests until there are no more. What a method prints is no answer: standard output goes where errors go."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the parent ends its workers
    os.dup2(2, 1)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    queue: SimpleQueue[dict[str, Any]] = SimpleQueue()
    Thread(target=_read, args=(requests, queue), daemon=True).start()
    session = Session()
    while True:
        answers.write(json.dumps(_answer(session, queue.get())).encode() + b"\n")
        answers.flush()


def main() -> None:
    """Be a worker on standard input and output; or, given the path of a socket, the server that workers are forked from."""
    if len(sys.argv) == 2:
        from mor_bench.harness.nursery import serve

        serve(sys.argv[1], work)
    else:
        work(os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb"))


if __name__ == "__main__":
    main()
