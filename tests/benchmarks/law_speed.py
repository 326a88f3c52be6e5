"""Time of a residual and of a tangent for every law on every element, per multiply-add.

    python -m tests.benchmarks.law_speed --json FILE

All run on one thread on a beam of similar size, in turns: each round evaluates every combination
once, in a random order. A combination's time is its median over the rounds, divided by its counted
multiply-adds. The table divides this by the same figure of Saint Venant-Kirchhoff on fully
integrated hexahedra. A ratio of 1 means that a law costs what its arithmetic costs. Divisions,
roots, powers and exponentials count as one multiply-add each, though they take longer.
"""

from __future__ import annotations

import gc
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from mor_bench.counting import counted
from mor_bench.hard_cases.setups import of_order
from mor_bench.machine import describe_machine
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import Discretisation
from mor_bench.scene.mesh import box_mesh
from tests.benchmarks.contenders import Array, pin_threads
from tests.verification.laws_and_elements import ELEMENTS, LAWS, mesh_options

CELLS = {"hexahedron": (27, 11, 11), "tetrahedron": (18, 7, 7), "quadratic tetrahedron": (12, 5, 5)}
"""Cells along the axes of the box before it is divided into tetrahedra."""

KINDS = ("residual", "tangent")
Kernel = Callable[[Array], object]
BASE = "saint-venant-kirchhoff", "H8"


@dataclass
class Measured:
    """Times, ms, and multiply-adds of a law on an element, for both kinds."""

    law: str
    element: str
    cells: int
    multiply_adds: dict[str, float]
    times_ms: dict[str, list[float]] = field(default_factory=lambda: {kind: [] for kind in KINDS})

    def per_multiply_add_ns(self, kind: str) -> float:
        return 1e6 * float(np.median(self.times_ms[kind])) / self.multiply_adds[kind]


def element_name(element: str, selective: bool) -> str:
    short = {"hexahedron": "H8", "tetrahedron": "T4", "quadratic tetrahedron": "T10"}[element]
    return f"{short}, selective" if selective else short


def assemblers() -> dict[tuple[str, str], tuple[Assembler, Array]]:
    """Return the assembler of each law on each element, and moderate displacements."""
    found = {}
    for element, selective in ELEMENTS:
        options = mesh_options(element)
        box = box_mesh((4.0, 1.0, 1.0), CELLS[element], options["tetrahedra"])
        mesh = of_order(box, options["order"])
        free = np.arange(mesh.n_dofs).reshape(-1, 3)
        x = mesh.points
        u = 0.05 * np.stack([x[:, 1] * x[:, 2], x[:, 0] ** 2 / 4, -x[:, 0] * x[:, 2] / 2], axis=1)
        for name, law in LAWS.items():
            body = Discretisation(mesh.points, mesh.cells, law, selective)
            key = name, element_name(element, selective)
            found[key] = Assembler(body, free, mesh.n_dofs), u.ravel()
    return found


def kernels_of(assembler: Assembler) -> dict[str, Kernel]:
    return {"residual": assembler.force, "tangent": assembler.force_and_tangent}


def measure(rounds: int) -> list[Measured]:
    """Time everything in turns."""
    found, rows = assemblers(), {}
    for (law, element), (assembler, u) in found.items():
        work = {}
        for kind, kernel in kernels_of(assembler).items():
            kernel(u)  # compiles
            with counted() as cost:
                kernel(u)
            work[kind] = float(cost.multiply_adds)
        rows[law, element] = Measured(law, element, assembler.n_cells, work)
    turns = [(key, kind) for key in found for kind in KINDS]
    generator = np.random.default_rng(0)
    gc.disable()
    for _ in range(rounds):
        for number in generator.permutation(len(turns)):
            key, kind = turns[number]
            assembler, u = found[key]
            kernel = kernels_of(assembler)[kind]
            begun = perf_counter()
            kernel(u)
            rows[key].times_ms[kind].append(1e3 * (perf_counter() - begun))
    gc.enable()
    return list(rows.values())


def record_of(row: Measured, base: Measured) -> dict[str, Any]:
    """Return a combination's figures; its ratios are per multiply-add, over those of the base."""
    record: dict[str, Any] = {"law": row.law, "element": row.element, "cells": row.cells}
    for kind in KINDS:
        record[f"{kind}_ms"] = float(np.median(row.times_ms[kind]))
        record[f"{kind}_multiply_adds"] = row.multiply_adds[kind]
        ratio = row.per_multiply_add_ns(kind) / base.per_multiply_add_ns(kind)
        record[f"{kind}_ratio"] = ratio
    return record


def main(
    rounds: Annotated[int, typer.Option(min=1, help="Evaluations of each combination.")] = 30,
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures here.")
    ] = None,
) -> None:
    """Time residuals and tangents of every law on every element."""
    pin_threads("tests.benchmarks.law_speed", 1)
    rows = measure(rounds)
    base = next(row for row in rows if (row.law, row.element) == BASE)
    records = [record_of(row, base) for row in rows]
    headings = "law", "element", "residual, ms", "ratio", "tangent, ms", "ratio"
    table = Table(*headings)
    for record in records:
        figures = [f"{record[f'{kind}_{what}']:.3g}" for kind in KINDS for what in ("ms", "ratio")]
        table.add_row(record["law"], record["element"], *figures)
    Console().print(table)
    if report is not None:
        content = {"machine": describe_machine(), "rounds": rounds, "rows": records}
        report.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
