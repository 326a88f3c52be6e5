"""The input of a query: forces, alone or with parameters, or displacements of some nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from scipy.linalg.blas import ddot

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene
from mor_bench.specs import LIMITS

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

    Examples
    --------
    >>> values = np.full((4, 3), np.nan)
    >>> values[[1, 3]] = 0.001
    >>> observed = ObservedDisplacements(values, np.array([1, 3]))
    >>> observed.query.values[observed.nodes].shape
    (2, 3)
    """

    nodes: NDArray[np.int64]

    @property
    def query(self) -> Self:
        """Argument of `Surrogate.predict`: the object itself."""
        return self


@dataclass(frozen=True, eq=False)
class ParametricForces(_NodalValues):
    """Nodal forces, or displacements of a tool, with the parameters of the body.

    Attributes
    ----------
    values : (n, n_nodes, 3) or (n_nodes, 3) float64
        Forces, N, or displacements at the observed nodes of a scene with a tool, m.
    parameters : (n, n_parameters) or (n_parameters,) float64
        Values of ``Scene.parameter_names``, one row for each load.
    """

    parameters: NDArray[np.float64]

    def __getitem__(self, index: Any) -> Self:
        return replace(self, values=self.values[index], parameters=self.parameters[index])

    @property
    def query(self) -> Self:
        """Argument of `Surrogate.predict`: the object itself."""
        return self


Given = Forces | ParametricForces | ObservedDisplacements


def given_of(
    scene: Scene, values: NDArray[Any], parameters: NDArray[np.float64] | None = None
) -> Given:
    """Wrap plain values, and the parameters of a parametric scene, as the scene's queries."""
    if scene.parameter_names:
        if parameters is None:
            raise InvalidInputError(missing_parameters(scene))
        return ParametricForces(values, parameters)
    if scene.observed_nodes is None:
        return Forces(values)
    return ObservedDisplacements(values, scene.observed_nodes)


def has_values(parameters: ArrayLike | None) -> bool:
    """Return whether parameters of bodies are given: an array without columns holds none."""
    try:
        return parameters is not None and np.shape(parameters)[-1:] != (0,)
    except ValueError:  # rows of different lengths
        return True


def missing_parameters(scene: Scene) -> str:
    """Return the message for a query without the parameters that its scene needs."""
    n, names = len(scene.parameter_names), ", ".join(scene.parameter_names)
    return (
        f"{scene.name}: a query must have `parameters` beside its forces, of shape ({n},) or "
        f"(n, {n}): {names}."
    )


def checked_given(scene: Scene, given: ArrayLike) -> Given:
    """Check a query and return it with values of shape (n, n_nodes, 3) in float64.

    Displacements of nodes that are not observed become zero. For a scene with observed nodes,
    `given` must be `ObservedDisplacements`, for a parametric one `ParametricForces`; otherwise an
    array or `Forces`.

    Raises
    ------
    InvalidInputError
        If forces are given instead of displacements or vice versa; for a wrong shape or dtype, NaN,
        infinity or a value beyond `MAX_FORCE_N`.
    """
    if isinstance(given, ParametricForces) or scene.parameter_names:
        return checked_parametric(scene, given, None)
    if isinstance(given, ObservedDisplacements) and scene.observed_nodes is not None:
        return _checked_displacements(scene.mesh.n_nodes, scene.observed_nodes, given)
    return Forces(checked_forces(scene, given))


def checked_forces(scene: Scene, forces: ArrayLike) -> NDArray[np.float64]:
    """As `checked_given`, for forces alone; returns the plain array, which saves time per query."""
    observed, seen = scene.observed_nodes, isinstance(forces, ObservedDisplacements)
    if seen or observed is not None:
        wanted = "forces" if seen else "displacements of observed nodes, `ObservedDisplacements`"
        raise InvalidInputError(f"{scene.name}: a query must be {wanted}.")
    n_nodes = scene.mesh.n_nodes
    return _in_range(_real_numbers(n_nodes, forces, "`forces`"), "`forces`", "N")


