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
        Mean absolute error over all degrees of freedom, those of the supports included, m. It is
        the paper's e, with n the number of degrees of freedom of the mesh.
    mean_free_dof_m : (n_test,) float64
        The same over the free degrees of freedom alone, m. It is larger, because the error at
        supports is zero.
    relative_l2 : (n_test,) float64
        Norm of the error over norm of the reference, over the degrees of freedom of the sample.
    max_nodal_m : (n_test,) float64
        Largest Euclidean error of a node, m.
    amplitude_m : (n_test,) float64
        Largest displacement of a node in the reference, m.
    tip_m : (n_test,) float64
        Euclidean error at the tip, m. The tip is the node that moves most in the reference.
    tip_relative : (n_test,) float64
        `tip_m` over the displacement of that node; the paper's relative l² norm at a probe, which
        it puts at the tip of the beam or of a lobe.
    """

    mean_dof_m: NDArray[np.float64]
    mean_free_dof_m: NDArray[np.float64]
    relative_l2: NDArray[np.float64]
    max_nodal_m: NDArray[np.float64]
    amplitude_m: NDArray[np.float64]
    tip_m: NDArray[np.float64]
    tip_relative: NDArray[np.float64]


ERRORS = tuple(field.name for field in fields(SampleErrors))
"""Names of the errors of a sample."""


def sample_errors(
    predicted: NDArray[np.float64],
    reference: NDArray[np.float64],
    nodes: NDArray[np.int64] | None = None,
    fixed_nodes: NDArray[np.int64] | None = None,
) -> SampleErrors:
    """Compute the errors of predictions.

    Parameters
    ----------
    predicted, reference : (n, n_nodes, 3) float64
        Displacements, m; a prediction with NaN has infinite errors.
    nodes : (n_output_nodes,) int64, optional
        The nodes that count; by default all.
    fixed_nodes : (n_fixed,) int64, optional
        The nodes of the supports; by default none.

    Examples
    --------
    >>> reference = np.ones((1, 2, 3))
    >>> errors = sample_errors(1.1 * reference, reference)
    >>> errors.relative_l2.round(3).tolist(), errors.mean_dof_m.round(3).tolist()
    ([0.1], [0.1])
    """
    free = np.ones(reference.shape[1], dtype=bool)
    free[[] if fixed_nodes is None else fixed_nodes] = False
    if nodes is not None and len(nodes) < reference.shape[1]:
        predicted, reference, free = predicted[:, nodes], reference[:, nodes], free[nodes]
    difference = predicted - reference
    norm = np.linalg.norm(reference, axis=(1, 2))
    relative = np.linalg.norm(difference, axis=(1, 2)) / np.where(norm > 0, norm, 1.0)
    mean = np.abs(difference).mean(axis=(1, 2))
    nodal = np.linalg.norm(difference, axis=2)
    moved = np.linalg.norm(reference, axis=2)
    tip = moved.argmax(axis=1)[:, None]
    tip_m = np.take_along_axis(nodal, tip, axis=1)[:, 0]
    amplitude = np.take_along_axis(moved, tip, axis=1)[:, 0]
    finite = np.isfinite(mean)

    def or_infinite(errors: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(finite, errors, np.inf)

    return SampleErrors(
        mean_dof_m=or_infinite(mean),
        mean_free_dof_m=or_infinite(np.abs(difference[:, free]).mean(axis=(1, 2))),
        relative_l2=or_infinite(relative),
        max_nodal_m=or_infinite(nodal.max(axis=1)),
        amplitude_m=amplitude,
        tip_m=or_infinite(tip_m),
        tip_relative=or_infinite(tip_m / np.where(amplitude > 0, amplitude, 1.0)),
    )


def percentiles(errors: NDArray[np.float64], name: str) -> dict[str, float]:
    """Return the median, the 95th percentile and the maximum of relative errors, by name."""
    return {
        f"{name}_median": float(np.median(errors)),
        f"{name}_p95": float(np.percentile(errors, 95, method="higher")),
        f"{name}_max": float(errors.max()),
    }


def summary(errors: SampleErrors) -> dict[str, float]:
    """Return the error figures of a results row.

    `mean_dof_m` is the paper's ē, and `std_dof_m` its σ(e) with M - 1. `slope` belongs to
    the least-squares line through the origin: e against the sample's largest displacement.
    The paper gives the relative error at the tip for the sample with the largest e and for the
    sample with the largest deformation.

    Examples
    --------
    >>> import mor_bench
    >>> test = mor_bench.load_dataset("beam-tiny").test
    >>> method = mor_bench.load_method("linear-fem").fit(test.scene)
    >>> figures = summary(sample_errors(method.predict(test.forces), test.displacements))
    >>> f"{figures['rel_l2_median']:.1%}"
    '2.6%'
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
        "mean_free_dof_m": float(errors.mean_free_dof_m.mean()),
        **percentiles(relative, "rel_l2"),
        "max_nodal_m": float(errors.max_nodal_m.max()),
        "slope": slope,
        "amplitude_m": float(errors.amplitude_m.max()),
        "tip_max_m": float(errors.tip_m.max()),
        **percentiles(errors.tip_relative, "tip_rel"),
        "tip_rel_at_max_e": float(errors.tip_relative[e.argmax()]),
        "tip_rel_at_largest": float(errors.tip_relative[errors.amplitude_m.argmax()]),
    }
