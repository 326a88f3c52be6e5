"""Measure the choices that the U-Mesh paper leaves open, and the changes of `umesh-linear`.

    python -m tests.benchmarks.umesh_choices --json umesh-choices.json

Every variant is a training of the same length with one parameter changed. It is scored on the
validation samples, which make the choice, and on the test samples. So the file shows which choice
the test samples would have made, and how much better it would have looked.
"""

from __future__ import annotations

import json
from pathlib import Path
from time import process_time
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track

import mor_bench
from mor_bench.machine import pinned_threads
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.snapshots.dataset import Dataset, Snapshots

Parameters = dict[str, Any]

OPEN: dict[str, list[Parameters]] = {
    "learning_rate": [{"learning_rate": rate} for rate in (2.5e-3, 1.5e-3, 5e-3)],
    "second_moment_decay": [{"second_moment_decay": decay} for decay in (0.95, 0.99, 0.999)],
    "normalisation": [{"normalisation": kind} for kind in ("rms", "max", "none")],
}
"""Choices that the paper leaves open, for `umesh-small`; the first value is the method file's."""

CHANGES: list[tuple[str, Parameters]] = [
    ("force in, displacement out", {}),
    ("+ linear response in, remainder out", {"input": "linear-response"}),
    ("+ zero at rest", {"zero_at_rest": True}),
    ("+ SiLU", {"activation": "silu"}),
    ("+ errors relative to the remainder", {"loss": "relative"}),
    ("+ mirror images", {"mirrored": True}),
]
"""The changes from `umesh-small` to `umesh-linear`; each adds to those before it."""


def scored(method: mor_bench.Surrogate, samples: Snapshots) -> dict[str, float]:
    """Return mean error and median, 95th percentile and maximum of the relative l2 error."""
    predicted: NDArray[np.float64] = np.concatenate(
        [method.predict(samples[i : i + 128].forces) for i in range(0, len(samples), 128)]
    )
    found = summary(sample_errors(predicted, samples.displacements))
    return {
        name: float(found[name])
        for name in ("mean_dof_m", "rel_l2_median", "rel_l2_p95", "rel_l2_max")
    }


def trained(data: Dataset, parameters: Parameters, seed: int) -> dict[str, Any]:
    """Train one variant, and score it on the validation and the test samples."""
    method = mor_bench.load_method("umesh-small", **parameters, seed=seed)
    begun = process_time()
    with pinned_threads(1):
        method.fit(data.scene, data.train)
    return {
        "seed": seed,
        "core_s": process_time() - begun,
        "validation": scored(method, data.validation),
        "test": scored(method, data.test),
    }


def main(
    dataset: Annotated[str, typer.Option(help="Name or TOML file.")] = "beam-coarse",
    channels: Annotated[int, typer.Option(min=1, help="Channels of the first level.")] = 8,
    iterations: Annotated[int, typer.Option(min=1, help="Iterations of every training.")] = 1000,
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of every variant.")] = 1,
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the errors here.")
    ] = None,
) -> None:
    """Measure the choices that the U-Mesh paper leaves open, and the changes of umesh-linear."""
    data = mor_bench.load_dataset(dataset)
    base = {"channels": channels, "iterations": iterations}
    variants = [
        ("open", name, str(changed[name]), {**base, **changed})
        for name, values in OPEN.items()
        for changed in values
    ]
    so_far = dict(base)
    for name, changed in CHANGES:
        so_far |= changed
        variants.append(("changes", name, "", dict(so_far)))
    known: dict[str, list[dict[str, Any]]] = {}
    rows = []
    for group, choice, value, parameters in track(variants, description=dataset):
        method = mor_bench.load_method("umesh-small", **parameters)
        key = repr(method)  # variants with equal parameters are trained once
        known[key] = known.get(key) or [trained(data, parameters, seed) for seed in range(seeds)]
        rows.append({"group": group, "choice": choice, "value": value, "trainings": known[key]})
        shown = np.median([t["validation"]["mean_dof_m"] for t in known[key]])
        print(f"{choice} {value}: {shown:.3g} m on validation samples", flush=True)
    content = {
        "dataset": dataset,
        **base,
        "n_train": len(data.train),
        "n_validation": len(data.validation),
        "n_test": len(data.test),
        "rows": rows,
    }
    if report is not None:
        report.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
