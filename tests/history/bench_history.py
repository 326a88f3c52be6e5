"""The main quantities of the package, by an interface that nearly every commit has.

All are measured in one process per commit (`Measured.setup_cache`); the functions that asv calls
only report them. asv's own way, a process per quantity, takes several times longer. Times are CPU
times on one thread, because other programs on the machine change them less than wall times: the
least of several samples. What a commit cannot do is recorded with the reason, and is a gap.

Each benchmark has a fixed `version`, so that an edit here keeps the stored results.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

TREE = os.environ.get("MOR_BENCH_TREE")
"""The commit's code. asv hides `PYTHONPATH` from benchmarks, so the runner names it here."""

if TREE is not None:
    sys.path.insert(0, TREE)

N_DRAWN = 64
"""Loads that are drawn; the one of median size is solved, since iterations grow with the load."""

N_SAMPLES = 200
"""Samples of the dataset for the reduced models: few, so that a commit takes seconds."""

DATASETS = ("beam-coarse", "beam-fine")
"""Datasets of the full-order model; the reduced models are of the first."""

METHODS = {
    "pod": ("pod",),
    "pod-tensor": ("pod-tensor",),
    "hpod": ("hpod",),
    "pca-regression-linear": ("pca-regression-linear", "pca-regression"),
}
"""Methods, and the names under which they were known: the newest first."""

N_REPEATS = 7
LEAST_SAMPLE_S = 0.01
RECORD = Path("record.json")

IMPORT = """
import sys, time
import numpy
before, start = set(sys.modules), time.process_time()
import mor_bench
mor_bench.load_scene
print(time.process_time() - start, len(set(sys.modules) - before))
"""
"""The first use of the package, after NumPy is imported."""


def cpu_seconds(call: Callable[[], object]) -> float:
    """Return the least CPU time of a call among several samples of `LEAST_SAMPLE_S` or more."""

    def sample(number: int) -> float:
        start = time.process_time()
        for _ in range(number):
            call()
        return time.process_time() - start

    number = 1
    while sample(number) < LEAST_SAMPLE_S:
        number *= 2
    return min(sample(number) for _ in range(N_REPEATS)) / number


