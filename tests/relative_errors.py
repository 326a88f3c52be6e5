"""Relative errors, as a run scores them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.measure.error_metrics import sample_errors
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

Array = NDArray[np.float64]


def relative_l2(found: Array, expected: Array) -> Array:
    """Return the relative l2 error of each sample, of displacements (n, n_nodes, 3)."""
    return sample_errors(found, expected).relative_l2


def median_error(method: Surrogate, samples: Snapshots) -> float:
    """Return the median relative l2 error of a fitted method's predictions."""
    return float(np.median(relative_l2(method.predict(samples.forces), samples.displacements)))
