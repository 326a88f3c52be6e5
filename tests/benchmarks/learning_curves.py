"""Errors of networks over their numbers of iterations and of training samples, with three seeds.

    python -m tests.benchmarks.learning_curves --json learning-curves.json

Every point is a training of its own, with its own learning-rate schedule. The iterations double
until a doubling lowers the error on validation samples by less than 5 %, or until a training would
take longer than the limit. Points that the file has already are not trained again, so that the same
command continues after an interruption.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from time import process_time
from typing import Annotated, Any

import typer

import mor_bench
from mor_bench.machine import pinned_threads
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import load_method_spec
from tests.benchmarks.choices import scored

LINEAR_RESPONSE = {"input": "linear-response"}
METHODS: dict[str, dict[str, Any]] = {
    "pod-nn": {},
    "autoencoder": {},
    "pod-deeponet": LINEAR_RESPONSE,
    "deeponet": LINEAR_RESPONSE,
}
"""Methods, and parameters that replace those of their files."""

SHARES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Numbers of iterations, relative to those of the method's file."""
SAMPLES = (64, 256, 1024)
"""Numbers of training samples, beside all; trained for the iterations of the method's file."""
SEEDS = (0, 1, 2)
FLAT = 0.05
"""Fall of the validation error by a doubling of the iterations below which a curve is flat."""
MOST_CORE_S = 120.0
"""Longest training, in core-seconds, as the one before it predicts."""


@dataclass
class Curves:
    """The points of all curves, in a file that each new point extends.

    Attributes
    ----------
    data : Dataset
    file : Path
    points : list of dict
        Method, samples, iterations, seed, core-seconds, and errors of validation and test.
    """

    data: Dataset
    file: Path
    points: list[dict[str, Any]] = field(default_factory=list)

    def read(self) -> None:
        """Take the points of the file, if it exists."""
        if self.file.exists() and self.file.stat().st_size:
            self.points = json.loads(self.file.read_text(encoding="utf-8"))["points"]

    def point(self, method: str, n_train: int, iterations: int, seed: int) -> dict[str, Any]:
        """Return one point; train for it unless it is known."""
        key = {"method": method, "n_train": n_train, "iterations": iterations, "seed": seed}
        for known in self.points:
            if key.items() <= known.items():
                return known
        made = mor_bench.load_method(method, **METHODS[method], iterations=iterations, seed=seed)
        with pinned_threads(1):
            begun = process_time()
            made.fit(self.data.scene, self.data.train[:n_train])
            found: dict[str, Any] = {
                **key,
                "core_s": process_time() - begun,
                "validation": scored(made, self.data.validation),
                "test": scored(made, self.data.test),
            }
        self.points.append(found)
        print(
            key, f"{found['core_s']:.0f} core-s", f"{found['test']['mean_dof_m']:.3g} m", flush=True
        )
        content = {"dataset": self.data.scene.name, "points": self.points}
        write_atomically(self.file, (json.dumps(content, indent=1) + "\n").encode())
        return found

    def median_of(self, method: str, n_train: int, iterations: int) -> tuple[float, float]:
        """Return the medians over the seeds of the validation error, m, and of the core-seconds."""
        found = [self.point(method, n_train, iterations, seed) for seed in SEEDS]
        errors = [point["validation"]["mean_dof_m"] for point in found]
        return median(errors), median(point["core_s"] for point in found)

    def iterate(self, method: str, usual: int) -> None:
        """Double the iterations until the curve is flat or the limit is met."""
        before, n_train = float("inf"), len(self.data.train)
        for share in SHARES:
            error, core_s = self.median_of(method, n_train, round(share * usual))
            if error > (1 - FLAT) * before or 2 * core_s > MOST_CORE_S:
                return
            before = error


def main(
    dataset: Annotated[str, typer.Option(help="Name or TOML file.")] = "beam-coarse",
    report: Annotated[
        Path,
        typer.Option("--json", metavar="FILE", help="Write points here, and keep those in it."),
    ] = Path("learning-curves.json"),
) -> None:
    """Measure errors of networks over numbers of iterations and of training samples."""
    curves = Curves(mor_bench.load_dataset(dataset), report)
    curves.read()
    for method in METHODS:
        # Kernels are compiled before the first training that is timed.
        mor_bench.load_method(method, **METHODS[method], iterations=1).fit(
            curves.data.scene, curves.data.train[: SAMPLES[0]]
        )
        usual = int(load_method_spec(method).parameters["iterations"])
        curves.iterate(method, usual)
        for n_train in SAMPLES:
            curves.median_of(method, n_train, usual)


if __name__ == "__main__":
    typer.run(main)
