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
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, BinaryIO

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mor_bench.hard_cases.case import Case, Subject
    from mor_bench.scene.scene import Scene
    from mor_bench.specs import MethodSpec
    from mor_bench.surrogate import Surrogate
    from mor_bench.training_options import TrainingOptions

SETTLE_QUERIES = 3
"""Untimed queries before each round, after which the caches are the method's own again."""

CHECKED_ANSWERS, CHECKED_SHARE = 4, 0.2
"""Answers of a turn that are kept at most, and the share of queries that are asked for it."""

UNANSWERED = object()
"""Stands for the answer to a query under which the method finds no equilibrium."""

CURVES = ("loss_curve", "validation_curve")
"""What a trained method tells of its training, with an underscore behind."""

WARM_UP_QUERIES = 20
WARM_UP_S = 2.0

PROGRAM_EVENTS = (
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.startfile",
)
"""Audit events of launching a program, which would not be under this process's seal."""

FILE_EVENTS = (
    "open",
    "os.listdir",
    "os.scandir",
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "shutil.rmtree",
)


def seal(folders: list[str], open_one: str | None = None) -> None:
    """Keep this process out of folders: those of datasets and results, which hold what the method must predict.

    One folder within them may stay open: there a training keeps its checkpoint.

    It stops Python's usual ways to a file and the launching of programs: what a method does by mistake, or half by mistake.
    It does not stop one that attacks the machine.
    """
    prefixes = tuple(os.path.realpath(folder) + os.sep for folder in folders)
    exempt = None if open_one is None else os.path.realpath(open_one) + os.sep

    def check(path: object) -> None:
        if not isinstance(path, str | bytes | os.PathLike):
            return
        real = os.path.realpath(os.fsdecode(path)) + os.sep
        if real.startswith(prefixes) and not (exempt and real.startswith(exempt)):
            raise PermissionError(
                f"{os.fsdecode(path)}: a method may not look at datasets and results while it is compared."
            )

    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if event in FILE_EVENTS:
            for argument in arguments[:2]:
                check(argument)
        elif event in PROGRAM_EVENTS:
            raise PermissionError(f"{event}: a method may not start programs while it is compared.")

    sys.addaudithook(refuse)
    _guard_hdf5(check)


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
        with open(
            "/proc/self/status", encoding="ascii"
        ) as status:  # getrusage tells the parent's peak, where that is higher
            return next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        import psutil

        info = psutil.Process().memory_info()
        return int(getattr(info, "peak_wset", info.rss))