def median_load(scene: Any) -> Any:
    """Return the median load on the free dofs, (n_free,) N."""
    from mor_bench.snapshots.sampling import draw_loads

    try:
        drawn = draw_loads(scene, 0, N_DRAWN)
    except TypeError:  # the interface of the first commits
        of_old: Any = draw_loads
        drawn = of_old(scene.spec.loads, len(scene.patch_nodes), 0, N_DRAWN)
    sizes = np.linalg.norm(drawn.vectors.reshape(N_DRAWN, -1), axis=1)
    nodal = drawn.nodal_forces(scene.patch_weights)
    return nodal[int(sizes.argsort()[N_DRAWN // 2])].ravel()[scene.free_dofs]


def solved(dataset: str) -> tuple[Any, Any, Any]:
    """Return the full-order model, its median load, (n_free,) N, and the solution."""
    import mor_bench
    from mor_bench.mechanics.model import FullOrderModel

    scene = mor_bench.load_scene(dataset)
    load = median_load(scene)
    model = FullOrderModel(scene)
    return model, load, model.solve(load)


def in_new_process(*arguments: str) -> str:
    """Run Python with the commit's code; return what it prints."""
    variables = {**os.environ, **({} if TREE is None else {"PYTHONPATH": TREE})}
    command = [sys.executable, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, env=variables).stdout


def peak_bytes() -> float:
    """Return the peak memory of this process; NaN where the system does not tell it.

    `ru_maxrss` does not serve: in a process that was started by another, it is at least the peak
    of this other one.
    """
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((1024.0 * int(x.split()[1]) for x in lines if x.startswith("VmHWM")), np.nan)


def print_peak(dataset: str) -> None:
    """Solve once and print the peak memory of this process, bytes."""
    solved(dataset)
    print(peak_bytes())


def full_order(dataset: str) -> dict[str, float]:
    """Measure the full-order model at the median load.

    The peak memory is that of a new process, which loads kernels that this one has compiled:
    compiling takes more memory than solving.
    """
    model, load, solution = solved(dataset)
    state = solution.displacement
    found = {
        "iterations": solution.iterations,
        "peak_memory": float(in_new_process(__file__, dataset)),
        "solve": cpu_seconds(lambda: model.solve(load)),
        "residual": cpu_seconds(lambda: model.force(state)),
        "residual_and_tangent": cpu_seconds(lambda: model.linearise(state)),
    }
    try:
        from mor_bench.counting import counted
    except ImportError:  # the commit is from before the counter
        return found
    with counted() as cost:
        model.solve(load)
    return {**found, "multiply_adds": cost.multiply_adds}


def load_known(method: str) -> Any:
    """Load a method under the first of its names that the commit knows.

    Raises
    ------
    Exception
        What the package raises for the oldest name.
    """
    import mor_bench

    *newer, oldest = METHODS[method]
    for name in newer:
        try:
            return mor_bench.load_method(name)
        except Exception:  # what an unknown name raises differs between commits
            continue
    return mor_bench.load_method(oldest)


def query(method: str, data: Any) -> dict[str, float]:
    """Fit a method; measure its query at the median test load, and its error."""
    surrogate = load_known(method)
    surrogate.fit(data.scene, data.train)
    reference = data.test.displacements
    difference = surrogate.predict(data.test.forces) - reference
    relative = np.linalg.norm(difference, axis=(1, 2)) / np.linalg.norm(reference, axis=(1, 2))
    sizes = np.linalg.norm(data.test.forces, axis=(1, 2))
    force = data.test.forces[int(sizes.argsort()[len(sizes) // 2])]
    return {
        "predict": cpu_seconds(lambda: surrogate.predict(force)),
        "relative_error": float(np.median(relative)),
    }


def first_use() -> dict[str, float]:
    """Import the package in new processes; return the least CPU time and the new modules."""
    found = [in_new_process("-c", IMPORT).split() for _ in range(3)]
    return {
        "cpu_time": min(float(seconds) for seconds, _ in found),
        "modules": int(found[0][1]),
    }


def attempt(measure: Callable[[], dict[str, float]]) -> dict[str, Any]:
    try:
        return measure()
    except Exception as error:  # old code may raise anything; it is a gap
        return {"unavailable": repr(error)}


def measure_all() -> dict[str, dict[str, Any]]:
    """Measure everything; a part that the commit cannot do holds the reason only.

    Raises
    ------
    RuntimeError
        If the package does not come from the commit's code.
    """
    import mor_bench

    if TREE is not None and not Path(mor_bench.__file__).is_relative_to(TREE):
        raise RuntimeError(f"mor_bench is imported from {mor_bench.__file__}, not from {TREE}")
    found = {"": attempt(first_use)}
    for dataset in DATASETS:
        found[dataset] = attempt(lambda dataset=dataset: full_order(dataset))  # type: ignore[misc]
    try:
        data = mor_bench.load_dataset(DATASETS[0], limit=N_SAMPLES, cache=Path("cache"), workers=1)
    except Exception as error:
        return {**found, **{method: {"unavailable": repr(error)} for method in METHODS}}
    for method in METHODS:
        found[method] = attempt(lambda method=method: query(method, data))  # type: ignore[misc]
    return found


class Measured:
    """Base of all benchmarks: one process measures everything, each benchmark reports a number."""

    version = "1"

    def setup_cache(self) -> None:
        RECORD.write_text(json.dumps(measure_all()))

    setup_cache.timeout = 600  # type: ignore[attr-defined]

    def value(self, part: str, quantity: str) -> float:
        """Return a number of the record; NaN if the commit has no such quantity.

        Raises
        ------
        NotImplementedError
            If the commit could not run the part, with the reason.
        """
        record = json.loads(RECORD.read_text())[part]
        if "unavailable" in record:
            raise NotImplementedError(record["unavailable"])
        return float(record.get(quantity, np.nan))


class FullOrder(Measured):
    """The full-order model at the median load."""

    params = DATASETS
    param_names = ("dataset",)

    def setup(self, dataset: str) -> None:
        self.value(dataset, "solve")

    def track_solve(self, dataset: str) -> float:
        return self.value(dataset, "solve")

    def track_residual(self, dataset: str) -> float:
        return self.value(dataset, "residual")

    def track_residual_and_tangent(self, dataset: str) -> float:
        return self.value(dataset, "residual_and_tangent")

    def track_iterations(self, dataset: str) -> float:
        return self.value(dataset, "iterations")

    def track_multiply_adds(self, dataset: str) -> float:
        """Counted by the package: the same on every machine."""
        return self.value(dataset, "multiply_adds")

    def track_peak_memory(self, dataset: str) -> float:
        return self.value(dataset, "peak_memory")

    track_solve.unit = "seconds"  # type: ignore[attr-defined]
    track_residual.unit = "seconds"  # type: ignore[attr-defined]
    track_residual_and_tangent.unit = "seconds"  # type: ignore[attr-defined]
    track_iterations.unit = "iterations"  # type: ignore[attr-defined]
    track_multiply_adds.unit = "multiply-adds"  # type: ignore[attr-defined]
    track_peak_memory.unit = "bytes"  # type: ignore[attr-defined]


class Query(Measured):
    """One load at a time, from forces on the host to displacements on the host."""

    params = (tuple(METHODS),)
    param_names = ("method",)

    def setup(self, method: str) -> None:
        self.value(method, "predict")

    def track_predict(self, method: str) -> float:
        return self.value(method, "predict")

    def track_relative_error(self, method: str) -> float:
        """The median over test samples of the relative l2 error."""
        return self.value(method, "relative_error")

    track_predict.unit = "seconds"  # type: ignore[attr-defined]
    track_relative_error.unit = "relative l2"  # type: ignore[attr-defined]


class Import(Measured):
    """The first use of the package in a new process."""

    def track_cpu_time(self) -> float:
        return self.value("", "cpu_time")

    def track_modules(self) -> float:
        return self.value("", "modules")

    track_cpu_time.unit = "seconds"  # type: ignore[attr-defined]
    track_modules.unit = "modules"  # type: ignore[attr-defined]


if __name__ == "__main__":
    print_peak(sys.argv[1])
