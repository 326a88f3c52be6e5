"""A scene as a model of pyMOR, and its displacements as vector arrays."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import InvalidInputError, MissingDependencyError, UnsupportedSceneError
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import MAX_LOAD_N, NewtonOptions
from mor_bench.scene.scene import Scene
from mor_bench.surrogate import NO_PARAMETERS


def pymor_model(scene: Scene, loads: ArrayLike | None = None, *, tolerance: float = 1e-8) -> Any:
    """Return a scene as pyMOR's ``StationaryModel`` f(u) = F(μ) on its free dofs.

    ``model.solve(mu)`` is the full-order solution. ``model.operator`` has `apply` and `jacobian`,
    so pyMOR's own algorithms work on it. The inner product ``model.stiffness_product`` is the
    stiffness at rest. pyMOR's ``InversionError`` means that a load has no stable equilibrium.

    Parameters
    ----------
    scene : Scene
    loads : (k, n_nodes, 3) array, optional
        Nodal forces, N. The parameter ``load`` holds k factors: F(μ) = Σᵢ μᵢ loadsᵢ. Without it,
        the parameter ``load`` holds the forces on all free dofs, N.
    tolerance : float
        Norm of the final residual relative to that of the load, in (0, 1].

    Raises
    ------
    MissingDependencyError
        If pyMOR is not installed.
    UnsupportedSceneError
        If the scene has no known equations, sampled parameters, or no given forces.
    InvalidInputError
        If the loads have another shape or are not finite, or the tolerance is out of range.

    Examples
    --------
    >>> import mor_bench
    >>> scene = mor_bench.load_scene("beam-tiny")
    >>> model = pymor_model(scene, patch_loads(scene))
    >>> model.solve({"load": [0.0] * len(patch_loads(scene))}).norm()
    array([0.])
    """
    if reason := unsupported(scene):
        raise UnsupportedSceneError(f"{scene.name} cannot be a model of pyMOR: {reason}.")
    options, forces = NewtonOptions(tolerance), None
    if loads is not None:
        forces = scene.at_free_dofs(_nodal(scene, loads, "loads"))
        if len(forces) == 0:
            raise InvalidInputError("`loads` must hold at least one field of forces; got none.")
    return _operators().stationary_model(FullOrderModel(scene), forces, options)


def _operators() -> ModuleType:
    """Import the module that needs pyMOR; `MissingDependencyError` if that is not installed."""
    try:
        return import_module("mor_bench.adapters.pymor_operators")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "pymor":
            raise
        raise MissingDependencyError(
            "a model of pyMOR needs pymor: pip install 'mor-bench[pymor]'"
        ) from error


def unsupported(scene: Scene) -> str | None:
    """Return why a scene cannot be a model of pyMOR; None if it can."""
    return NO_PARAMETERS if scene.parameter_names else unknown_equations(scene)


def patch_loads(scene: Scene) -> NDArray[np.float64]:
    """Return 1 N along x, y and z on each load patch, (3 n_patches, n_nodes, 3), for `pymor_model`.

    The factors of patch p are the components 3p, 3p + 1 and 3p + 2 of the parameter.

    Examples
    --------
    >>> import mor_bench
    >>> scene = mor_bench.load_scene("beam-tiny")
    >>> len(patch_loads(scene)) == 3 * len(scene.patch_nodes)
    True
    """
    weights = scene.patch_weights.toarray()
    fields = weights[:, None, :, None] * np.eye(3)[None, :, None, :]
    return np.ascontiguousarray(fields.reshape(-1, scene.mesh.n_nodes, 3))


def to_vector_array(scene: Scene, fields: ArrayLike) -> Any:
    """Return displacements or forces (n, n_nodes, 3) as a vector array of the scene's model.

    Raises
    ------
    MissingDependencyError
        If pyMOR is not installed.
    InvalidInputError
        If the fields have another shape or are not finite.

    Examples
    --------
    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> vectors = to_vector_array(data.scene, data.test.displacements)
    >>> len(vectors), vectors.dim
    (40, 162)
    """
    values = np.ascontiguousarray(scene.at_free_dofs(_nodal(scene, fields, "fields")))
    return _operators().NumpyVectorSpace(values.shape[1]).from_numpy(values.T)


def from_vector_array(scene: Scene, vectors: Any) -> NDArray[np.float64]:
    """Return a vector array of the scene's model as fields (n, n_nodes, 3), zero at supports.

    Raises
    ------
    InvalidInputError
        If `vectors` is no vector array, or has another number of components.

    Examples
    --------
    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> vectors = to_vector_array(data.scene, data.test.displacements)
    >>> from_vector_array(data.scene, vectors).shape
    (40, 63, 3)
    """
    if not hasattr(vectors, "to_numpy"):
        raise InvalidInputError(
            f"`vectors` must be a vector array of pyMOR; got {type(vectors).__name__}."
        )
    values = np.ascontiguousarray(vectors.to_numpy().T)
    if values.shape[1] != len(scene.free_dofs):
        raise InvalidInputError(
            f"`vectors` must have {len(scene.free_dofs)} components, the free dofs of "
            f"{scene.name}; got {values.shape[1]}."
        )
    return scene.at_all_dofs(values).reshape(len(values), -1, 3)


def _nodal(scene: Scene, fields: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return checked fields as rows (n, n_dofs)."""
    values, n_nodes = np.asarray(fields), scene.mesh.n_nodes
    if values.dtype.kind not in "fiu" or values.ndim != 3 or values.shape[1:] != (n_nodes, 3):
        raise InvalidInputError(
            f"`{name}` must be real numbers of shape (n, {n_nodes}, 3); "
            f"got {values.dtype} of shape {values.shape}."
        )
    if not (np.abs(values) <= MAX_LOAD_N).all():
        raise InvalidInputError(f"`{name}` must be finite and at most {MAX_LOAD_N:g}.")
    return values.astype(np.float64).reshape(len(values), scene.mesh.n_dofs)
