"""The range of the training loads in compact form, and which loads lie out of it.

A load is out of range if it is larger than any of training, spread over more nodes, or acts where, or in directions in
which, training loads did not. Measured with the named test sets (`mor_bench.snapshots.test_sets`), share of loads flagged,
training split by region; beam-coarse with the first 1,280 samples, liver-hex 600, block-compression 500:

================= ========= =========== ========= =================
set               beam-tiny beam-coarse liver-hex block-compression
================= ========= =========== ========= =================
test              0         0           0         0
in-range          0         0           0         0
2x                .500      .470        .437      .362
4x                .783      .725        .692      .632
unseen-regions    1         1           1         1
unseen-directions                       .950      1
several-forces    1         .995        .995      .976
================= ========= =========== ========= =================

Of `2x` and `4x` exactly the loads larger than training's are flagged; the others are loads of the training distribution.
The strangeness of loads in range reaches 5.9, 8.7, 7.1 and 1.0, that of unseen regions is 94 to 100 everywhere, and that of
unseen directions on the liver has the 5th percentile 10 and the median 44; `MOST_STRANGE` lies between. Smaller loads than
training's, and pushing where training only pulled, are not seen.

Where displacements of a part of the surface are given in the place of forces there is no range. Their strangeness flags loads of
training itself, and their coordinates in 10 principal directions of training's (on beam-tiny, its loaded face observed), larger than
any of training, are those of 57 % of `4x`, 10 % of `several-forces` and 2 % of `unseen-regions`: the body hides what moved it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.sampling import PatchLoads

LARGER = 1.01
"""A load may be this many times as large as the largest of training."""

WIDER = 1.25
"""A load may act on this many times as many nodes as the widest of training; three patches at once act on 2 to 3 times as many as one."""

MOST_STRANGE = 10.0
"""Strangeness from which on a load is out of range; 3 where training pulled in all directions alike."""

REGULARISATION = 0.01
"""ε of the strangeness; a force at a node or in a direction that no training load had scores 1/ε."""

CHUNK = 256
"""Samples whose nodal forces are in memory at once."""


@dataclass(frozen=True)
class LoadRange:
    """What the training loads were.

    Attributes
    ----------
    size_n : float
        Largest sum over the nodes of |f_i|, N.
    width : float
        Largest (Σ|f_i|)² / Σ|f_i|²: the number of nodes that equal forces act on.
    nodes : (n_loaded,) int64
        Nodes at which some sample has a force, rising.
    moments : (n_loaded, 3, 3) float64
        M_i = Σ f_i f_iᵀ / Σ |f_i|² over the samples: symmetric, not negative, of unit trace.
    """

    size_n: float
    width: float
    nodes: NDArray[np.int64]
    moments: NDArray[np.float64]

    @classmethod
    def of(cls, snapshots: Snapshots) -> Self:
        """The range of training samples, whose nodal forces are gone through in chunks."""
        moments = np.zeros((snapshots.scene.mesh.n_nodes, 3, 3))
        size = width = 0.0
        for nodes, forces in _chunks(snapshots):
            moments[nodes] += np.einsum("nai,naj->aij", forces, forces)
            sizes, widths = _sizes_and_widths(forces)
            size, width = max(size, float(sizes.max())), max(width, float(widths.max()))
        traces = np.trace(moments, axis1=1, axis2=2)
        loaded = np.flatnonzero(traces)
        return cls(size, width, loaded, moments[loaded] / traces[loaded, None, None])

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]], n_nodes: int) -> Self:
        """The range that `arrays` made the arrays of, for a mesh of ``n_nodes`` nodes.

        Raises
        ------
        InvalidInputError
            If they are not such arrays.
        """
        if set(arrays) != {"limits", "nodes", "moments"}:
            raise InvalidInputError(
                f"the range of the training loads must be the arrays limits, nodes and moments; got {', '.join(sorted(arrays))}."
            )
        limits, nodes, moments = arrays["limits"], arrays["nodes"], arrays["moments"]
        if (
            limits.dtype != np.float64
            or limits.shape != (2,)
            or not (np.isfinite(limits) & (limits >= 0)).all()
        ):
            raise InvalidInputError("`limits` of the range must be two finite numbers >= 0.")
        rising = nodes.dtype.kind == "i" and nodes.ndim == 1 and bool((np.diff(nodes) > 0).all())
        if not rising or (len(nodes) > 0 and not 0 <= nodes[0] <= nodes[-1] < n_nodes):
            raise InvalidInputError(
                f"`nodes` of the range must be rising integers in [0, {n_nodes - 1}]."
            )
        if (
            moments.dtype != np.float64
            or moments.shape != (len(nodes), 3, 3)
            or not _are_moments(moments)
        ):
            raise InvalidInputError(
                f"`moments` of the range must be {len(nodes)} symmetric 3x3 matrices of unit trace, none negative."
            )
        return cls(float(limits[0]), float(limits[1]), nodes, moments)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The range as arrays, to be stored."""
        return {
            "limits": np.array([self.size_n, self.width]),
            "nodes": self.nodes,
            "moments": self.moments,
        }

    def excludes(self, forces: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(n,) which of the loads (n, n_nodes, 3), N, are out of range; no force never is."""
        size, width = _sizes_and_widths(forces)
        return np.asarray(
            (size > LARGER * self.size_n)
            | (width > WIDER * self.width)
            | (self.strangeness(forces) > MOST_STRANGE)
        )

    def strangeness(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean over the nodes, weighted by |f_i|, of d_iᵀ (M_i + ε)⁻¹ d_i, with the direction d_i = f_i / |f_i|.

        M_i is zero where no training load had a force.

        Parameters
        ----------
        forces : (n, n_nodes, 3) float64
            N.

        Returns
        -------
        (n,) float64
            About 3 where training pulled in all directions alike, at most 1/ε; 0 for no force.
        """
        lengths = np.linalg.norm(forces, axis=2)
        known, known_lengths = forces[:, self.nodes], lengths[:, self.nodes]
        scores = np.einsum("nai,aij,naj->na", known, self._inverses, known) / np.where(
            known_lengths > 0, known_lengths, 1.0
        )
        total = lengths.sum(axis=1)
        elsewhere = total - known_lengths.sum(axis=1)
        return np.asarray(
            (scores.sum(axis=1) + elsewhere / REGULARISATION) / np.where(total > 0, total, 1.0)
        )

    @cached_property
    def _inverses(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.inv(self.moments + REGULARISATION * np.eye(3)))


def _chunks(snapshots: Snapshots) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Nodes (n_loaded,), and the forces on them (n, n_loaded, 3), N, of some samples after the other."""
    loads = snapshots.loads
    for start in range(0, len(loads), CHUNK):
        some = loads[start : start + CHUNK]
        if isinstance(some, PatchLoads):
            weights = snapshots.scene.patch_weights
            nodes = np.unique(weights.indices).astype(np.int64)
            yield nodes, some.nodal_forces(weights[:, nodes])
        else:
            yield np.arange(some.forces.shape[1]), some.forces


def _sizes_and_widths(
    forces: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lengths = np.linalg.norm(forces, axis=2)
    size, squares = lengths.sum(axis=1), (lengths**2).sum(axis=1)
    return size, size**2 / np.where(squares > 0, squares, 1.0)


def _are_moments(matrices: NDArray[np.float64]) -> bool:
    if not np.isfinite(matrices).all():
        return False
    symmetric = np.abs(matrices - matrices.transpose(0, 2, 1)) <= 1e-9
    traces = np.trace(matrices, axis1=1, axis2=2)
    return bool(
        symmetric.all()
        and (np.abs(traces - 1) <= 1e-9).all()
        and (np.linalg.eigvalsh(matrices) >= -1e-9).all()
    )
