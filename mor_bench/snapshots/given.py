"""What a method is given for a query: forces, or displacements of a part of the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene

MAX_FORCE_N = 1e30
"""Largest nodal force component that is accepted, N: its cube must not overflow."""


@dataclass(frozen=True, eq=False)
class Forces:
    """Nodal forces.

    Attributes
    ----------
    values : (n, n_nodes, 3) or (n_nodes, 3) float64
        N.
    """

    values: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.values)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        found = np.asarray(self.values, dtype)
        return found.copy() if copy else found

    def __getitem__(self, index: Any) -> Self:
        return type(self)(self.values[index])

    @property
    def query(self) -> NDArray[np.float64]:
        """What `Surrogate.predict` takes for these: the plain array."""
        return self.values


@dataclass(frozen=True, eq=False)
class ObservedDisplacements:
    """Displacements of the observed nodes of a scene, from which all others are to be found.

    Attributes
    ----------
    values : (n, n_nodes, 3) or (n_nodes, 3) float64
        Displacements, m. Methods ignore the values at other nodes; they may be NaN.
    nodes : (n_observed,) int64
        The observed nodes, `Scene.observed_nodes`.
    """

    values: NDArray[np.float64]
    nodes: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.values)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        found = np.asarray(self.values, dtype)
        return found.copy() if copy else found

    def __getitem__(self, index: Any) -> Self:
        return type(self)(self.values[index], self.nodes)

    @property
    def query(self) -> Self:
        """What `Surrogate.predict` takes for these: the object itself."""
        return self


Given = Forces | ObservedDisplacements


def given_of(scene: Scene, values: NDArray[np.float64]) -> Given:
    """Wrap plain values as what the methods of a scene are given."""
    if scene.observed_nodes is None:
        return Forces(values)
    return ObservedDisplacements(values, scene.observed_nodes)


def checked_given(scene: Scene, given: ArrayLike) -> Given:
    """Check a query and return it with values of shape (n, n_nodes, 3) in float64.

    The values at nodes that are not observed become zero.

    Raises
    ------
    InvalidInputError
        On a wrong shape or dtype, NaN, infinity or a value beyond `MAX_FORCE_N`.
    """
    try:
        array = np.asarray(given)
    except (ValueError, TypeError) as error:
        raise InvalidInputError(f"`forces` must be an array of real numbers: {error}") from None
    n_nodes = scene.mesh.n_nodes
    if array.dtype.kind not in "fiu":
        raise InvalidInputError(f"`forces` must hold real numbers; got dtype {array.dtype}.")
    if array.ndim not in (2, 3) or array.shape[-2:] != (n_nodes, 3):
        raise InvalidInputError(
            f"`forces` must have shape ({n_nodes}, 3) or (n, {n_nodes}, 3); got {array.shape}."
        )
    observed, unit = scene.observed_nodes, "N"
    if observed is not None:
        seen, unit = np.zeros(array.shape, dtype=array.dtype), "m at the observed nodes"
        seen[..., observed, :] = array[..., observed, :]
        array = seen
    if not (np.abs(array) <= MAX_FORCE_N).all():
        raise InvalidInputError(
            f"`forces` must be finite and at most {MAX_FORCE_N:g} {unit}; "
            f"got {np.abs(array).max():g}."
        )
    return given_of(scene, array.astype(np.float64, copy=False).reshape(-1, n_nodes, 3))
