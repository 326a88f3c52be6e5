"""The input of a query: forces, or displacements of a part of the surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene

MAX_FORCE_N = 1e30
"""Largest accepted component of a force, N, or displacement, m; its cube does not overflow."""


@dataclass(frozen=True, eq=False)
class _NodalValues:
    """Vectors at nodes, `values` (n, n_nodes, 3) or (n_nodes, 3) float64."""

    values: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.values)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        found = np.asarray(self.values, dtype)
        return found.copy() if copy else found

    def __getitem__(self, index: Any) -> Self:
        return self.with_values(self.values[index])

    def with_values(self, values: NDArray[np.float64]) -> Self:
        """Return other values of the same kind, at the same nodes."""
        return replace(self, values=values)


class Forces(_NodalValues):
    """Nodal forces `values` (n, n_nodes, 3) or (n_nodes, 3) float64, N."""

    @property
    def query(self) -> NDArray[np.float64]:
        """Argument of `Surrogate.predict`: the plain array."""
        return self.values


@dataclass(frozen=True, eq=False)
class ObservedDisplacements(_NodalValues):
    """Displacements of the observed nodes of a scene; methods predict all others.

    Attributes
    ----------
    values : (n, n_nodes, 3) or (n_nodes, 3) float64
        Displacements, m. Methods ignore the values at other nodes; they may be NaN.
    nodes : (n_observed,) int64
        The observed nodes, `Scene.observed_nodes`.
    """

    nodes: NDArray[np.int64]

    @property
    def query(self) -> Self:
        """Argument of `Surrogate.predict`: the object itself."""
        return self


Given = Forces | ObservedDisplacements


def given_of(scene: Scene, values: NDArray[Any]) -> Given:
    """Wrap plain values in the class of the scene's queries."""
    if scene.observed_nodes is None:
        return Forces(values)
    return ObservedDisplacements(values, scene.observed_nodes)


def checked_given(scene: Scene, given: ArrayLike) -> Given:
    """Check a query and return it with values of shape (n, n_nodes, 3) in float64.

    Displacements of nodes that are not observed become zero. For a scene with observed nodes,
    `given` must be `ObservedDisplacements`; otherwise an array or `Forces`.

    Raises
    ------
    InvalidInputError
        If forces are given instead of displacements or vice versa; for a wrong shape or dtype, NaN,
        infinity or a value beyond `MAX_FORCE_N`.
    """
    observed, seen = scene.observed_nodes, isinstance(given, ObservedDisplacements)
    if seen != (observed is not None):
        wanted = "forces" if seen else "displacements of observed nodes, `ObservedDisplacements`"
        raise InvalidInputError(f"{scene.name}: a query must be {wanted}.")
    name, unit = ("`values`", "m at the observed nodes") if seen else ("`forces`", "N")
    try:
        array = np.asarray(given)
    except (ValueError, TypeError) as error:
        raise InvalidInputError(f"{name} must be an array of real numbers: {error}") from None
    n_nodes = scene.mesh.n_nodes
    if array.dtype.kind not in "fiu":
        raise InvalidInputError(f"{name} must hold real numbers; got dtype {array.dtype}.")
    if array.ndim not in (2, 3) or array.shape[-2:] != (n_nodes, 3):
        raise InvalidInputError(
            f"{name} must have shape ({n_nodes}, 3) or (n, {n_nodes}, 3); got {array.shape}."
        )
    if isinstance(given, ObservedDisplacements) and observed is not None:
        if not np.array_equal(given.nodes, observed):
            raise InvalidInputError(
                f"{scene.name}: the displacements belong to other nodes than "
                "`Scene.observed_nodes`."
            )
        known = np.zeros(array.shape, dtype=array.dtype)
        known[..., observed, :] = array[..., observed, :]
        array = known
    if not (np.abs(array) <= MAX_FORCE_N).all():
        raise InvalidInputError(
            f"{name} must be finite and at most {MAX_FORCE_N:g} {unit}; "
            f"got {np.abs(array).max():g}."
        )
    return given_of(scene, array.astype(np.float64, copy=False).reshape(-1, n_nodes, 3))
