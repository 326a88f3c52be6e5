"""Errors of networks over their numbers of iterations and of training samples, with three seeds.

    python -m tests.benchmarks.learning_curves --json learning-curves.json

Every point is a training of its own, with its own learning-rate schedule. The iterations double
until two doublings in a row each lower the error on validation samples by less than 5 %, but at
least to the number in the method's file, or until a training would take longer than the limit.
Points that the file has already are not trained again, so that the same command continues after an
interruption. Trainings on a graphics processor run side by side in one process; their points have
no core-seconds.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from threading import Lock
from time import perf_counter, process_time
from typing import Annotated, Any, Literal

import typer

import mor_bench
from mor_bench.machine import pinned_threads
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import load_method_spec
from mor_bench.training_options import TrainingOptions
from tests.benchmarks.choices import scored

LINEAR_RESPONSE = {"input": "linear-response"}
METHODS: dict[str, dict[str, Any]] = {
    "pod-nn": {},
    "autoencoder": {},
    "pod-deeponet": LINEAR_RESPONSE,
    "deeponet": LINEAR_RESPONSE,
    "umesh-linear": {},
    "fno": LINEAR_RESPONSE,
    "transolver": LINEAR_RESPONSE,
    "graph-u-net": LINEAR_RESPONSE,
    "mesh-graph-net": LINEAR_RESPONSE,
    "umesh-small": {},
    "pod-nn-force": {},
    "pod-ann": {},
    "latent-galerkin": {},
    "latent-lspg": {},
    "pod-nn-derivative": {},
    "pod-nn-ensemble": {},
    "pca-regression-linear": {},
    "pca-ridge": {},
    "pca-kernel-ridge": {},
    "pca-gaussian-process": {},
    "pca-random-forest": {},
    "pca-extra-trees": {},
    "sparse-polynomial": {},
    "sparse-polynomial-derivative": {},
    "pgd-snapshots": {},
    "pca-regression": {},
    "pca-polynomial-force": {},
    "sparse-polynomial-force": {},
    "pgd-snapshots-force": {},
}
"""Methods, and parameters that replace those of their files.

Those without iterations are fitted to the numbers of samples alone. Methods without a seed are
fitted once for each number.
"""

BY_DEFAULT = ["pod-nn", "autoencoder"]

SHARES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Numbers of iterations, relative to those of the method's file."""
SAMPLES = (64, 256, 1024)
"""Numbers of training samples, beside all; trained for the iterations of the method's file."""
SEEDS = (0, 1, 2)
FLAT = 0.05
"""Fall of the validation error by a doubling of the iterations below which a curve is flat."""


