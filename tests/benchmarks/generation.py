"""Rate, seconds and memory of generation against the number of samples.

    python -m tests.benchmarks.generation
    python -m tests.benchmarks.generation --samples 100 --samples 1000 --samples 33600

A new process generates each size with single-threaded workers. Seconds include building the scene
and starting the workers. The parent solves the first shard alone; "long run/s" is the rate after
that shard. Peak memory is the largest resident set of the parent or of any worker.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from .memory import peak_mb

SIZES = (100, 300, 1000)


def measure(dataset: str, samples: int, workers: int) -> dict[str, Any]:
    """Return seconds and peak memory of one generation, in this process and its workers."""
    from mor_bench.snapshots.generate import SHARD_SIZE, dataset_folder, generate
    from mor_bench.specs import load_generated_spec

    spec = load_generated_spec(dataset)
    times: list[tuple[int, float]] = []
    with TemporaryDirectory() as cache:
        begun = perf_counter()
        generate(
            spec,
            samples,
            workers,
            Path(cache),
            lambda done, _: times.append((done, perf_counter() - begun)),
        )
        seconds = perf_counter() - begun
        folder = dataset_folder(spec, Path(cache))
        megabytes = sum(path.stat().st_size for path in folder.iterdir()) / 2**20
    first = next((t for n, t in times if n >= SHARD_SIZE), seconds)
    done = times[-1][0]
    return {
        "samples": done,
        "seconds": seconds,
        "rate": done / seconds,
        "rate_beyond": (done - SHARD_SIZE) / (times[-1][1] - first) if done > SHARD_SIZE else None,
        "disk_mb": megabytes,
        "parent_mb": peak_mb(),
        "worker_mb": peak_mb(of_children=True) if done > SHARD_SIZE else None,
    }


def main(
    samples: Annotated[
        list[int] | None,
        typer.Option(min=1, help=f"Repeat for more. By default {SIZES}.", show_default=False),
    ] = None,
    dataset: Annotated[str, typer.Option(help="Name or TOML file.")] = "beam-fine",
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures here.")
    ] = None,
    one: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Measure rate, cost per sample and memory of generating the first samples of a dataset."""
    if one:
        print(json.dumps(measure(dataset, (samples or SIZES)[0], workers)))
        return
    pinned = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
    }
    table = Table(
        "samples",
        "seconds",
        "samples/s",
        "long run/s",
        "ms/sample",
        "disk MB",
        "parent MB",
        "worker MB",
    )
    rows = []
    for size in samples or SIZES:
        options = ["--one", "--samples", str(size), "--dataset", dataset, "--workers", str(workers)]
        command = [sys.executable, "-m", "tests.benchmarks.generation", *options]
        row = json.loads(
            subprocess.run(
                command, check=True, stdout=subprocess.PIPE, text=True, env=pinned
            ).stdout
        )
        rows.append(row)
        table.add_row(
            f"{row['samples']:,}",
            f"{row['seconds']:.1f}",
            f"{row['rate']:.1f}",
            _number(row["rate_beyond"], ".1f"),
            f"{1e3 / row['rate']:.1f}",
            f"{row['disk_mb']:.0f}",
            f"{row['parent_mb']:.0f}",
            _number(row["worker_mb"], ".0f"),
        )
    console = Console(width=100)
    console.print(f"{dataset}, {workers} workers of one thread", highlight=False)
    console.print(table)
    if report is not None:
        found = {"dataset": dataset, "workers": workers, "sizes": rows}
        report.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


if __name__ == "__main__":
    typer.run(main)
