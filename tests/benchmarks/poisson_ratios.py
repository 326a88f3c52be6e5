"""Work of multigrid against Poisson's ratio and the size of the mesh, by counted work.

    python -m tests.benchmarks.poisson_ratios --json FILE

A cube of nearly incompressible neo-Hookean material, held at one side, carries five loads on
patches of its top. Selective integration prevents locking. No clock is read, and the counts depend
on the machine only where round-off changes a number of iterations.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

import mor_bench
from mor_bench.cli.option_groups import with_options
from mor_bench.counting import counted
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.snapshots.sampling import draw_loads

RATIOS = [0.3, 0.4, 0.45, 0.48, 0.49, 0.495, 0.499]
SIZES = [24, 32]
"""Cells along an edge; on a coarser cube the banded factor takes the place of multigrid."""
N_LOADS = 5


def measure(across: int, poisson: float) -> dict[str, Any]:
    """Return the median iterations and counted work of a solve, and the cycles per back-solve."""
    spec = mor_bench.load_scene("beam-nearly-incompressible").spec.model_dump(mode="json")
    spec["geometry"] = {"shape": "box", "size_m": [1.0, 1.0, 1.0], "cells": [across] * 3}
    spec["material"]["poisson"] = poisson
    scene = mor_bench.load_scene(spec)
    model = FullOrderModel(scene)
    model.prepare()
    assert isinstance(model.rest_factor, MultigridFactor)
    n_patches = len(scene.patch_nodes)
    numbers = (np.linspace(0.3, 0.95, N_LOADS) * n_patches).astype(int)
    drawn = draw_loads(scene, 0, n_patches)[numbers]
    forces = drawn.nodal_forces(scene.patch_weights).reshape(N_LOADS, -1)[:, scene.free_dofs]
    iterations, multiply_adds = [], []
    for force in forces:
        with counted() as cost:
            iterations.append(model.solve(force).iterations)
        multiply_adds.append(cost.multiply_adds)
    return {
        "unknowns": model.n_unknowns,
        "poisson": poisson,
        "cycles": model.rest_factor.n_cycles,
        "iterations": float(np.median(iterations)),
        "most_iterations": max(iterations),
        "multiply_adds": float(np.median(multiply_adds)),
    }


@with_options
def main(
    size: Annotated[
        list[int] | None,
        typer.Option(min=24, help="Cells along an edge; repeat for more.", show_default=False),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Also write the counts to this file.")
    ] = None,
) -> None:
    """Count the work of multigrid against Poisson's ratio."""
    rows = [measure(across, poisson) for across in size or SIZES for poisson in RATIOS]
    table = Table("unknowns", "Poisson's ratio", "cycles", "iterations", "most", "multiply-adds")
    for row in rows:
        table.add_row(
            f"{row['unknowns']:,}",
            f"{row['poisson']:g}",
            f"{row['cycles']}",
            f"{row['iterations']:.0f}",
            f"{row['most_iterations']}",
            f"{row['multiply_adds']:.2e}",
        )
    Console().print(table)
    if json_file is not None:
        json_file.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