class Session:
    """One method of one configuration; each public function answers a request."""

    method: Surrogate
    queries: NDArray[np.float64]
    generator: np.random.Generator
    subject: Subject
    concerning: list[tuple[Case, str | None]]

    def begin(
        self, path: list[str], scene: Scene, sealed: list[str], open_one: str | None
    ) -> dict[str, Any]:
        """Take over the parent's import path and keep out of some folders but for one within them."""
        self.scene = scene
        seal(sealed, open_one)
        sys.path[:] = path
        return {}

    def check(
        self, surrogate: str, configurations: list[dict[str, Any]], where: str
    ) -> dict[str, Any]:
        """Import a class and check knobs against it."""
        from mor_bench.specs import check_parameters, load_class

        loaded = load_class(surrogate)
        for configuration in configurations:
            check_parameters(loaded, configuration, where)
        return {}

    def stress(
        self, method: MethodSpec, profile: str, cases: list[str], cache: Path | None
    ) -> dict[str, Any]:
        """Which hard cases concern a method."""
        from mor_bench.hard_cases.case import Scenes, Subject
        from mor_bench.hard_cases.suite import concerning

        self.subject = Subject(method, profile, Scenes(cache))
        self.concerning = concerning(self.subject, cases)
        return {"cases": [[case.name, case.part] for case, _ in self.concerning]}

    def stress_case(self, number: int) -> dict[str, Any]:
        """Try one of them."""
        from mor_bench.hard_cases.suite import attempt

        case, missing = self.concerning[number]
        return {"row": asdict(attempt(case, self.subject, missing))}

    def fit(
        self,
        surrogate: str,
        parameters: dict[str, Any],
        train: Path,
        model: Path,
        threads: int,
        limit_s: float,
        training: TrainingOptions | None = None,
    ) -> dict[str, Any]:
        """Fit on the snapshots of a folder and save."""
        from mor_bench.machine import pinned_threads
        from mor_bench.method_loading import make_surrogate
        from mor_bench.sandbox.handover import read_snapshots
        from mor_bench.specs import load_class

        method = make_surrogate(load_class(surrogate), parameters)
        method.time_limit_s = limit_s
        if training is not None:
            method.training = training
        with pinned_threads(threads):
            snapshots = read_snapshots(train, self.scene) if method.needs_snapshots else None
            start = perf_counter()
            method.fit(self.scene, snapshots)
            seconds = perf_counter() - start
        self.method = method
        saved = True
        try:
            method.save(model)
        except Exception:  # a method that cannot be saved is fitted again where it is timed
            saved = False
        return {
            "fit_s": seconds,
            "fit_memory_bytes": peak_memory_bytes(),
            "model_bytes": model.stat().st_size if saved else None,
            "needs_snapshots": method.needs_snapshots,
            "parameters": method.parameters,
            "sizes": getattr(method, "sizes_", {}),
            "training": _told_of_training(method),
        }

    def load(self, surrogate: str, model: Path) -> dict[str, Any]:
        """Read a fitted model."""
        from mor_bench.method_loading import load_fitted
        from mor_bench.specs import load_class

        self.method = load_fitted(model, load_class(surrogate), self.scene)
        return {}

    def predict(self, forces: NDArray[np.float64], out: Path, threads: int) -> dict[str, Any]:
        """Predict loads, (n, n_nodes, 3), N, writing the displacements to a file."""
        import numpy as np

        from mor_bench.machine import pinned_threads
        from mor_bench.sandbox.handover import predict_all

        with pinned_threads(threads):
            np.save(out, predict_all(self.method, forces), allow_pickle=False)
        return {}

    def flag(self, forces: NDArray[np.float64]) -> dict[str, Any]:
        """Which loads the method says are out of its training range; None if it does not know its range."""
        from mor_bench.errors import InvalidInputError, UnknownRangeError

        try:
            flagged = self.method.out_of_range(forces)
        except UnknownRangeError:
            return {"flagged": None}
        if flagged.shape != (len(forces),):
            raise InvalidInputError(
                f"`out_of_range` must return {len(forces)} flags for as many loads; it returned shape {flagged.shape}."
            )
        return {"flagged": [bool(flag) for flag in flagged]}

    def cost(self, forces: NDArray[np.float64]) -> dict[str, Any]:
        """What a query costs on any machine: the mean over some loads."""
        from mor_bench.measure.query_cost import cost_of

        return {"cost": cost_of(self.method, forces)}

    def warm(self, forces: NDArray[np.float64], threads: int, seed: int) -> dict[str, Any]:
        """Take the queries, (n, n_nodes, 3), N, and answer some of them."""
        import numpy as np

        from mor_bench.errors import SolverError
        from mor_bench.machine import pinned_threads

        self.queries = forces
        self.generator = np.random.default_rng(seed)
        with pinned_threads(threads):
            start = perf_counter()
            for i in range(WARM_UP_QUERIES):
                with suppress(SolverError):
                    self.method.predict(self.queries[-1 - i % len(self.queries)].copy())
                if perf_counter() - start > WARM_UP_S:
                    break
        return {"memory_bytes": peak_memory_bytes()}

    def time(
        self, out: Path, n: int, floor_s: float, most_s: float, threads: int
    ) -> dict[str, Any]:
        """Wall times of single queries, ms: n and at least for a time, but for no longer than another.

        Each load is one of the queries, drawn at random and made smaller by a random factor, so that none comes twice. A few
        are not made smaller, and what is answered to those is written to a file, to be compared with what was scored.
        The garbage collector runs as it would for a user; its part of each query is told apart. A query that the method cannot
        answer counts with the time until it says so.
        """
        import numpy as np

        from mor_bench.errors import SolverError
        from mor_bench.machine import pinned_threads

        times: list[float] = []
        collecting: list[float] = []
        kept: dict[int, Any] = {}
        clock = _CollectorClock()
        queries, draw = self.queries, self.generator

        def predict(query: NDArray[np.float64]) -> Any:
            try:
                return self.method.predict(query)
            except SolverError:
                return UNANSWERED

        begun, cpu, wall = process_time(), 0.0, 0.0
        with pinned_threads(threads):
            for _ in range(SETTLE_QUERIES):
                predict(queries[draw.integers(len(queries))] * draw.uniform(0.5, 1.0))
            gc.callbacks.append(clock)
            try:
                while True:
                    number, check = (
                        int(draw.integers(len(queries))),
                        len(kept) < CHECKED_ANSWERS and draw.random() < CHECKED_SHARE,
                    )
                    query = queries[number] * (1.0 if check else draw.uniform(0.5, 1.0))
                    clock.seconds, busy = 0.0, process_time()
                    before = perf_counter()
                    answer = predict(query)
                    after = perf_counter()
                    cpu += process_time() - busy
                    wall += after - before
                    times.append(1e3 * (after - before))
                    collecting.append(1e3 * clock.seconds)
                    if check and answer is not UNANSWERED:
                        kept[number] = np.array(answer, dtype=float)
                    if wall > most_s or (len(times) >= n and wall > floor_s):
                        break
            finally:
                gc.callbacks.remove(clock)
        if {answer.shape for answer in kept.values()} - {queries.shape[1:]}:
            from mor_bench.errors import InvalidInputError

            raise InvalidInputError(
                f"a single load of shape {queries.shape[1:]} is not answered in that shape."
            )
        np.save(
            out, np.array(list(kept.values())).reshape(-1, *queries.shape[1:]), allow_pickle=False
        )
        return {
            "latency_ms": times,
            "gc_ms": collecting,
            "cpu_s": cpu,
            "wall_s": wall,
            "cpu_all_s": process_time() - begun,
            "checked": list(kept),
        }

    def throughput(
        self, sizes: list[int], floor_s: float, most_s: float, threads: int
    ) -> dict[str, Any]:
        """Queries per second in batches of some sizes; None where one batch would take longer than a time, or has no answer."""
        import numpy as np

        from mor_bench.errors import SolverError
        from mor_bench.machine import pinned_threads

        rates: dict[str, float | None] = {}
        expected = 0.0
        with pinned_threads(threads):
            for size in sizes:
                batch = self.queries[np.arange(size) % len(self.queries)]
                if expected * size > most_s:
                    rates[str(size)] = None
                    continue
                start, n = perf_counter(), 0
                try:
                    while n == 0 or perf_counter() - start < floor_s:
                        self.method.predict(batch)
                        n += size
                except SolverError:
                    rates[str(size)] = None
                    continue
                expected = (perf_counter() - start) / n
                rates[str(size)] = 1 / expected
        return {"throughput": rates}


