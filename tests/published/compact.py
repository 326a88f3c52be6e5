"""A run in compact form: results, conclusions, and the errors of every test sample.

FOLDER/results.json       as the run wrote it
FOLDER/comparison.json    the same; wordings of sentences follow the code, numbers never change
FOLDER/errors.h5                               per-sample errors in single precision

Latencies of single queries, predictions and loss curves are left out.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from math import inf
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.draws import Draws, Interval
from mor_bench.analysis.selection import decide
from mor_bench.analysis.verdict import RULE, needs_of
from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import write_atomically
from tests.published.stored import content_of

ERRORS = "errors.h5"

LEFT_OUT = (
    "latency_ms",
    "all_threads_ms",
    "gc_ms",
    "process",
    "round",
    "used",
    "loss_curve",
    "validation_curve",
    "worst_prediction",
    "worst_reference",
    "worst_forces",
    "typical_prediction",
    "typical_reference",
    "typical_forces",
)
"""Arrays of a configuration that the compact form does not keep."""

PACKED_BYTES = 8192
"""Larger arrays are compressed; for smaller ones the description of the compression is larger."""

KEPT_OF_DATASETS = ("test_regions", "validation_regions", "singular_values", "snapshots_norm")


def compact(run: Path, folder: Path, shown: str) -> None:
    """Write a finished run in compact form; where its texts name its folder, they say `shown`."""
    comparison = Comparison.read(run)
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("results.json", "comparison.json"):
        content = json.loads((run / name).read_text(encoding="utf-8"))
        text = json.dumps(content, indent=None, separators=(",", ":"), allow_nan=False)
        text = text.replace(json.dumps(str(run))[1:-1], shown)
        write_atomically(folder / name, (text + "\n").encode())
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver="latest") as file:
        for name in comparison.datasets:
            kept = comparison.dataset_arrays(name)
            _write(file.create_group(name), {k: kept[k] for k in KEPT_OF_DATASETS if k in kept})
        for row in comparison.rows:
            if row.ok:
                kept = comparison.samples(row)
                _write(
                    file.require_group(row.dataset).create_group(row.label),
                    {k: v for k, v in kept.items() if k not in LEFT_OUT},
                )
    write_atomically(folder / ERRORS, buffer.getvalue())


def _write(group: h5py.Group, arrays: Mapping[str, NDArray[Any]]) -> None:
    for name, array in arrays.items():
        stored = array.astype(np.float32) if array.dtype == np.float64 else array
        packed = {"compression": "gzip", "shuffle": True} if stored.nbytes > PACKED_BYTES else {}
        group.create_dataset(name, data=stored, track_times=False, **packed)


def wrong_verdicts(folder: Path) -> Iterator[str]:
    """Reach the verdicts again from the stored rows and intervals; yield each difference.

    Resampled latencies are not stored, so what cannot be told apart is not compared.
    """
    comparison = Comparison.read(folder)
    analysis = content_of("comparison.json", folder)
    for stored in analysis["verdicts"]:
        name = stored["dataset"]
        intervals: dict[str, dict[str, Interval]] = {}
        for record in analysis["rows"]:
            if record["dataset"] == name:
                found = {k: v for k, v in record.items() if isinstance(v, dict)}
                intervals[record["label"]] = {
                    k: (v["low"], inf if v["high"] is None else v["high"]) for k, v in found.items()
                }
                for figure, v in found.items():
                    low, high = intervals[record["label"]][figure]
                    if not low <= (inf if v["value"] is None else v["value"]) <= high:
                        yield f"{record['label']}: {figure} lies outside its interval"
        none = np.zeros((0, 1))
        again = decide(
            comparison, name, needs_of(comparison, name), Draws([], none, none, intervals)
        )
        qualified = [row.label for row in again.qualified]
        if qualified != stored["qualified"]:
            yield f"{name}: {qualified} qualify, stated are {stored['qualified']}"
        if again.headline != stored["headline"]:
            yield f"{name}: {again.headline!r} is stated as {stored['headline']!r}"
        if RULE not in stored["beside"]:
            yield f"{name}: the rule is not stated as {RULE!r}"


def wrong_summaries(folder: Path) -> Iterator[str]:
    """Compare the errors in results.json with those of the samples; yield each difference."""
    comparison = Comparison.read(folder)
    with h5py.File(folder / ERRORS, "r") as file:
        for row in comparison.rows:
            if not row.ok or row.error is None:
                continue
            samples = file[row.dataset][row.label]
            relative = np.asarray(samples["relative_l2"][()], dtype=float)
            computed = {
                "rel_l2_median": float(np.median(relative)),
                "rel_l2_p95": float(np.percentile(relative, 95, method="higher")),
                "rel_l2_max": float(np.max(relative)),
                "mean_dof_m": float(np.mean(samples["mean_dof_m"][()], dtype=float)),
            }
            if len(relative) != row.n_test:
                yield f"{row.label}: {len(relative)} samples of {row.n_test}"
            for name, value in computed.items():
                said = float(getattr(row.error, name))
                if not np.isclose(value, said, rtol=1e-5, atol=1e-12, equal_nan=True):
                    yield f"{row.dataset}, {row.label}: {name} is {value:g}, stated as {said:g}"
