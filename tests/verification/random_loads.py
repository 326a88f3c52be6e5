"""Solve random loads in bulk, check every answer, and count refusals by reason.

    python -m tests.verification.random_loads beam-coarse 10000
    python -m tests.verification.random_loads beam-fine 1000
    python -m tests.verification.random_loads beam-coarse 2000 --times 8

An answer is valid if its residual, evaluated afresh, is within the tolerance, det F > 0 at every
quadrature point, and the tangent has a Cholesky factor: the equilibrium is stable. The program
fails if any answer is invalid.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import track
from threadpoolctl import threadpool_limits

import mor_bench
from mor_bench.mechanics.banded import BandedCholesky
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, Solution
from mor_bench.snapshots.sampling import draw_loads

CHUNK = 100
TOLERANCE = NewtonOptions().tolerance


def main(
    dataset: Annotated[str, typer.Argument(help="Name or TOML file.")],
    n_loads: Annotated[int, typer.Argument(min=1, help="Loads, drawn as the dataset draws them.")],
    times: Annotated[float, typer.Option(min=0, help="Factor on every load.")] = 1.0,
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the counts here.")
    ] = None,
) -> None:
    """Solve random loads and check every answer."""
    threadpool_limits(1)
    scene = mor_bench.load_scene(dataset)
    model, cholesky = FullOrderModel(scene), BandedCholesky(FullOrderModel(scene).assembler.pattern)
    free = scene.free_dofs
    outcomes: Counter[str] = Counter()
    least, worst, iterations, cuts = np.inf, 0.0, [], 0
    for start in track(range(0, n_loads, CHUNK), description=dataset):
        drawn = draw_loads(scene, start, min(start + CHUNK, n_loads))
        loads = times * drawn.nodal_forces(scene.patch_weights).reshape(len(drawn), -1)[:, free]
        for load, found in zip(loads, model.solve_many(loads), strict=True):
            if not isinstance(found, Solution):
                outcomes[f"refused: {type(found).__name__}"] += 1
                continue
            state, tangent = model.linearise(found.displacement)
            residual = float(np.linalg.norm(load - state.force) / np.linalg.norm(load))
            least, worst = min(least, state.min_det_f), max(worst, residual)
            iterations.append(found.iterations)
            cuts += found.cuts
            problem = (
                "inverted"
                if not state.min_det_f > 0
                else "residual too large"
                if residual > 1.01 * TOLERANCE
                else ""
            )
            try:
                cholesky.factor(tangent)
            except NotPositiveDefiniteError:
                problem = problem or "unstable"
            outcomes[f"INVALID: {problem}" if problem else "valid"] += 1
    for outcome, count in outcomes.items():
        print(f"{outcome}: {count}")
    if iterations:
        print(f"least det F {least:.3f}, largest residual {worst:.1e} of the load")
        middle, most = np.median(iterations), max(iterations)
        print(f"iterations: median {middle:.0f}, most {most}; cut-backs: {cuts}")
    if report is not None:
        content = {
            "dataset": dataset,
            "loads": n_loads,
            "times": times,
            "outcomes": dict(outcomes),
            "least_det_f": least,
            "largest_residual": worst,
            "iterations_median": float(np.median(iterations)) if iterations else None,
            "iterations_most": max(iterations, default=None),
            "cut_backs": cuts,
        }
        report.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    if any(outcome.startswith("INVALID") for outcome in outcomes):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