def checked_parametric(
    scene: Scene, forces: ArrayLike, parameters: ArrayLike | None
) -> ParametricForces:
    """Check forces and parameters, and return both with a row for each load.

    Parameters of shape (n_parameters,) belong to all loads. In a scene with a tool, displacements
    replace the forces, as `ObservedDisplacements` or in `ParametricForces`.

    Raises
    ------
    InvalidInputError
        As `checked_forces`; also if the scene has no sampled parameters, or the parameters are
        missing, have another shape, or lie outside the values for which they are defined.
    """
    nodes = scene.observed_nodes
    if isinstance(forces, ParametricForces):
        parameters, forces = forces.parameters, forces.values
        if nodes is not None:
            forces = ObservedDisplacements(forces, nodes)
    names = scene.parameter_names
    if not names:
        raise InvalidInputError(
            f"{scene.name}: `parameters` must be absent, since the scene samples none."
        )
    if parameters is None:
        raise InvalidInputError(missing_parameters(scene))
    if nodes is not None and isinstance(forces, ObservedDisplacements):
        values = _checked_displacements(scene.mesh.n_nodes, nodes, forces).values
    else:
        values = checked_forces(scene, forces)
    try:
        array = np.asarray(parameters)
    except (ValueError, TypeError) as error:
        raise InvalidInputError(f"`parameters` must be an array: {error}") from None
    n, p = len(values), len(names)
    if array.dtype.kind not in "fiu" or array.shape not in ((p,), (n, p)):
        raise InvalidInputError(
            f"`parameters` must hold real numbers of shape ({p},) or ({n}, {p}), "
            f"{', '.join(names)}; got {array.dtype} of shape {array.shape}."
        )
    array = np.broadcast_to(array.astype(np.float64), (n, p))
    for name, column in zip(names, array.T, strict=True):
        low, high = LIMITS[name]
        wrong = ~((column >= low) & (column <= high))  # NaN compares as false
        if wrong.any():
            raise InvalidInputError(
                f"`parameters`: {name} must be in [{low:.9g}, {high:.9g}]; "
                f"got {column[wrong.argmax()]:g}."
            )
    return ParametricForces(values, array)


def _checked_displacements(
    n_nodes: int, observed: NDArray[np.int64], given: ObservedDisplacements
) -> ObservedDisplacements:
    array = _real_numbers(n_nodes, given, "`values`")
    if not np.array_equal(given.nodes, observed):
        raise InvalidInputError(
            "the displacements belong to other nodes than `Scene.observed_nodes`."
        )
    known = np.zeros(array.shape, dtype=array.dtype)
    known[..., observed, :] = array[..., observed, :]
    return ObservedDisplacements(_in_range(known, "`values`", "m at the observed nodes"), observed)


def _real_numbers(n_nodes: int, given: ArrayLike, name: str) -> NDArray[Any]:
    try:
        array = np.asarray(given)
    except (ValueError, TypeError) as error:
        raise InvalidInputError(f"{name} must be an array of real numbers: {error}") from None
    if array.dtype.kind not in "fiu":
        raise InvalidInputError(f"{name} must hold real numbers; got dtype {array.dtype}.")
    if array.ndim not in (2, 3) or array.shape[-2:] != (n_nodes, 3):
        raise InvalidInputError(
            f"{name} must have shape ({n_nodes}, 3) or (n, {n_nodes}, 3); got {array.shape}."
        )
    return array


def _in_range(array: NDArray[Any], name: str, unit: str) -> NDArray[np.float64]:
    if array.dtype != np.float64:
        array = array.astype(np.float64)
    flat = array.ravel()
    # The sum of squares takes a tenth of the time of the largest magnitude, and proves most values.
    # NaN compares as false.
    if flat.size and not ddot(flat, flat) <= MAX_FORCE_N and not np.abs(flat).max() <= MAX_FORCE_N:
        raise InvalidInputError(
            f"{name} must be finite and at most {MAX_FORCE_N:g} {unit}; got {np.abs(flat).max():g}."
        )
    return array[None] if array.ndim == 2 else array
