"""Share of the search for negative curvature in the work of a solve, by counted work.

    python -m tests.benchmarks.probe_cost --json FILE

Each load is solved with the search of the accelerated pass and without it. The difference is the
work of the search, with the iterations that it causes. A uniform force on the end face moves it by
the amplitude. No clock is read, and the counts are the same on every machine.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import typer
from rich.console import Console
from rich.table import Table

import mor_bench
from mor_bench.cli.option_groups import with_options
from mor_bench.counting import Cost, counted
from mor_bench.mechanics import accelerated
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from tests.benchmarks.contenders import TOLERANCE, Array
from tests.benchmarks.peers import bending_loads

AMPLITUDES_M = [0.25, 0.5, 1.0, 2.0]
UNITS = ("element_evaluations", "back_solves", "multiply_adds")


class NoSearch:
    """Takes the place of a search: it accepts every solution."""

    over = convex = True

    def __init__(self, *_: object) -> None: ...
    def arrive(self, *_: object) -> None: ...
    def take(self, *_: object) -> None: ...
    def disturb(self, *_: object) -> None: ...
    def asked(self, *_: object) -> list[Array]:
        return []


def work_of(model: FullOrderModel, load: Array) -> tuple[Cost, int]:
    """Return the counted work of a solve and its iterations."""
    with counted() as cost:
        solution = model.solve(load, options=NewtonOptions(TOLERANCE))
    return cost, solution.iterations


def measured(model: FullOrderModel, load: Array) -> dict[str, Any]:
    """Return the counted work of a solve with and without the search, and the search's share."""
    whole, iterations = work_of(model, load)
    with mock.patch.object(accelerated, "search_of", NoSearch):
        bare, alone = work_of(model, load)
    shares = {unit: 1 - getattr(bare, unit) / getattr(whole, unit) for unit in UNITS}
    return {
        "iterations": iterations,
        "iterations_without": alone,
        "with_search": asdict(whole),
        "without_search": asdict(bare),
        "shares": shares,
    }


@with_options
def main(
    dataset: Annotated[str, typer.Option(help="Whose body is bent.")] = "beam-fine",
    amplitude: Annotated[
        list[float] | None,
        typer.Option(help="Displacement of the end face, m; repeat for more.", show_default=False),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Also write the counts to this file.")
    ] = None,
) -> None:
    """Count the share of the search for negative curvature in the work of a solve."""
    scene = mor_bench.load_scene(dataset)
    amplitudes = sorted(amplitude or AMPLITUDES_M)
    model, rows = FullOrderModel(scene), []
    model.prepare()
    for size, forces in zip(amplitudes, bending_loads(scene, amplitudes), strict=True):
        load = forces.ravel()[scene.free_dofs]
        rows.append({"amplitude_m": size, **measured(model, load)})
    table = Table(title=f"{dataset}: share of the search for negative curvature, %")
    iterations = "iterations without it", "with it"
    for column in ("amplitude, m", *iterations, "residuals", "back-solves", "multiply-adds"):
        table.add_column(column, justify="right")
    for row in rows:
        shares = [f"{100 * row['shares'][unit]:.1f}" for unit in UNITS]
        counts = f"{row['iterations_without']}", f"{row['iterations']}"
        table.add_row(f"{row['amplitude_m']:g}", *counts, *shares)
    Console().print(table)
    if json_file is not None:
        record = {"dataset": dataset, "loads": rows}
        json_file.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