def _told_of_training(method: Surrogate) -> dict[str, Any] | None:
    """The iterations and loss curves of a method that has trained; None of others, or where they are no numbers."""
    try:
        told: dict[str, Any] = {
            name: [float(loss) for loss in getattr(method, f"{name}_", ())] for name in CURVES
        }
        iterations = getattr(method, "iterations_", None)
        told["iterations"] = None if iterations is None else int(iterations)
    except (TypeError, ValueError):
        return None
    return told if told["loss_curve"] or iterations is not None else None


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
            answer = {"error": type(error).__name__, "message": _printable(error)}
        except (Exception, SystemExit) as error:  # third parties' code runs here
            answer = {
                "error": None,
                "message": f"crashed with {type(error).__name__}: {_printable(error)}",
            }
    notes = list(
        dict.fromkeys(
            _printable(warning.message)
            for warning in caught
            if issubclass(warning.category, UserWarning)
        )
    )
    return {**answer, "warnings": notes}


def _printable(error: object) -> str:
    """Its text, without what no file of text can hold."""
    return str(error).encode("utf-8", "replace").decode()


def _read(requests: BinaryIO, queue: SimpleQueue[dict[str, Any]]) -> None:
    """Pass requests on; when the parent is gone, end at once, whatever the method is doing."""
    while True:
        try:
            queue.put(pickle.load(requests))
        except (EOFError, OSError):
            os._exit(1)


def work(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests until there are no more. What a method prints is no answer: standard output goes where errors go."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # a terminal sends it to all; the parent ends its workers
    os.dup2(2, 1)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    queue: SimpleQueue[dict[str, Any]] = SimpleQueue()
    Thread(target=_read, args=(requests, queue), daemon=True).start()
    session, process = Session(), os.getpid()
    while True:
        answer = _answer(session, queue.get())
        if os.getpid() != process:  # a method has forked, and this is the copy
            os._exit(0)
        answers.write(json.dumps(answer).encode() + b"\n")
        answers.flush()


def main() -> None:
    """Be a worker on standard input and output; or, given the path of a socket, the server that workers are forked from."""
    if len(sys.argv) == 2:
        from mor_bench.sandbox.fork_server import serve

        serve(sys.argv[1], work)
    else:
        work(os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb"))


if __name__ == "__main__":
    main()
