"""Random forests and extremely randomised trees between principal coordinates."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.coordinate_regression import (
    Array,
    Arrays,
    CoordinateRegression,
    CoordinateSamples,
    Input,
)


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_of_leaves(features, thresholds, children, roots, values, z):  # type: ignore[no-untyped-def]
    """Return the leaf values at z (n, n_inputs) float32, averaged over the trees."""
    out = np.empty((len(z), values.shape[1]))
    for i in range(len(z)):
        row, answer = z[i], out[i]
        answer[:] = 0.0
        for tree in range(len(roots)):
            node = roots[tree]
            while features[node] >= 0:
                below = row[features[node]] <= thresholds[node]
                node = children[node, 0 if below else 1]
            leaf = values[children[node, 0]]
            for k in range(len(answer)):
                answer[k] += leaf[k]
        for k in range(len(answer)):
            answer[k] /= len(roots)
    return out


class TreeRegression(CoordinateRegression):
    """g(z) = t(z) - t(0), with t the mean over all trees of the leaf value at z.

    One list holds the nodes of all trees, each node before its children. At an inner node,
    `features` is the index of the input to compare with `thresholds`, in single precision as in
    scikit-learn. `children` are the nodes for "not above" and "above". At a leaf, `features` is
    -1, and `children` holds the row of `values` twice.
    """

    n_trees: int
    min_samples_leaf: int
    seed: int

    integers: ClassVar = frozenset({"features", "children", "roots"})

    @abstractmethod
    def ensemble(self) -> Any:
        """Return an unfitted scikit-learn ensemble."""

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        z, targets = samples.z, samples.values
        ensemble = self.ensemble().fit(z, targets if targets.shape[1] > 1 else targets[:, 0])
        trees = [estimator.tree_ for estimator in ensemble.estimators_]
        features = np.concatenate([tree.feature for tree in trees])
        roots = np.cumsum([0, *(tree.node_count for tree in trees)])[:-1]
        pairs = [np.stack([tree.children_left, tree.children_right], axis=1) for tree in trees]
        children = np.concatenate([root + pair for root, pair in zip(roots, pairs, strict=True)])
        leaves = features < 0
        children[leaves] = np.arange(leaves.sum())[:, None]
        return {
            "features": np.where(leaves, -1, features).astype(np.int32),
            "thresholds": np.where(leaves, 0.0, np.concatenate([tree.threshold for tree in trees])),
            "children": children.astype(np.int32),
            "roots": roots.astype(np.int32),
            "values": np.concatenate([tree.value[:, :, 0] for tree in trees])[leaves],
        }

    def shapes(
        self, model: Arrays, n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int | None, ...]]:
        n_nodes, n_leaves = len(model["features"]), len(model["values"])
        return {
            "features": (n_nodes,),
            "thresholds": (n_nodes,),
            "children": (n_nodes, 2),
            "roots": (self.n_trees,),
            "values": (n_leaves, n_outputs),
        }

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        features, children, roots = model["features"], model["children"], model["roots"]
        n_nodes, n_inputs, inner = len(features), self.axes_.shape[1], features >= 0
        behind = np.flatnonzero(inner)[:, None]
        if not ((features >= -1) & (features < n_inputs)).all():
            raise InvalidInputError(f"`features` must be in [-1, {n_inputs - 1}].")
        if not ((children[inner] > behind) & (children[inner] < n_nodes)).all():
            raise InvalidInputError(
                "`children` of an inner node must be nodes with larger numbers."
            )
        if not ((children[~inner] >= 0) & (children[~inner] < len(model["values"]))).all():
            raise InvalidInputError("`children` of a leaf must be a row of `values`.")
        if not ((roots >= 0) & (roots < n_nodes)).all():
            raise InvalidInputError("`roots` must be nodes.")
        self._trees = features, model["thresholds"], children, roots, model["values"]
        self._n_outputs = model["values"].shape[1]
        self._at_rest = self._means(np.zeros((1, n_inputs)))

    def coefficients(self, z: Array) -> Array:
        # Comparisons and sums alone do not count.
        count(multiply_adds=len(z) * self._n_outputs)
        return self._means(z) - self._at_rest

    def spread(self, forces: ArrayLike) -> Array:
        """Return how much the trees disagree relative to the prediction, of shape () or (n,).

        Parameters and errors are those of `disagreement`. It is zero for a single tree.
        """
        return self.disagreement(forces, self._members)

    def _means(self, z: Array) -> Array:
        single = np.clip(z, -1e38, 1e38).astype(np.float32)
        return np.asarray(_mean_of_leaves(*self._trees, single))

    def _members(self, z: Array) -> Array:
        """Return g of each tree at z (n, n_inputs), as (n_trees, n, n_outputs)."""
        single = np.clip(np.vstack([z, 0.0 * z[:1]]), -1e38, 1e38).astype(np.float32)
        features, thresholds, children, roots, values = self._trees
        found: Array = np.stack(
            [
                _mean_of_leaves(features, thresholds, children, root, values, single)
                for root in roots[:, None]
            ]
        )
        return found[:, :-1] - found[:, -1:]


@dataclass(eq=False)
class PCARandomForest(TreeRegression):
    """A random forest between principal coordinates (Breiman, Machine Learning 45, 2001).

    `input`, `n_input_modes` and `n_output_modes` are those of `CoordinateRegression`.

    Parameters
    ----------
    n_trees : int
        Number of trees, 1 to 1000.
    min_samples_leaf : int
        Smallest number of samples in a leaf; larger numbers make a smaller model.
    seed : int
        Seed of the random draws of each tree.
    """

    input: Input = "linear-response"
    n_input_modes: Annotated[int, Field(ge=1)] | None = None
    n_output_modes: Annotated[int, Field(ge=1)] = 20
    n_trees: Annotated[int, Field(ge=1, le=1000)] = 20
    min_samples_leaf: Annotated[int, Field(ge=1)] = 1
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    def ensemble(self) -> Any:
        from sklearn.ensemble import RandomForestRegressor

        return RandomForestRegressor(
            self.n_trees, min_samples_leaf=self.min_samples_leaf, random_state=self.seed, n_jobs=1
        )


@dataclass(eq=False)
class PCAExtraTrees(PCARandomForest):
    """Extremely randomised trees (Geurts, Ernst and Wehenkel, Machine Learning 63, 2006).

    Each split is the best of one random threshold per input; every tree learns from all samples.
    The parameters are those of `PCARandomForest`.
    """

    def ensemble(self) -> Any:
        from sklearn.ensemble import ExtraTreesRegressor

        return ExtraTreesRegressor(
            self.n_trees, min_samples_leaf=self.min_samples_leaf, random_state=self.seed, n_jobs=1
        )
