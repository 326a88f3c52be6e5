"""Random forests and extremely randomised trees between principal coordinates."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.coordinate_regression import CoordinateRegression, CoordinateSamples

Array = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_of_leaves(features, thresholds, children, roots, values, z, out):  # type: ignore[no-untyped-def]
    """out (n, n_outputs) = the mean over the trees of the values at the leaves that the inputs z (n, n_inputs) float32 lead to."""
    for i in range(len(z)):
        row, answer = z[i], out[i]
        answer[:] = 0.0
        for tree in range(len(roots)):
            node = roots[tree]
            while features[node] >= 0:
                node = (
                    children[node, 0]
                    if row[features[node]] <= thresholds[node]
                    else children[node, 1]
                )
            leaf = values[children[node, 0]]
            for k in range(len(answer)):
                answer[k] += leaf[k]
        for k in range(len(answer)):
            answer[k] /= len(roots)


class TreeRegression(CoordinateRegression):
    """g(z) = t(z) - t(0), with t the mean of the leaves that z falls to in each tree.

    Nodes of all trees stand in one list, every tree before the next and every node before its children. At an inner node
    `features` is the input that is compared with `thresholds`, in single precision as in scikit-learn, and `children` are the
    nodes for not more and for more; at a leaf `features` is -1, and `children` twice the row of `values`.

    Parameters
    ----------
    input : {"linear-response", "force"}
        What the coordinates z are taken of.
    n_input_modes : int, optional
        Length of z, by default 20 of the linear response and 60 of the force; capped at the rank of the input with a warning.
    n_output_modes : int
        Size of the basis Φ of the displacement, or of its nonlinear rest; capped at the rank with a warning.
    n_trees : int
    min_samples_leaf : int
        Samples that each leaf holds at least; fewer leaves make a smaller model.
    seed : int
        Of what each tree draws at random: its samples, or its thresholds.
    """

    integers = frozenset({"features", "children", "roots"})

    def __init__(
        self,
        input: Literal["linear-response", "force"] = "linear-response",
        n_input_modes: Annotated[int, Field(ge=1)] | None = None,
        n_output_modes: Annotated[int, Field(ge=1)] = 20,
        n_trees: Annotated[int, Field(ge=1, le=1000)] = 20,
        min_samples_leaf: Annotated[int, Field(ge=1)] = 1,
        seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
    ) -> None:
        self.input = input
        self.n_input_modes = n_input_modes
        self.n_output_modes = n_output_modes
        self.n_trees = n_trees
        self.min_samples_leaf = min_samples_leaf
        self.seed = seed

    @abstractmethod
    def _ensemble(self) -> Any:
        """Of scikit-learn, not yet fitted."""

    def _learn(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        z, targets = samples.z, samples.values
        trees = [
            estimator.tree_
            for estimator in self._ensemble()
            .fit(z, targets if targets.shape[1] > 1 else targets[:, 0])
            .estimators_
        ]
        features = np.concatenate([tree.feature for tree in trees])
        roots = np.cumsum([0, *(tree.node_count for tree in trees)])[:-1]
        leaves = features < 0
        children = np.concatenate(
            [
                root + np.stack([tree.children_left, tree.children_right], axis=1)
                for root, tree in zip(roots, trees, strict=True)
            ]
        )
        children[leaves] = np.arange(leaves.sum())[:, None]
        return {
            "features": np.where(leaves, -1, features).astype(np.int32),
            "thresholds": np.where(leaves, 0.0, np.concatenate([tree.threshold for tree in trees])),
            "children": children.astype(np.int32),
            "roots": roots.astype(np.int32),
            "values": np.concatenate([tree.value[:, :, 0] for tree in trees])[leaves],
        }

    def _shapes(
        self, state: dict[str, NDArray[Any]], n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int, ...]]:
        n_nodes, n_leaves = len(state["features"]), len(state["values"])
        return {
            "features": (n_nodes,),
            "thresholds": (n_nodes,),
            "children": (n_nodes, 2),
            "roots": (self.n_trees,),
            "values": (n_leaves, n_outputs),
        }

    def _take(self, state: dict[str, NDArray[Any]]) -> None:
        features, children, roots = state["features"], state["children"], state["roots"]
        n_nodes, inner = len(features), features >= 0
        if not ((features >= -1) & (features < state["axes"].shape[1])).all():
            raise InvalidInputError(f"`features` must be in [-1, {state['axes'].shape[1] - 1}].")
        if not (
            (children[inner] > np.flatnonzero(inner)[:, None]) & (children[inner] < n_nodes)
        ).all():
            raise InvalidInputError("`children` of an inner node must be nodes behind it.")
        if not ((children[~inner] >= 0) & (children[~inner] < len(state["values"]))).all():
            raise InvalidInputError("`children` of a leaf must be a row of `values`.")
        if not ((roots >= 0) & (roots < n_nodes)).all():
            raise InvalidInputError("`roots` must be nodes.")
        self.features_, self.thresholds_, self.children_ = features, state["thresholds"], children
        self.roots_, self.values_ = roots, state["values"]
        self._at_rest = self._means(np.zeros((1, state["axes"].shape[1])))

    def _learned(self) -> dict[str, NDArray[Any]]:
        return {
            "features": self.features_,
            "thresholds": self.thresholds_,
            "children": self.children_,
            "roots": self.roots_,
            "values": self.values_,
        }

    def _means(self, z: Array) -> Array:
        out = np.empty((len(z), self.values_.shape[1]))
        single = np.clip(z, -1e38, 1e38).astype(np.float32)
        _mean_of_leaves(
            self.features_, self.thresholds_, self.children_, self.roots_, self.values_, single, out
        )
        return out

    def _coefficients(self, z: Array) -> Array:
        # Comparisons and sums alone do not count.
        count(multiply_adds=z.shape[0] * self.values_.shape[1])
        return self._means(z) - self._at_rest


class PCARandomForest(TreeRegression):
    """A random forest between principal coordinates (Breiman, Machine Learning 45, 2001); see `TreeRegression`."""

    def _ensemble(self) -> Any:
        from sklearn.ensemble import RandomForestRegressor

        return RandomForestRegressor(
            self.n_trees, min_samples_leaf=self.min_samples_leaf, random_state=self.seed, n_jobs=1
        )


class PCAExtraTrees(TreeRegression):
    """Extremely randomised trees between principal coordinates (Geurts, Ernst and Wehenkel, Machine Learning 63, 2006).

    Thresholds are drawn at random and the best of one for each input is taken; every tree learns from all samples. See
    `TreeRegression`.
    """

    def _ensemble(self) -> Any:
        from sklearn.ensemble import ExtraTreesRegressor

        return ExtraTreesRegressor(
            self.n_trees, min_samples_leaf=self.min_samples_leaf, random_state=self.seed, n_jobs=1
        )
