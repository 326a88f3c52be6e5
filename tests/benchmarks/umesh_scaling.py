"""Train U-Meshes of several sizes for several numbers of iterations, for scaling laws.

    python -m tests.benchmarks.umesh_scaling --json umesh-scaling.json

The dataset has the paper's deformation, and the split is the paper's: at random. Every number of
iterations is a training of its own, with its own learning-rate schedule. Rows that the file has
already are not trained again, and a training writes a checkpoint beside the file, so that the same
command continues after an interruption.
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
from scipy.optimize import least_squares
from scipy.stats import t as student

import mor_bench
from mor_bench.machine import pinned_threads
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.store import write_atomically
from mor_bench.training_options import TrainingOptions
from tests.benchmarks.choices import PUBLISHED, scored

ITERATIONS = (780, 1560, 3125, 6250, 12_500)
"""With batches of 32, the last number shows as many samples as the paper's 100,000 batches of 4."""

Size = tuple[int, int, int]
"""Channels, steps, and number of iterations."""

SIZES: tuple[Size, ...] = (
    (4, 2, 12_500),
    (8, 2, 12_500),
    (16, 2, 12_500),
    (32, 2, 6250),
    (8, 3, 3125),
)
"""Sizes with the largest number of iterations."""

BATCH = 32
"""Samples of a batch, in the file of the method."""

HELD_OUT = {"channels": 32}
"""Rows that show how well laws that were fitted without them extrapolate."""

LEAST_CHANNELS = 8
"""Smaller networks do not count for the laws: with 4 channels, they missed the size held out."""

STARTS = (-2.0, -1.0, -0.3)
"""Logarithms of floors over the smallest error, from which least squares start."""

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Law:
    """e = floor + exp(c · (1, log channels, log iterations, steps)), by least squares of log e.

    The floor is 0, a constant, or a power of the channels.

    Attributes
    ----------
    coefficients : (4,), (5,) or (6,) float64
        c and, for a law with a floor, its logarithm (at 1 channel) and its exponent; e in m.
    inverse : (n, n) float64
        Inverse of the normal matrix of the linearised law.
    deviation : float
        Standard deviation of log e about the law.
    n : int
        Number of trainings.
    """

    coefficients: NDArray[np.float64]
    inverse: NDArray[np.float64]
    deviation: float
    n: int

    @property
    def freedom(self) -> int:
        """Degrees of freedom: number of trainings minus number of coefficients."""
        return self.n - len(self.coefficients)

    @property
    def aicc(self) -> float:
        """Akaike's information criterion for few data (Hurvich & Tsai 1989): less is better."""
        k, squares = len(self.coefficients) + 1, self.freedom * self.deviation**2
        return float(self.n * np.log(squares / self.n) + 2 * k + 2 * k * (k + 1) / (self.n - k - 1))

    def predict(self, row: dict[str, Any]) -> tuple[float, float, float]:
        """Return e of a new training in m, and the ends of its prediction interval."""
        x = features([row])
        middle, slope = _log_e(self.coefficients, x)[0], _slopes(self.coefficients, x)[0]
        reach = self._reach * float(np.sqrt(1.0 + slope @ self.inverse @ slope))
        low, mean, high = np.exp([middle - reach, middle, middle + reach])
        return float(mean), float(low), float(high)

    def interval(self, which: int) -> tuple[float, float]:
        """Return the confidence interval of a coefficient."""
        middle = float(self.coefficients[which])
        reach = self._reach * float(np.sqrt(self.inverse[which, which]))
        return middle - reach, middle + reach

    @property
    def _reach(self) -> float:
        return float(student.ppf(0.5 + CONFIDENCE / 2.0, self.freedom)) * self.deviation


def features(rows: Sequence[dict[str, Any]]) -> NDArray[np.float64]:
    """Return (n_rows, 4) regressors of the law."""
    return np.array(
        [[1.0, np.log(r["channels"]), np.log(r["iterations"]), float(r["steps"])] for r in rows]
    )


