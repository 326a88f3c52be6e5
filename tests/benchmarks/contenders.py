"""What the comparisons with other codes share: contenders, their checked rows, and options."""

from __future__ import annotations

import gc
import json
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, ClassVar

import numpy as np
import typer
from numpy.typing import NDArray
from pydantic import Field
from rich.console import Console

from mor_bench.machine import describe_machine
from mor_bench.options import CommandLine, Options
from mor_bench.scene.materials import SaintVenantKirchhoff
from mor_bench.scene.scene import Scene
from tests.benchmarks.instructions import AVX2

Array = NDArray[np.float64]

TOLERANCE = 1e-8
MAX_RESIDUAL = 1.01 * TOLERANCE
"""The residuals of two codes differ by round-off."""
MAX_DIFFERENCE = 1e-6
MAX_STEPS = 30
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


class DisagreementError(RuntimeError):
    """A contender did not solve the problem that the others solved."""


class Contender(ABC):
    """A code that solves one scene under one load at a time. Only `solve` is timed."""

    name: str

    @abstractmethod
    def prepare(self, forces: Array) -> None:
        """Take (n_nodes, 3) nodal forces, N, and go back to rest."""

    @abstractmethod
    def solve(self) -> int:
        """Solve, and return the number of Newton steps."""

    @abstractmethod
    def displacement(self) -> Array:
        """(n_nodes, 3) of the last solve, m."""


def common_material(scene: Scene) -> SaintVenantKirchhoff:
    """The law of a scene that all sides can solve."""
    if (
        not isinstance(scene.material, SaintVenantKirchhoff)
        or scene.selective
        or scene.mesh.cells.shape[1] != 8
    ):
        raise ValueError(
            f"{scene.name}: the peers are set up for Saint Venant-Kirchhoff in fully integrated "
            "8-node hexahedra only."
        )
    return scene.material


def installed(distribution: str) -> bool:
    try:
        version(distribution)
    except PackageNotFoundError:
        return False
    return True


@dataclass
class Row:
    """What one contender did, for each load."""

    name: str
    times_ms: list[list[float]] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)
    differences: list[float] = field(default_factory=list)

    residual_name: ClassVar[str] = "relative residual"

    @property
    def medians_ms(self) -> Array:
        return np.median(self.times_ms, axis=1)

    @property
    def shown_steps(self) -> str:
        """The fewest and the most steps."""
        return "-".join(map(str, sorted({min(self.steps), max(self.steps)})))

    def check(self, residual: float, u: Array, expected: Array) -> None:
        """Record the residual of an answer and its difference from the expected one.

        Raises
        ------
        DisagreementError
            If one of them is above its tolerance.
        """
        self.residuals.append(residual)
        self.differences.append(float(np.linalg.norm(u - expected) / np.linalg.norm(expected)))
        if not (residual <= MAX_RESIDUAL and self.differences[-1] <= MAX_DIFFERENCE):
            raise DisagreementError(
                f"{self.name} solves another problem: its {self.residual_name} is "
                f"{residual:.2g} (allowed: {TOLERANCE:g}), its displacement differs by "
                f"{self.differences[-1]:.2g} (allowed: {MAX_DIFFERENCE:g})."
            )


def timed(contender: Contender, forces: Array) -> tuple[float, int]:
    contender.prepare(forces)
    gc.disable()
    try:
        start = perf_counter()
        steps = contender.solve()
        return 1e3 * (perf_counter() - start), steps
    finally:
        gc.enable()


def pin_threads(module: str, threads: int, *, avx2: bool = False) -> None:
    """Start the running module anew with this many threads in every library, unless it has been.

    With `avx2`, the libraries are held to AVX2 too.
    """
    pinned = dict.fromkeys(THREAD_VARIABLES, str(threads)) | (AVX2 if avx2 else {})
    if any(
        os.environ.get(name) != value for name, value in pinned.items()
    ):  # libraries read them when they are loaded
        os.execve(
            sys.executable, [sys.executable, "-m", module, *sys.argv[1:]], {**os.environ, **pinned}
        )


class TimingOptions(Options):
    """Options of the comparisons with other codes."""

    loads: Annotated[int, Field(ge=1, description="Loads of each dataset.")] = 5
    rounds: Annotated[int, Field(ge=1, description="Solves of each load.")] = 3
    threads: Annotated[int, Field(ge=1, description="Threads of every contender.")] = 1
    avx2: Annotated[bool, Field(description="Hold all libraries to AVX2.")] = False
    report: Annotated[
        Path | None,
        Field(description="Also write everything to this file."),
        CommandLine("--json", metavar="FILE"),
    ] = None

    def write(self, content: dict[str, Any]) -> None:
        """Write the report, if it is wanted."""
        if self.report is not None:
            whole = {
                "machine": describe_machine(),
                "threads": self.threads,
                "avx2_only": self.avx2,
                **content,
            }
            self.report.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


@contextmanager
def ends_at_disagreement(console: Console) -> Iterator[None]:
    """Say why there is no comparison, and exit, if a contender solves another problem."""
    try:
        yield
    except DisagreementError as error:
        console.print(f"no comparison: {error}", style="red", markup=False)
        raise typer.Exit(1) from None
