"""Largest deformation and share of refused loads of a dataset, over the size of its loads.

    python -m tests.benchmarks.paper_amplitude --json paper-amplitude.json
    python -m tests.benchmarks.paper_amplitude beam-coarse --force 1 --force 1.4
    python -m tests.benchmarks.paper_amplitude beam-coarse --force 1.4 --main --samples 1280

The loads of the part `set` are those of the named test sets, the main plan with other draws. Those
of the part `test` (``--main``) are the test part of the main plan, split by sample as in the
paper. ``--force`` is the upper end of `magnitude_n`. A refused load has no valid equilibrium. The
loads of `datasets/*-paper.toml` and `paper_magnitude_n` in `datasets/*.toml` come from this table.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from mor_bench.errors import InvertedElementError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import Solution
from mor_bench.report.published_figures import SAME_AMPLITUDE, SCENES, scene_of
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import draw_loads, n_samples_of
from mor_bench.snapshots.split import split_samples
from mor_bench.snapshots.test_sets import spec_of_set
from mor_bench.specs import DatasetSpec, Split, list_suite, load_generated_spec

CHUNK = 100
WHOLE = 10**9
"""No limit on the number of loads."""

FURTHER = {"liver-tet": (0.6, 0.8, 1.0, 1.3, 2.0, 3.0)}
"""Largest forces of a scene whose loads are refused before it deforms as in the paper, N."""


def loads_of(spec: DatasetSpec, upper: float, samples: int, *, main: bool) -> PatchLoads:
    """Return the first loads of a plan whose largest force is ``upper``, N."""
    base = spec if main else spec_of_set(spec, "in-range")
    changed = base.load_plan.model_copy(
        update={"magnitude_n": (spec.load_plan.magnitude[0], upper)}
    )
    scene = load_scene(base.model_copy(update={"loads": changed}))
    loads = draw_loads(scene, 0, n_samples_of(scene) if main else samples)
    if main:
        split = Split(test_fraction=spec.split.test_fraction, by="sample")
        loads = loads[split_samples(loads, len(scene.patch_nodes), split, spec.load_plan.seed).test]
    return loads[:samples]


def solve(scene: Scene, loads: PatchLoads) -> tuple[NDArray[np.float64], int]:
    """Return the largest displacement per load, NaN if refused, and the number of inversions."""
    model = FullOrderModel(scene)
    amplitudes, n_inverted = np.full(len(loads), np.nan), 0
    for start in range(0, len(loads), CHUNK):
        some = loads[start : start + CHUNK].nodal_forces(scene.patch_weights)
        free = some.reshape(len(some), -1)[:, scene.free_dofs]
        for i, found in enumerate(model.solve_many(free), start):
            if isinstance(found, Solution):
                u = found.displacement.reshape(-1, 3)
                amplitudes[i] = np.linalg.norm(u, axis=1).max()
            n_inverted += isinstance(found, InvertedElementError)
    return amplitudes, n_inverted


def measured(spec: DatasetSpec, upper: float, samples: int, *, main: bool) -> dict[str, Any]:
    """Return the figures of one size of the loads."""
    loads = loads_of(spec, upper, samples, main=main)
    with threadpool_limits(1):
        amplitudes, n_inverted = solve(load_scene(spec), loads)
    valid = amplitudes[np.isfinite(amplitudes)]
    return {
        "dataset": spec.name,
        "part": "test" if main else "set",
        "force_n": upper,
        "loads": len(loads),
        "refused": len(loads) - len(valid),
        "inverted": n_inverted,
        "largest_m": float(valid.max()),
    }


def published(datasets: list[str]) -> Iterator[dict[str, Any]]:
    """Measure the paper's scenes with their own loads and with those at the paper's deformation."""
    for name in datasets:
        spec = load_generated_spec(name)
        own, paper = spec.load_plan.magnitude[1], spec.tests.paper_magnitude_n
        yield measured(spec, own, WHOLE, main=True)
        if paper is not None:
            yield measured(spec, paper[1], spec.tests.samples, main=False)
        if name + SAME_AMPLITUDE in list_suite("datasets"):
            larger = load_generated_spec(name + SAME_AMPLITUDE)
            yield measured(larger, larger.load_plan.magnitude[1], WHOLE, main=True)
        for force in FURTHER.get(name, ()):
            yield measured(spec, force, WHOLE, main=True)


def run(
    dataset: Annotated[
        list[str] | None, typer.Argument(help="Names or files. Default: the paper's scenes.")
    ] = None,
    force: Annotated[list[float] | None, typer.Option(help="Largest force, N; repeat.")] = None,
    samples: Annotated[int, typer.Option(min=1, help="Largest number of loads.")] = 200,
    main: Annotated[bool, typer.Option("--main", help="Test part of the main plan.")] = False,
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures here.")
    ] = None,
) -> None:
    """Print the largest valid deformation and the refused loads for each size of the loads."""
    names = dataset or list(SCENES)
    if force:
        specs = [load_generated_spec(name) for name in names]
        rows = [measured(spec, f, samples, main=main) for spec in specs for f in force]
    else:
        rows = list(published(names))
    table = Table("dataset", "part", "N", "loads", "refused", "inverted", "largest, m", "paper, m")
    for row in rows:
        scene = SCENES.get(scene_of(row["dataset"]))
        row["paper_m"] = scene and scene.amplitude_m
        share = f"{row['refused']} ({100 * row['refused'] / row['loads']:.2g} %)"
        shown = {**row, "refused": share, "largest_m": f"{row['largest_m']:.4g}"}
        table.add_row(*map(str, shown.values()))
    Console(width=110).print(table)
    if report is not None:
        report.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(run)
