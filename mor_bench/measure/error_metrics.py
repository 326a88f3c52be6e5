"""Errors of predictions against the reference, per sample, and their summary.

A sample on which the method failed has an infinite error. It misses every target and is never
dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SampleErrors:
    """Errors of each test sample.

    Attributes
    ----------
    mean_dof_m : (n_test,) float64
        Mean absolute error over all degrees of freedom, m; the paper's e.
    relative_l2 : (n_test,) float64
        Norm of the error over norm of the reference, over the degrees of freedom of the sample.
    max_nodal_m : (n_test,) float64
        Largest Euclidean error of a node, m.
    amplitude_m : (n_test,) float64
        Largest displacement of a node in the reference, m.
    """

    mean_dof_m: NDArray[np.float64]
    relative_l2: NDArray[np.float64]
    max_nodal_m: NDArray[np.float64]
    amplitude_m: NDArray[np.float64]


ERRORS = tuple(field.name for field in fields(SampleErrors))
"""Names of the errors of a sample."""


def sample_errors(
    predicted: NDArray[np.float64],
    reference: NDArray[np.float64],
    nodes: NDArray[np.int64] | None = None,
) -> SampleErrors:
    """Compute the errors of predictions.

    Parameters
    ----------
    predicted, reference : (n, n_nodes, 3) float64
        Displacements, m; a prediction with NaN has infinite errors.
    nodes : (n_output_nodes,) int64, optional
        The nodes that count; by default all.
    """
    if nodes is not None and len(nodes) < reference.shape[1]:
        predicted, reference = predicted[:, nodes], reference[:, nodes]
    difference = predicted - reference
    norm = np.linalg.norm(reference, axis=(1, 2))
    relative = np.linalg.norm(difference, axis=(1, 2)) / np.where(norm > 0, norm, 1.0)
    mean = np.abs(difference).mean(axis=(1, 2))
    largest = np.linalg.norm(difference, axis=2).max(axis=1)
    finite = np.isfinite(mean)
    return SampleErrors(
        np.where(finite, mean, np.inf),
        np.where(finite, relative, np.inf),
        np.where(finite, largest, np.inf),
        np.linalg.norm(reference, axis=2).max(axis=1),
    )


def summary(errors: SampleErrors) -> dict[str, float]:
    """Return the error figures of a results row.

    `mean_dof_m` is the paper's ē, and `std_dof_m` its σ(e) with M - 1. `slope` belongs to
    the least-squares line through the origin: e against the sample's largest displacement.
    """
    e, relative = errors.mean_dof_m, errors.relative_l2
    with np.errstate(invalid="ignore"):
        spread = (
            float(e.std(ddof=1))
            if len(e) > 1 and np.isfinite(e).all()
            else float("nan" if len(e) < 2 else "inf")
        )
        slope = float(errors.amplitude_m @ e / (errors.amplitude_m @ errors.amplitude_m))
    return {
        "mean_dof_m": float(e.mean()),
        "std_dof_m": spread,
        "max_dof_m": float(e.max()),
        "rel_l2_median": float(np.median(relative)),
        "rel_l2_p95": float(np.percentile(relative, 95, method="higher")),
        "rel_l2_max": float(relative.max()),
        "max_nodal_m": float(errors.max_nodal_m.max()),
        "slope": slope,
    }
