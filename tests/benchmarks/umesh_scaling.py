"""Train U-Meshes of several sizes for several numbers of iterations, for a scaling law.

    python -m tests.benchmarks.umesh_scaling --json umesh-scaling.json

The dataset has the paper's deformation, and the split is the paper's: at random. Every number of
iterations is a training of its own, with its own learning-rate schedule. Rows that the file has
already are not trained again, so that the same command continues after an interruption.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.stats import t as student

import mor_bench
from mor_bench.machine import pinned_threads
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.store import write_atomically
from tests.benchmarks.choices import scored

ITERATIONS = (780, 1560, 3125, 6250, 12_500)
"""With batches of 32, the last number shows as many samples as the paper's 100,000 batches of 4."""

SIZES = ((4, 2, 12_500), (8, 2, 12_500), (16, 2, 12_500), (32, 2, 6250), (8, 3, 3125))
"""Channels, steps, and the largest number of iterations."""

PAPER = {"channels": 128, "steps": 3, "iterations": 12_500}
"""Size in the paper, and the number of iterations of 32 samples."""

HELD_OUT = {"channels": 32}
"""Rows that check how well a law that was fitted without them extrapolates."""

LEAST_CHANNELS = 8
"""Smaller networks do not count for the law: with 4 channels, it misses the size held out."""

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Law:
    """log e = coefficients · (1, log channels, log iterations, steps), by least squares.

    Attributes
    ----------
    coefficients : (4,) float64
    inverse : (4, 4) float64
        Inverse of the normal matrix.
    deviation : float
        Standard deviation of log e about the law.
    freedom : int
        Degrees of freedom: number of trainings minus number of coefficients.
    """

    coefficients: NDArray[np.float64]
    inverse: NDArray[np.float64]
    deviation: float
    freedom: int

    def predict(self, row: dict[str, Any]) -> tuple[float, float, float]:
        """Return e of a new training in m, and the ends of its prediction interval."""
        x = features([row])[0]
        middle = float(x @ self.coefficients)
        spread = self.deviation * float(np.sqrt(1.0 + x @ self.inverse @ x))
        reach = float(student.ppf(0.5 + CONFIDENCE / 2.0, self.freedom)) * spread
        low, mean, high = np.exp([middle - reach, middle, middle + reach])
        return float(mean), float(low), float(high)

    def interval(self, which: int) -> tuple[float, float]:
        """Return the confidence interval of a coefficient."""
        reach = float(student.ppf(0.5 + CONFIDENCE / 2.0, self.freedom)) * self.deviation
        reach *= float(np.sqrt(self.inverse[which, which]))
        return float(self.coefficients[which]) - reach, float(self.coefficients[which]) + reach


def features(rows: Sequence[dict[str, Any]]) -> NDArray[np.float64]:
    """Return (n_rows, 4) regressors of the law."""
    return np.array(
        [[1.0, np.log(r["channels"]), np.log(r["iterations"]), float(r["steps"])] for r in rows]
    )


def fit_law(rows: Sequence[dict[str, Any]]) -> Law:
    """Fit the law to the errors e of test samples, for networks that are large enough."""
    rows = [row for row in rows if row["channels"] >= LEAST_CHANNELS]
    x, y = features(rows), np.log([row["test"]["mean_dof_m"] for row in rows])
    coefficients: Any = np.linalg.lstsq(x, y, rcond=None)[0]
    inverse: Any = np.linalg.pinv(x.T @ x)
    freedom = len(rows) - int(np.linalg.matrix_rank(x))
    deviation = float(np.sqrt(((y - x @ coefficients) ** 2).sum() / freedom))
    return Law(coefficients, inverse, deviation, freedom)


def trained(data: Dataset, channels: int, steps: int, iterations: int) -> dict[str, Any]:
    """Train one network, and score it."""
    method = mor_bench.load_method(
        "umesh-small", channels=channels, steps=steps, iterations=iterations
    )
    with pinned_threads(1):
        begun = process_time()
        method.fit(data.scene, data.train)
        core_s = process_time() - begun
        return {
            "channels": channels,
            "steps": steps,
            "iterations": iterations,
            "core_s": core_s,
            "validation": scored(method, data.validation),
            "test": scored(method, data.test),
        }


def main(
    dataset: Annotated[str, typer.Option(help="Name or TOML file.")] = "beam-coarse-paper",
    report: Annotated[
        Path,
        typer.Option("--json", metavar="FILE", help="Write errors here, and keep its rows."),
    ] = Path("umesh-scaling.json"),
) -> None:
    """Train U-Meshes of several sizes for several numbers of iterations."""
    data = mor_bench.load_dataset(dataset, split="sample")
    setting = {
        "dataset": dataset,
        "batch_size": 32,
        "n_train": len(data.train),
        "largest_m": float(np.linalg.norm(data.test.displacements, axis=-1).max()),
    }
    rows: list[dict[str, Any]] = []
    if report.exists() and report.stat().st_size:
        rows = json.loads(report.read_text(encoding="utf-8"))["rows"]
    known = {(row["channels"], row["steps"], row["iterations"]) for row in rows}
    wanted = [(c, k, n) for c, k, most in SIZES for n in ITERATIONS if n <= most]
    for size in sorted(set(wanted) - known, key=lambda s: (s[0] * s[2], s)):
        rows.append(trained(data, *size))
        print(f"{size}: {rows[-1]['test']['mean_dof_m']:.3g} m", flush=True)
        write_atomically(report, (json.dumps({**setting, "rows": rows}, indent=1) + "\n").encode())


if __name__ == "__main__":
    typer.run(main)