def _log_floor(c: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    return x[:, : len(c) - 4] @ c[4:]


def _log_e(c: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    power = x @ c[:4]
    return power if len(c) == 4 else np.logaddexp(power, _log_floor(c, x))


def _slopes(c: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives of log e by the coefficients, (n_rows, n_coefficients)."""
    if len(c) == 4:
        return x
    share = np.exp(x @ c[:4] - _log_e(c, x))[:, None]
    return np.hstack([share * x, (1.0 - share) * x[:, : len(c) - 4]])


def fit_law(
    rows: Sequence[dict[str, Any]], n_floor: int, least_channels: int = LEAST_CHANNELS
) -> Law:
    """Fit a law to the errors e of test samples, for networks that are large enough.

    Parameters
    ----------
    rows : sequence of dict
        Trainings.
    n_floor : {0, 1, 2}
        Number of coefficients of the floor: none, a constant, or a power of the channels.
    least_channels : int
        Smaller networks do not count.
    """
    rows = [row for row in rows if row["channels"] >= least_channels]
    x, y = features(rows), np.log([row["test"]["mean_dof_m"] for row in rows])
    found: Any = np.linalg.lstsq(x, y, rcond=None)[0]
    if n_floor:

        def error(c: NDArray[np.float64]) -> NDArray[np.float64]:
            return _log_e(c, x) - y

        def slope(c: NDArray[np.float64]) -> NDArray[np.float64]:
            return _slopes(c, x)

        floors = [np.append(y.min() + below, np.zeros(n_floor - 1)) for below in STARTS]
        fits = [least_squares(error, np.append(found, floor), slope) for floor in floors]
        found = min(fits, key=lambda fit: float(fit.cost)).x
    slopes = _slopes(found, x)
    inverse: Any = np.linalg.pinv(slopes.T @ slopes)
    squares = float(((y - _log_e(found, x)) ** 2).sum())
    return Law(found, inverse, float(np.sqrt(squares / (len(rows) - len(found)))), len(rows))


def trained(data: Dataset, size: Size, checkpoint: Path) -> dict[str, Any]:
    """Train one network from its checkpoint if there is one, and score it.

    The core-seconds are those since the checkpoint.
    """
    channels, steps, iterations = size
    method = mor_bench.load_method(
        "umesh-small", channels=channels, steps=steps, iterations=iterations, **PUBLISHED
    )
    method.training = TrainingOptions(checkpoint=checkpoint)
    with pinned_threads(1):
        begun = process_time()
        method.fit(data.scene, data.train)
        core_s = process_time() - begun
        checkpoint.unlink()
        return {
            "channels": channels,
            "steps": steps,
            "iterations": iterations,
            "core_s": core_s,
            "validation": scored(method, data.validation),
            "test": scored(method, data.test),
        }


def _checkpoint(report: Path, size: Size) -> Path:
    channels, steps, iterations = size
    return report.with_suffix(f".{channels}-{steps}-{iterations}.checkpoint")


def main(
    dataset: Annotated[str, typer.Option(help="Name or TOML file.")] = "beam-coarse-paper",
    report: Annotated[
        Path,
        typer.Option("--json", metavar="FILE", help="Write errors here, and keep its rows."),
    ] = Path("umesh-scaling.json"),
    only: Annotated[
        tuple[int, int, int] | None,
        typer.Option(help="Train one size: channels, steps, iterations."),
    ] = None,
) -> None:
    """Train U-Meshes of several sizes for several numbers of iterations."""
    data = mor_bench.load_dataset(dataset, split="sample")
    setting = {
        "dataset": dataset,
        "batch_size": BATCH,
        "n_train": len(data.train),
        "largest_m": float(np.linalg.norm(data.test.displacements, axis=-1).max()),
    }
    rows: list[dict[str, Any]] = []
    if report.exists() and report.stat().st_size:
        rows = json.loads(report.read_text(encoding="utf-8"))["rows"]
    known = {(row["channels"], row["steps"], row["iterations"]) for row in rows}
    wanted = [(c, k, n) for c, k, most in SIZES for n in ITERATIONS if n <= most]
    wanted = wanted if only is None else [only]
    for size in sorted(set(wanted) - known, key=lambda s: (s[0] * s[2], s)):
        rows.append(trained(data, size, _checkpoint(report, size)))
        print(f"{size}: {rows[-1]['test']['mean_dof_m']:.3g} m", flush=True)
        write_atomically(report, (json.dumps({**setting, "rows": rows}, indent=1) + "\n").encode())


if __name__ == "__main__":
    typer.run(main)
