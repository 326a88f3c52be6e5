"""A method as an estimator of scikit-learn, from flat nodal forces to flat displacements."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.metrics import r2_score
from sklearn.utils.validation import check_is_fitted, validate_data

from mor_bench.errors import InvalidInputError, SpecError, UnsupportedSceneError
from mor_bench.method_loading import load_method
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.specs import load_method_spec
from mor_bench.specs.one_line_errors import nearest_name
from mor_bench.specs.parameters import annotated_defaults

HELD = 1e-9
"""Largest displacement of a support, relative to the largest one; forces may be rounded."""


class SurrogateRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A method of mor-bench as a regressor of scikit-learn.

    One row of X holds the forces at all nodes, N, in the order x, y, z of the first node, then of
    the second. One row of y holds the displacements, m, in the same order. So `X` is
    ``samples.forces.reshape(len(samples), -1)``, and `y` the same of ``samples.displacements``.

    Forces must reach the method as they are. A step before it that scales or centres them changes
    the load, and a method that solves equations then answers another question.

    Parameters
    ----------
    method : str or Path
        A name in the suite, or the path of a TOML.
    scene : Scene, str, Path or dict
        The scene, or what `mor_bench.load_scene` takes. `fit` refuses None, scenes with sampled
        parameters, and scenes with observed displacements.
    **hyperparameters
        Replace those of the method's file. `set_params` and grids can set any of them. They belong
        to the method: a grid over several methods needs a dict of its own for each of them.

    Attributes
    ----------
    method_ : Surrogate
        The fitted method.
    scene_ : Scene
    n_features_in_ : int
        Three times the number of nodes.

    Examples
    --------
    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> X = data.train.forces.reshape(len(data.train), -1)
    >>> y = data.train.displacements.reshape(len(data.train), -1)
    >>> SurrogateRegressor("pod", data.scene, n_modes=5).fit(X, y).predict(X[:2]).shape
    (2, 189)
    """

    def __init__(
        self,
        method: str | Path = "pod",
        scene: Scene | str | Path | Mapping[str, Any] | None = None,
        **hyperparameters: Any,
    ) -> None:
        self.method = method
        self.scene = scene
        # As attributes of their own, which is scikit-learn's convention.
        self.__dict__.update(hyperparameters)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the method, the scene, and the hyperparameters that were set."""
        return {
            name: value
            for name, value in vars(self).items()
            if not name.startswith("_") and not name.endswith("_")
        }

    def set_params(self, **params: Any) -> Self:
        """Set the method, the scene, or hyperparameters of the method.

        Raises
        ------
        SpecError
            If the method has no such hyperparameter.
        """
        method, new = params.get("method", self.method), params.keys() - self.get_params().keys()
        if new and isinstance(method, str | Path):  # otherwise `fit` complains
            _check_names(method, new)
        self.__dict__.update(params)
        return self

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit the method.

        Parameters
        ----------
        X : (n, 3 n_nodes)
            Forces, N.
        y : (n, 3 n_nodes)
            Displacements, m; zero at the supports.

        Raises
        ------
        InvalidInputError
            For wrong numbers of columns, moved supports, or samples that the method refuses.
        SpecError, UnsupportedSceneError, MissingDependencyError
            As `mor_bench.load_method` and `Surrogate.fit`.
        """
        forces, moved = validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64
        )
        scene = _scene_of(self.scene)
        n_dofs = scene.mesh.n_dofs
        for name, array in (("X", forces), ("y", moved)):
            if array.ndim != 2 or array.shape[1] != n_dofs:
                raise InvalidInputError(
                    f"`{name}` must have one column for each degree of freedom of {scene.name}, "
                    f"{n_dofs}; got an array of shape {array.shape}."
                )
        samples = _snapshots(scene, forces, np.asarray(moved, dtype=np.float64))
        if not isinstance(self.method, str | Path):
            raise InvalidInputError(
                f"`method` must be a name or the path of a TOML; got {self.method!r}."
            )
        chosen = {k: v for k, v in self.get_params().items() if k not in ("method", "scene")}
        method = load_method(self.method, **chosen)
        self.method_ = method.fit(scene, samples if method.needs_snapshots else None)
        self.scene_ = scene
        return self

    def predict(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return displacements (n, 3 n_nodes), m, under forces (n, 3 n_nodes), N."""
        check_is_fitted(self)
        rows = validate_data(self, X, reset=False, dtype=np.float64)
        forces = rows.reshape(len(rows), self.scene_.mesh.n_nodes, 3)
        return self.method_.predict(forces).reshape(len(rows), -1)

    def score(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Return R² over the nodes whose displacements the scene wants.

        Columns are weighted by their variance. The plain mean over the columns would count each
        component of a support as perfect. `sample_weight` has one number per row.
        """
        predicted, dofs = self.predict(X), dofs_of_nodes(self.scene_.output_nodes)
        known = np.asarray(y)[:, dofs]
        return float(
            r2_score(
                known,
                predicted[:, dofs],
                sample_weight=sample_weight,
                multioutput="variance_weighted",
            )
        )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        tags.target_tags.single_output = False
        return tags


def _scene_of(source: Scene | str | Path | Mapping[str, Any] | None) -> Scene:
    if source is None:
        raise InvalidInputError("`scene` must be given: a Scene, or the name or path of a dataset.")
    scene = source if isinstance(source, Scene) else load_scene(source)
    if scene.parameter_names:
        raise UnsupportedSceneError(f"{scene.name}: X has no columns for sampled parameters.")
    if scene.observed_nodes is not None:
        raise UnsupportedSceneError(f"{scene.name}: X holds forces, but displacements are given.")
    return scene


def _snapshots(scene: Scene, X: NDArray[np.float64], y: NDArray[np.float64]) -> Snapshots:
    """Return rows of forces and displacements (n, n_dofs) as samples of a scene."""
    free = scene.at_free_dofs(y)
    moved = np.abs(scene.at_all_dofs(free) - y).max()
    if moved > HELD * np.abs(y).max():
        raise InvalidInputError(
            f"`y` must be zero where supports hold {scene.name}; got up to {moved:.3g} m."
        )
    patches = np.zeros((len(X), 1), dtype=np.int64)
    loads = NodalLoads(X.reshape(len(X), scene.mesh.n_nodes, 3), patches)
    return Snapshots(scene, loads, free, np.full(len(X), np.nan))


def _check_names(method: str | Path, names: Iterable[str]) -> None:
    known = annotated_defaults(load_method_spec(method).load_class())
    for name in names:
        if name not in known:
            raise SpecError(f"{method} has no parameter {name!r}{nearest_name(name, known)}")
