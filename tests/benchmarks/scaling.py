"""Seconds and memory of the full-order solve against the size of the mesh, 1e3 to 3e5 unknowns.

    python -m tests.benchmarks.scaling --json scaling.json

Each size is a cantilever like the shipped beams, in a process of its own on one thread. The set-up
time covers imports, mesh, sparsity pattern and rest-state factor. The solve time is the median over
the loads. The loads are then solved again on two threads.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from .memory import peak_mb

SIZES = (4, 6, 8, 11, 14, 18, 23, 29)
"""Cells across; four times as many along."""
N_LOADS = 5


def measure(across: int) -> dict[str, Any]:
    """Return set-up time, solve time and peak memory of one size, in this process."""
    import mor_bench
    from mor_bench.machine import pinned_threads
    from mor_bench.mechanics.model import FullOrderModel
    from mor_bench.snapshots.sampling import draw_loads

    begun = perf_counter()
    spec = mor_bench.load_scene("beam-fine").spec.model_dump(mode="json")
    spec["geometry"]["cells"] = [4 * across, across, across]
    scene = mor_bench.load_scene(spec)
    model = FullOrderModel(scene)
    n_patches = len(scene.patch_nodes)
    # Away from the support, spread along the beam.
    numbers = np.linspace(0.3, 0.95, N_LOADS) * n_patches
    drawn = draw_loads(scene, 0, n_patches)[numbers.astype(int)]
    forces = drawn.nodal_forces(scene.patch_weights).reshape(N_LOADS, -1)[:, scene.free_dofs]
    _ = model.accelerator
    set_up = perf_counter() - begun

    def solves() -> tuple[list[float], list[int]]:
        model.solve(1e-3 * forces[0])
        seconds, iterations = [], []
        for force in forces:
            begun = perf_counter()
            iterations.append(model.solve(force).iterations)
            seconds.append(perf_counter() - begun)
        return seconds, iterations

    seconds, iterations = solves()
    with pinned_threads(2):
        two_threads = solves()[0]
    return {
        "across": across,
        "unknowns": model.n_unknowns,
        "rest_state": type(model.rest_factor).__name__,
        "set_up_s": set_up,
        "solve_s": float(np.median(seconds)),
        "two_threads_s": float(np.median(two_threads)),
        "iterations": float(np.median(iterations)),
        "peak_mb": peak_mb(),
    }


def main(
    size: Annotated[
        list[int] | None,
        typer.Option(
            min=2, help=f"Cells across; repeat for more. By default {SIZES}.", show_default=False
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures here.")
    ] = None,
    one: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Measure seconds and memory of the full-order solve against the number of unknowns."""
    if one:
        print(json.dumps(measure((size or SIZES)[0])))
        return
    pinned = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
    }
    table = Table(
        "cells",
        "unknowns",
        "rest state",
        "set-up s",
        "solve ms",
        "two threads ms",
        "iterations",
        "peak MB",
    )
    rows = []
    for across in size or SIZES:
        command = [sys.executable, "-m", "tests.benchmarks.scaling", "--one", "--size", str(across)]
        row = json.loads(
            subprocess.run(command, check=True, capture_output=True, text=True, env=pinned).stdout
        )
        rows.append(row)
        table.add_row(
            f"{4 * across} x {across} x {across}",
            f"{row['unknowns']:,}",
            row["rest_state"],
            f"{row['set_up_s']:.2f}",
            f"{1e3 * row['solve_s']:.2f}",
            f"{1e3 * row['two_threads_s']:.2f}",
            f"{row['iterations']:.0f}",
            f"{row['peak_mb']:.0f}",
        )
    console = Console()
    console.print(table)
    powers = growth(rows) if len(rows) > 1 else {}
    for key, power in powers.items():
        console.print(f"{key} grows as unknowns to the power {power:.2f}", highlight=False)
    if report is not None:
        report.write_text(json.dumps({"sizes": rows, "powers": powers}, indent=1) + "\n")


def growth(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Fit the power of the number of unknowns with which each known figure grows."""
    unknowns = np.log([row["unknowns"] for row in rows])
    logs = {key: np.log([row[key] for row in rows]) for key in ("solve_s", "set_up_s", "peak_mb")}
    return {
        key: float(np.polyfit(unknowns, values, 1)[0])
        for key, values in logs.items()
        if np.isfinite(values).all()
    }


if __name__ == "__main__":
    typer.run(main)