@dataclass(frozen=True)
class Point:
    """A training: all but the seed says where it stands on a curve.

    A method may have no iterations, and a method without a seed has one point.
    """

    method: str
    n_train: int
    iterations: int
    seed: int = 0

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the method."""
        seed = {"seed": self.seed} if takes_seed(self.method) else {}
        iterations = {"iterations": self.iterations} if self.iterations else {}
        return METHODS[self.method] | iterations | seed


@cache
def takes_seed(method: str) -> bool:
    """Return whether a method draws random numbers."""
    return "seed" in mor_bench.load_method(method).parameters


@cache
def dataset_of(name: str) -> Dataset:
    return mor_bench.load_dataset(name)


def trained_on_gpu(dataset: str, wanted: Point) -> dict[str, Any]:
    """Return a point with its seconds beside other trainings, and its errors."""
    data = dataset_of(dataset)
    made: Any = mor_bench.load_method(wanted.method, **wanted.parameters)
    made.training = TrainingOptions(device="cuda")
    begun = perf_counter()
    made.fit(data.scene, data.train[: wanted.n_train])
    return {
        **vars(wanted),
        "gpu_s": perf_counter() - begun,
        "validation": scored(made, data.validation),
        "test": scored(made, data.test),
    }


def trained(dataset: str, wanted: Point) -> dict[str, Any]:
    """Return a point with its core-seconds and its errors of validation and test."""
    data = dataset_of(dataset)
    train = data.train[: wanted.n_train]
    with pinned_threads(1):
        # Kernels are compiled before the training that is timed.
        short = {"iterations": 1} if wanted.iterations else {}
        first = mor_bench.load_method(wanted.method, **(wanted.parameters | short))
        first.fit(data.scene, train[:64])
        made = mor_bench.load_method(wanted.method, **wanted.parameters)
        begun = process_time()
        made.fit(data.scene, train)
        return {
            **vars(wanted),
            "core_s": process_time() - begun,
            "validation": scored(made, data.validation),
            "test": scored(made, data.test),
        }


def seconds_of(point: dict[str, Any]) -> float:
    """Return the core-seconds of a point, or its seconds on a graphics processor."""
    return float(point["gpu_s"] if "gpu_s" in point else point["core_s"])


@dataclass
class Curves:
    """The points of all curves, in a file that each new point extends.

    Attributes
    ----------
    dataset : str
    file : Path
    trainings : Executor
        Trains the points, each in one process, or in one thread for a graphics processor.
    train : callable
        `trained` or `trained_on_gpu`.
    most_s : float
        Longest training, in core-seconds or seconds of a graphics processor, as the one before it
        predicts.
    points : list of dict
        Method, samples, iterations, seed, core-seconds, and errors of validation and test.
    """

    dataset: str
    file: Path
    trainings: Executor
    train: Callable[[str, Point], dict[str, Any]]
    most_s: float
    points: list[dict[str, Any]] = field(default_factory=list)
    lock: Lock = field(default_factory=Lock)

    def read(self) -> None:
        """Take the points of the file, if it exists."""
        if self.file.exists() and self.file.stat().st_size:
            self.points = json.loads(self.file.read_text(encoding="utf-8"))["points"]

    def of_all_seeds(self, method: str, n_train: int, iterations: int) -> list[dict[str, Any]]:
        """Return the points of all seeds; train for those that are not known."""
        seeds = SEEDS if takes_seed(method) else SEEDS[:1]
        wanted = [Point(method, n_train, iterations, seed) for seed in seeds]
        unknown = [one for one in wanted if self._known(one) is None]
        running = [self.trainings.submit(self.train, self.dataset, one) for one in unknown]
        for one in running:
            self._add(one.result())
        return [found for one in wanted if (found := self._known(one)) is not None]

    def _known(self, wanted: Point) -> dict[str, Any] | None:
        with self.lock:
            return next((p for p in self.points if vars(wanted).items() <= p.items()), None)

    def _add(self, found: dict[str, Any]) -> None:
        with self.lock:
            self.points.append(found)
            content = {"dataset": self.dataset, "points": self.points}
            write_atomically(self.file, (json.dumps(content, indent=1) + "\n").encode())
        names = [str(found[name]) for name in ("method", "n_train", "iterations", "seed")]
        error = f"{found['test']['mean_dof_m']:.3g} m"
        print(*names, f"{seconds_of(found):.0f} s", error, flush=True)

    def iterate(self, method: str, n_train: int, usual: int) -> None:
        """Double the iterations until the curve stays flat or the limit is met."""
        before, n_flat = float("inf"), 0
        for share in SHARES:
            found = self.of_all_seeds(method, n_train, round(share * usual))
            error = median(point["validation"]["mean_dof_m"] for point in found)
            seconds = median(seconds_of(point) for point in found)
            n_flat = n_flat + 1 if error > (1 - FLAT) * before else 0
            if (n_flat >= 2 and share >= 1) or 2 * seconds > self.most_s:
                break
            before = error
        self.of_all_seeds(method, n_train, usual)


def main(
    dataset: Annotated[str, typer.Option(help="Name or TOML file.")] = "beam-coarse",
    method: Annotated[list[str], typer.Option(help="One of METHODS.")] = BY_DEFAULT,
    most_core_s: Annotated[float, typer.Option(help="Longest training, core-seconds.")] = 120.0,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Of the trainings.")] = "cpu",
    jobs: Annotated[int, typer.Option(help="Trainings side by side.")] = 1,
    report: Annotated[
        Path,
        typer.Option("--json", metavar="FILE", help="Write points here, and keep those in it."),
    ] = Path("learning-curves.json"),
) -> None:
    """Measure errors of networks over numbers of iterations and of training samples."""
    whole = len(dataset_of(dataset).train)
    pool: Executor = ProcessPoolExecutor(jobs, get_context("spawn"))
    train = trained
    if device == "cuda":
        pool, train = ThreadPoolExecutor(jobs), trained_on_gpu
    with pool as trainings, ThreadPoolExecutor(jobs) as waiting:
        curves = Curves(dataset, report, trainings, train, most_core_s)
        curves.read()
        running: list[Future[Any]] = []
        for name in method:
            usual = int(load_method_spec(name).parameters.get("iterations", 0))
            if usual:
                running.append(waiting.submit(curves.iterate, name, whole, usual))
            for n_train in SAMPLES if usual else (*SAMPLES, whole):
                running.append(waiting.submit(curves.of_all_seeds, name, n_train, usual))
        for one in running:
            one.result()


if __name__ == "__main__":
    typer.run(main)
