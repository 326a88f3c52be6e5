"""Largest deformation and share of refused loads of a dataset, over the size of its loads.

    python -m tests.benchmarks.paper_amplitude beam-coarse --force 1 --force 1.4
    python -m tests.benchmarks.paper_amplitude beam-coarse --force 1.4 --main --samples 2000

The loads are those of the named test sets, the main plan with other draws. With ``--main`` they
are the test part of the main plan, split by sample as in the paper. ``--force`` is the upper end
of `magnitude_n`. A refused load has no valid equilibrium. The loads of
`datasets/*-paper.toml` and `paper_magnitude_n` in `datasets/*.toml` come from this table.
"""

from __future__ import annotations

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
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.sampling import PatchLoads, draw_loads, n_samples_of
from mor_bench.snapshots.split import split_samples
from mor_bench.snapshots.test_sets import spec_of_set
from mor_bench.specs import DatasetSpec, Split, load_generated_spec

CHUNK = 100


def loads_of(spec: DatasetSpec, upper: float, samples: int, *, main: bool) -> PatchLoads:
    """Return the first loads of a plan whose largest force is ``upper``, N."""
    base = spec if main else spec_of_set(spec, "in-range")
    changed = base.loads.model_copy(update={"magnitude_n": (spec.loads.magnitude_n[0], upper)})
    scene = load_scene(base.model_copy(update={"loads": changed}))
    loads = draw_loads(scene, 0, n_samples_of(scene) if main else samples)
    if main:
        split = Split(test_fraction=spec.split.test_fraction, by="sample")
        loads = loads[split_samples(loads, len(scene.patch_nodes), split, spec.loads.seed)[1]]
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
    refused = len(loads) - len(valid)
    return {
        "largest force, N": f"{upper:g}",
        "loads": len(loads),
        "refused": refused,
        "share": f"{100 * refused / len(loads):.2g} %",
        "inverted": n_inverted,
        "largest deformation, m": f"{valid.max():.4g}" if len(valid) else "–",
    }


def run(
    dataset: Annotated[str, typer.Argument(help="Name or TOML file.")],
    force: Annotated[list[float], typer.Option(help="Largest force, N. Repeat for more.")],
    samples: Annotated[int, typer.Option(min=1, help="Largest number of loads.")] = 200,
    main: Annotated[bool, typer.Option("--main", help="Test part of the main plan.")] = False,
) -> None:
    """Print the largest valid deformation and the refused loads for each size of the loads."""
    spec = load_generated_spec(dataset)
    rows = [measured(spec, upper, samples, main=main) for upper in force]
    table = Table(*rows[0], title=dataset)
    for row in rows:
        table.add_row(*map(str, row.values()))
    Console(width=100).print(table)


if __name__ == "__main__":
    typer.run(run)
