"""The range of the training loads in compact form, and a check for loads outside it.

A load is out of range if it is larger than any training load or spread over more nodes. It is also
out of range at nodes or in directions without training loads, or on a body with a parameter outside
the range of training. Smaller loads are not flagged, and
neither are pushes if training only pulled. There is no range for observed displacements: the loads
behind them are unknown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.patch_loads import PatchLoads

LARGER = 1.01
"""Largest size of a load in range, relative to the largest training load."""

WIDER = 1.25
"""Largest width of a load in range, relative to the widest training load. Three simultaneous
patches are 2 to 3 times as wide as one."""

MOST_STRANGE = 10.0
"""Largest novelty score (`LoadRange.strangeness`) of a load in range. It is 3 if training pulled
equally in all directions."""

REGULARISATION = 0.01
"""ε of the novelty score: a force at a node or in a direction without training loads scores 1/ε."""

MARGIN = 0.01
"""Distance from the range of a sampled parameter at which a query is still in range, relative to
the width of the range."""

CHUNK = 256
"""Number of samples with nodal forces in memory at the same time."""


@dataclass(frozen=True)
class LoadRange:
    """Size, width, nodes and directions of the training loads.

    Attributes
    ----------
    size_n : float
        Largest sum over the nodes of |f_i|, N.
    width : float
        Largest (Σ|f_i|)² / Σ|f_i|²; for equal forces, this is the number of loaded nodes.
    nodes : (n_loaded,) int64
        Nodes with a force in some sample, in ascending order.
    moments : (n_loaded, 3, 3) float64
        M_i = Σ f_i f_iᵀ / Σ |f_i|² over the samples: symmetric, semi-definite, of unit trace.
    parameters : (2, n_parameters) float64
        Lowest and highest value of each sampled parameter.
    """

    size_n: float
    width: float
    nodes: NDArray[np.int64]
    moments: NDArray[np.float64]
    parameters: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 0)))

    @classmethod
    def of(cls, snapshots: Snapshots) -> Self:
        """Return the range of training samples; their nodal forces are computed in chunks."""
        moments = np.zeros((snapshots.scene.mesh.n_nodes, 3, 3))
        size = width = 0.0
        for nodes, forces in _chunks(snapshots):
            moments[nodes] += np.einsum("nai,naj->aij", forces, forces)
            sizes, widths = _sizes_and_widths(forces)
            size, width = max(size, float(sizes.max())), max(width, float(widths.max()))
        traces = np.trace(moments, axis1=1, axis2=2)
        loaded = np.flatnonzero(traces)
        drawn = snapshots.parameters
        ends = np.array([drawn.min(axis=0), drawn.max(axis=0)])
        return cls(size, width, loaded, moments[loaded] / traces[loaded, None, None], ends)

    @classmethod
    def of_single_loads(cls, scene: Scene, largest_n: float) -> Self:
        """Return the range of forces up to a size, N, in all directions on one patch of a scene."""
        weights = scene.patch_weights
        width = float((1.0 / np.asarray(weights.multiply(weights).sum(axis=1))).max())
        nodes = np.unique(weights.indices).astype(np.int64)
        moments = np.broadcast_to(np.eye(3) / 3.0, (len(nodes), 3, 3))
        return cls(largest_n, width, nodes, moments)

    @classmethod
    def from_arrays(
        cls, arrays: dict[str, NDArray[Any]], n_nodes: int, n_parameters: int = 0
    ) -> Self:
        """Return the range from the arrays of `arrays`, for a mesh and a number of parameters.

        Raises
        ------
        InvalidInputError
            If they are not such arrays.
        """
        names = ["limits", "nodes", "moments", *(["parameters"] if n_parameters else [])]
        if set(arrays) != set(names):
            raise InvalidInputError(
                f"the range of the training loads must consist of the arrays {', '.join(names)}; "
                f"got {', '.join(sorted(arrays))}."
            )
        ends = arrays.get("parameters", np.zeros((2, 0)))
        if ends.dtype != np.float64 or ends.shape != (2, n_parameters) or not _are_ends(ends):
            raise InvalidInputError(
                f"`parameters` of the range must be the lowest and the highest values of "
                f"{n_parameters} parameters, in this order."
            )
        limits, nodes, moments = arrays["limits"], arrays["nodes"], arrays["moments"]
        positive = np.isfinite(limits) & (limits >= 0)
        if limits.dtype != np.float64 or limits.shape != (2,) or not positive.all():
            raise InvalidInputError("`limits` of the range must be two finite numbers >= 0.")
        rising = nodes.dtype.kind == "i" and nodes.ndim == 1 and bool((np.diff(nodes) > 0).all())
        if not rising or (len(nodes) > 0 and not 0 <= nodes[0] <= nodes[-1] < n_nodes):
            raise InvalidInputError(
                f"`nodes` of the range must be ascending integers in [0, {n_nodes - 1}]."
            )
        shape = len(nodes), 3, 3
        if moments.dtype != np.float64 or moments.shape != shape or not _are_moments(moments):
            raise InvalidInputError(
                f"`moments` of the range must be {len(nodes)} symmetric 3x3 matrices of unit trace "
                "without negative eigenvalues."
            )
        return cls(float(limits[0]), float(limits[1]), nodes, moments, ends)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the range as arrays, for a file."""
        arrays = {
            "limits": np.array([self.size_n, self.width]),
            "nodes": self.nodes,
            "moments": self.moments,
        }
        return arrays | ({"parameters": self.parameters} if self.parameters.size else {})

    def excludes(
        self, forces: NDArray[np.float64], parameters: NDArray[np.float64] | None = None
    ) -> NDArray[np.bool_]:
        """Return which loads (n, n_nodes, 3), N, are out of range, (n,); zero loads never are.

        With ``parameters`` (n, n_parameters), bodies outside their range are out of range, too.
        """
        size, width = _sizes_and_widths(forces)
        outside = np.asarray(
            (size > LARGER * self.size_n)
            | (width > WIDER * self.width)
            | (self.strangeness(forces) > MOST_STRANGE)
        )
        if parameters is not None:
            low, high = self.parameters
            margin = MARGIN * (high - low)
            other = (parameters < low - margin) | (parameters > high + margin)
            outside |= other.any(axis=1) & (size > 0)
        return outside

    def strangeness(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the novelty score: the mean of d_iᵀ (M_i + ε)⁻¹ d_i over nodes, weighted by |f_i|.

        d_i = f_i / |f_i| is the direction of the force. M_i is zero without training loads.

        Parameters
        ----------
        forces : (n, n_nodes, 3) float64
            Nodal forces, N.

        Returns
        -------
        (n,) float64
            About 3 if training pulled equally in all directions, at most 1/ε; 0 for no force.
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
    """Yield nodes (n_loaded,) and the forces on them (n, n_loaded, 3), N, in chunks."""
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


def _are_ends(ends: NDArray[np.float64]) -> bool:
    return bool(np.isfinite(ends).all() and (ends[0] <= ends[1]).all())


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
