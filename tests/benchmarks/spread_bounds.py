"""Compare bounds of errors that are equal for all loads with bounds that follow a method's spread.

    python -m tests.benchmarks.spread_bounds --json spread-bounds.json

Both are calibrated on the same validation samples. Test loads act on new regions between those of
the training, on the same regions, or on a part of the surface without training loads, or they are
larger than those of training and calibration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray

import mor_bench
from mor_bench.machine import pinned_threads
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.test_sets import SetName
from tests.benchmarks.projections import ErrorsFile, write_rows

Array = NDArray[np.float64]

SCENES = ("beam-coarse", "liver-hex", "beam-nearly-incompressible")
LIMIT = 1600
"""Largest number of samples of a scene."""
METHODS = (
    "pca-kernel-ridge",
    "pca-gaussian-process",
    "pca-random-forest",
    "pca-extra-trees",
    "pod-nn-ensemble",
)
OUTSIDE: SetName = "unseen-regions"
"""Test set on a part of the surface without training loads."""
SMALL = 0.6
"""Share of the loads, by size, that count as small."""


@dataclass(frozen=True)
class Parts:
    """Samples to learn from, to calibrate on and to test with."""

    kind: str
    train: Snapshots
    validation: Snapshots
    test: Snapshots


def parts_of(scene: str) -> Iterator[Parts]:
    """Yield the four ways to take apart the samples of a scene."""
    by_region = mor_bench.load_dataset(scene, limit=LIMIT, split="region", tests=(OUTSIDE,))
    yield Parts("new regions", by_region.train, by_region.validation, by_region.test)
    outside = by_region.tests[OUTSIDE]
    yield Parts("other part of the surface", by_region.train, by_region.validation, outside)
    mixed = mor_bench.load_dataset(scene, limit=LIMIT, split="sample")
    yield Parts("same regions", mixed.train, mixed.validation, mixed.test)
    limit = float(np.quantile(sizes_of(mixed.train), SMALL))
    (train, _), (validation, _) = (taken_apart(s, limit) for s in (mixed.train, mixed.validation))
    yield Parts("larger loads", train, validation, taken_apart(mixed.test, limit)[1])


def sizes_of(samples: Snapshots) -> Array:
    """Return the norms of the nodal forces, (n,), N."""
    return np.asarray(np.linalg.norm(samples.forces, axis=(1, 2)))


def taken_apart(samples: Snapshots, limit: float) -> tuple[Snapshots, Snapshots]:
    """Return the samples whose loads are at most a limit, N, and those with larger ones."""
    small = sizes_of(samples) <= limit
    return samples[np.flatnonzero(small)], samples[np.flatnonzero(~small)]


def measured(scene: str, parts: Parts, name: str) -> dict[str, Any]:
    """Return coverage and width of both bounds of a method."""
    method: Any = mor_bench.load_method(name).fit(parts.train.scene, parts.train)
    bound = mor_bench.error_bound(method, parts.validation)
    assert bound.per_spread is not None
    apart = method.predict(parts.test.forces) - parts.test.displacements
    errors = np.linalg.norm(apart, axis=(1, 2))
    errors /= np.linalg.norm(parts.test.displacements, axis=(1, 2))
    widths = bound.per_spread * method.spread(parts.test.forces)
    return {
        "dataset": scene,
        "test": parts.kind,
        "method": name,
        "n_train": len(parts.train),
        "n_groups": bound.n_groups,
        "n_test": len(parts.test),
        "error": float(np.median(errors)),
        "constant": bound.relative_l2,
        "constant_coverage": float((errors <= bound.relative_l2).mean()),
        "spread": float(np.median(widths)),
        "spread_p95": float(np.percentile(widths, 95, method="higher")),
        "spread_coverage": float((errors <= widths).mean()),
        "per_spread": bound.per_spread,
    }


def main(report: ErrorsFile = None) -> None:
    """Compare constant bounds of errors with those that follow the spread."""
    rows = []
    with pinned_threads(1):
        for scene in SCENES:
            for parts in parts_of(scene):
                for name in METHODS:
                    rows.append(measured(scene, parts, name))
                    print(rows[-1], flush=True)
    write_rows(report, rows)


if __name__ == "__main__":
    typer.run(main)
