"""Compare ways to choose training loads: errors at equal numbers of snapshots and at equal cost.

    python -m tests.benchmarks.adaptive_sampling --json sampling.json

Every way chooses from the load patches of the training part, and every chosen load is solved for.
The designs fill the range of the loads with random, Latin hypercube or Sobol points; their cost is
that of the solves. `greedy` is `mor_bench.choose_snapshots`. `simplices` is the rule of EZyRB's
`optimal_mu` with errors of a cross-validation. Both begin with the random loads, and their cost
includes the fits, the estimates and the choice. Times are core-seconds of this process on one
thread.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Annotated, Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial import Delaunay

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.machine import pinned_threads
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.measure.predictions import predict_all
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.greedy import FIRST, GreedySampling, solved, training_loads
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import N_COORDINATES, design, forces_at
from mor_bench.specs import Loads, Sampling

Array = NDArray[np.float64]
Way = Literal["greedy, 4 candidates", "greedy, 16 candidates", "simplices"]

DATASETS = ("beam-coarse", "beam-neo-hooke")
METHODS: dict[str, dict[str, Any]] = {
    "pod": {"n_modes": 40, "tolerance": 1e-4},
    "pca-regression-linear": {"n_input_modes": 10},
}
DESIGNS: tuple[Sampling, ...] = ("random", "latin-hypercube", "sobol")
ADAPTIVE: tuple[Way, ...] = ("greedy, 4 candidates", "greedy, 16 candidates", "simplices")
CANDIDATES = {"greedy, 4 candidates": 4, "greedy, 16 candidates": 16}
"""Estimated errors for each chosen load."""
SIZES = (10, 20, 40, 80, 160, 320)
"""Numbers of snapshots."""
MORE_SIZES = (640, 1280)
"""Further sizes of the designs, which cost less per snapshot."""
N_TEST = 120
"""Largest number of test samples, spread evenly."""
N_FOLDS = 10
"""Folds of the cross-validation of `simplices`; as many as snapshots leave one out."""


def plan_of(scene: Scene) -> Loads:
    """Return the plan of a scene with one force on one patch at a time.

    Raises
    ------
    InvalidInputError
        If the scene has another plan.
    """
    plan = scene.generated.load_plan
    if not isinstance(plan, Loads) or plan.simultaneous != 1:
        raise InvalidInputError(f"{scene.name}: one force must act on one patch at a time.")
    return plan


def designed_loads(
    scene: Scene, patches: NDArray[np.int64], kind: Sampling, n: int, seed: int
) -> PatchLoads:
    """Return n loads whose patch, direction and magnitude fill their ranges together.

    The first coordinate of a design is the rank of the patch along x, then y, then z.

    Parameters
    ----------
    scene : Scene
    patches : (n_patches,) int64
        The patches that may be loaded.
    kind : str
        The design.
    n, seed : int
    """
    plan, generator = plan_of(scene), np.random.default_rng(seed)
    d = 1 + N_COORDINATES[plan.kind]
    unit = generator.uniform(size=(n, d)) if kind == "random" else design(kind, (seed,), n, d)
    ordered = patches[np.lexsort(scene.patch_centres[patches].T[::-1])]
    chosen = ordered[(unit[:, 0] * len(ordered)).astype(np.int64)]
    normals = scene.patch_normals[chosen][:, None]
    return PatchLoads(chosen[:, None], forces_at(plan, unit[:, None, 1:], normals))


class SimplexSampling(GreedySampling):
    """Next loads at the worst simplices of those so far, the rule of EZyRB's `optimal_mu`.

    The coordinates of a load are the centre of its patch and its force. A simplex is bad if it is
    large and the method errs at its corners, when these are left out of the fit. The new load is
    the mean of the corners, weighted by their errors, on the nearest patch.
    """

    def choose(self, k: int) -> PatchLoads:
        """Return k new loads, which need not be among the given ones."""
        errors = self._cross_validated()
        with self.timed("choose"):
            patches = np.unique(self.loads.patches)
            places = self.scene.patch_centres[patches]
            low, span = places.min(axis=0), np.ptp(places, axis=0)
            low, span, used = low[span > 0], span[span > 0], span > 0
            largest = plan_of(self.scene).magnitude[1]
            places = (places[:, used] - low) / span
            rank = np.searchsorted(patches, self.snapshots.loads.patches[:, 0])
            forces = self.snapshots.loads.vectors[:, 0] / largest
            points = np.hstack([places[rank], forces])
            corners = Delaunay(points).simplices
            volumes = np.abs(np.linalg.det(points[corners[:, 1:]] - points[corners[:, :1]]))
            chosen = corners[np.argsort(-errors[corners].sum(axis=1) * volumes)[:k]]
            weights = errors[chosen] / errors[chosen].sum(axis=1, keepdims=True)
            found = np.einsum("sc,scd->sd", weights, points[chosen])
            n = places.shape[1]
            apart = np.linalg.norm(found[:, None, :n] - places, axis=2)
            return PatchLoads(patches[apart.argmin(axis=1)][:, None], largest * found[:, None, n:])

    def _cross_validated(self) -> Array:
        """Return the relative error at each snapshot when it is left out of the fit; at most 1."""
        n = len(self.snapshots)
        fold, errors = self.random.permutation(n) % N_FOLDS, np.ones(n)
        for number in range(N_FOLDS):
            held = self.snapshots[np.flatnonzero(fold == number)]
            self.fit(self.snapshots[np.flatnonzero(fold != number)])
            with self.timed("choose"):
                found = self.predicted(held.forces)
                relative = sample_errors(found, held.displacements).relative_l2
                errors[fold == number] = np.clip(relative, 1e-12, 1.0)
        return errors


@dataclass(frozen=True)
class Task:
    """A scene with a model that is ready, its training loads and its test samples."""

    scene: Scene
    model: FullOrderModel
    loads: PatchLoads
    test: Snapshots

    @classmethod
    def of(cls, name: str) -> Task:
        """Load a dataset and prepare its model."""
        data = mor_bench.load_dataset(name)
        model = FullOrderModel(data.scene)
        model.prepare()
        test = data.test[:: -(-len(data.test) // N_TEST)]
        return cls(data.scene, model, training_loads(data.scene), test)

    @property
    def patches(self) -> NDArray[np.int64]:
        """The load patches of the training part."""
        return np.unique(self.loads.patches)

    def sampling(self, way: Way, method: str, seed: int) -> GreedySampling:
        """Return an adaptive choice for a method, which begins with the random loads."""
        made = mor_bench.load_method(method, **METHODS[method])
        if way == "simplices":
            found: GreedySampling = SimplexSampling(made, self.scene, self.loads, seed=seed)
        else:
            found = GreedySampling(made, self.scene, self.loads, CANDIDATES[way], seed)
        found.add(designed_loads(self.scene, self.patches, "random", FIRST, seed))
        return found

    def designed(
        self, kind: Sampling, sizes: Sequence[int], seed: int
    ) -> Iterator[tuple[Snapshots, dict[str, float]]]:
        """Yield the snapshots of designs of several sizes, and their core-seconds."""
        for n in sizes:
            loads = designed_loads(self.scene, self.patches, kind, n, seed)
            begun = process_time()
            found = solved(self.model, loads)
            yield found, {"solve": process_time() - begun, "fit": 0.0, "choose": 0.0}

    def adaptive(
        self, way: Way, method: str, sizes: Sequence[int], seed: int
    ) -> Iterator[tuple[Snapshots, dict[str, float]]]:
        """Yield the snapshots of a growing choice at several sizes, and their core-seconds."""
        sampling = self.sampling(way, method, seed)
        for n in sizes:
            yield sampling.grow(n), dict(sampling.core_s)

    def error(self, method: str, snapshots: Snapshots) -> dict[str, float | None]:
        """Fit a method, and return its relative errors in the test; None for infinity."""
        made = mor_bench.load_method(method, **METHODS[method])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of fewer snapshots than modes
            made.fit(self.scene, snapshots)
        errors = sample_errors(
            predict_all(made, self.test.given), self.test.displacements, self.scene.output_nodes
        ).relative_l2
        figures = {
            "median": float(np.median(errors)),
            "p95": float(np.percentile(errors, 95, method="higher")),
        }
        return {name: value if np.isfinite(value) else None for name, value in figures.items()}


def measured(task: Task, method: str, n_seeds: int, sizes: Sequence[int]) -> list[dict[str, Any]]:
    """Return a row for each way and number of snapshots, with a list over the seeds."""
    more = [*sizes, *(n for n in MORE_SIZES if sizes == SIZES)]
    rows: dict[tuple[str, int], dict[str, Any]] = {}
    for seed in range(n_seeds):
        curves: dict[str, Iterator[tuple[Snapshots, dict[str, float]]]] = {
            **{kind: task.designed(kind, more, seed) for kind in DESIGNS},
            **{way: task.adaptive(way, method, sizes, seed) for way in ADAPTIVE},
        }
        for name, curve in curves.items():
            for n, (snapshots, core_s) in zip(more, curve, strict=False):
                figures = {**task.error(method, snapshots), **core_s, "n_solved": len(snapshots)}
                row = rows.setdefault((name, n), {"way": name, "n": n})
                for key, value in figures.items():
                    row.setdefault(key, []).append(value)
                print(task.scene.name, method, name, n, seed, figures, flush=True)
    return list(rows.values())


def main(
    dataset: Annotated[
        list[str] | None, typer.Option(help="Name or TOML file; repeat for more.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of repetitions.")] = 3,
    size: Annotated[
        list[int] | None, typer.Option(min=1, help="Number of snapshots; repeat for more.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the results here.")
    ] = None,
) -> None:
    """Compare ways to choose training loads at equal numbers of snapshots and at equal cost."""
    content: dict[str, Any] = {}
    with pinned_threads(1):
        for name in dataset or DATASETS:
            task = Task.of(name)
            content[name] = {"n_test": len(task.test), "seeds": seeds, "methods": {}}
            for method in METHODS:
                for way in ADAPTIVE:  # compiles what a fit and an estimate need
                    task.sampling(way, method, seeds).grow(14)
                found = measured(task, method, seeds, tuple(sorted(size or SIZES)))
                content[name]["methods"][method] = found
    if report is not None:
        report.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
