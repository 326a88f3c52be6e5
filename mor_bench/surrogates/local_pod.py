"""Local POD: one small basis per cluster of the snapshots, with static correction."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError, RankDeficientWarning
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import pod
from mor_bench.reduction.static_correction import (
    SOFTENED,
    corrected_snapshots,
    mark_of,
    model_of,
    predict_corrected,
    softened,
)
from mor_bench.reduction.tensors import TensorProblem, polynomial_pays
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.cubature_states import softened_if_locked
from mor_bench.surrogates.free_dofs import answer_each, galerkin_or_polynomial

Array = NDArray[np.float64]

N_COORDINATES = 12
"""Number of principal coordinates of the linear response in which loads are compared."""

OVERLAP = 0.5
"""Number of near samples of other clusters that also train a basis, relative to its own."""

N_WATCHED = 300
"""Samples of a cluster that decide where det F is monitored."""


@dataclass(eq=False)
class LocalPOD(Surrogate):
    """Clustered snapshots, a POD basis for each cluster, and Galerkin projection on one of them.

    Amsallem, Zahr, Farhat: Nonlinear model order reduction based on local reduced-order bases,
    IJNME 92 (2012). In the paper, the basis changes along a path. Here it is chosen once per load,
    by the direction of the linear response K₀⁻¹f in a few principal coordinates. Each basis spans
    the nonlinear parts u - K₀⁻¹f of its snapshots and, with a small weight, their linear responses.
    The static correction adds the part of the linear response outside the basis.

    Parameters
    ----------
    n_clusters : int
        Clusters, by k-means with a fixed seed; at most the number of different directions of
        training samples. 1 is global POD. Use more clusters if bases are small.
    n_modes : int
        Size of each basis; capped at its snapshots' rank with a warning.
    tolerance : float
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    """

    n_clusters: Annotated[int, Field(ge=1)] = 64
    n_modes: Annotated[int, Field(ge=1)] = 10
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        if self.n_modes > len(samples):
            warnings.warn(
                f"{self.n_modes} modes were requested, but the {len(samples)} snapshots "
                f"have at most rank {len(samples)}. Linear responses fill the basis.",
                RankDeficientWarning,
                stacklevel=3,
            )
        model = FullOrderModel(scene)
        linear = model.rest_factor.solve(samples.free_forces.T).T
        axes = pod(linear).modes[:, :N_COORDINATES]
        directions = _directions(linear @ axes)
        centroids, labels = _clusters(directions, self.n_clusters)
        bases = self._bases(samples.free_displacements, linear, directions, centroids, labels)
        of_clusters: dict[str, Array] = {}
        for cluster, basis in enumerate(bases):
            own = samples[np.flatnonzero(labels == cluster)]
            reduced = softened_if_locked(model, own, basis)
            arrays = mark_of(scene, reduced)
            if polynomial_pays(model, basis.shape[1], len(bases)):
                watched = own.free_displacements[:N_WATCHED] @ basis
                arrays |= TensorProblem.of_modes(model_of(reduced, model), basis, watched).arrays
            of_clusters |= {f"{name}.{cluster}": array for name, array in arrays.items()}
        return {
            **of_clusters,
            "to_coordinates": model.rest_factor.solve(axes),
            "centroids": centroids,
            "sizes": np.array([basis.shape[1] for basis in bases]),
            "modes": np.hstack(bases),
        }

    def _bases(
        self,
        displacements: Array,
        linear: Array,
        directions: Array,
        centroids: Array,
        labels: NDArray[np.int64],
    ) -> list[Array]:
        """Return a basis (n_free, r) per cluster, from its samples and near ones of others."""
        distances = np.linalg.norm(directions[:, None] - centroids, axis=2)
        both = corrected_snapshots(displacements, linear).reshape(len(linear), 2, -1)
        bases = []
        for cluster in range(len(centroids)):
            own, others = np.flatnonzero(labels == cluster), np.flatnonzero(labels != cluster)
            # Neighbours fill the basis of a small cluster.
            n_near = max(round(OVERLAP * len(own)), self.n_modes - len(own))
            near = others[np.argsort(distances[others, cluster], kind="stable")[:n_near]]
            chosen = both[np.append(own, near)].reshape(-1, both.shape[2])
            bases.append(pod(chosen, self.n_modes).modes)
        return bases

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        n_free = len(scene.free_dofs)
        self.centroids_ = take_array(model, "centroids", (None, None))
        n_clusters, n_coordinates = self.centroids_.shape
        self.to_coordinates_ = take_array(model, "to_coordinates", (n_free, n_coordinates))
        sizes = take_array(model, "sizes", (n_clusters,), np.int64)
        if not (sizes >= 1).all():
            raise InvalidInputError(f"`sizes` must be {n_clusters} positive integers.")
        modes = take_array(model, "modes", (n_free, int(sizes.sum())))
        self.model_ = FullOrderModel(scene)
        self.bases_ = [
            np.ascontiguousarray(basis) for basis in np.split(modes, np.cumsum(sizes)[:-1], axis=1)
        ]
        arrays = [_of_cluster(model, cluster) for cluster in range(n_clusters)]
        soft = model_of(softened(scene), self.model_)
        self.problems_ = [
            galerkin_or_polynomial(scene, soft if SOFTENED in own else self.model_, basis, own)
            for basis, own in zip(self.bases_, arrays, strict=True)
        ]
        self.compliance_ = Compliance(self.model_)
        for problem in self.problems_:
            problem.prepare()

    def answer(self, forces: Array) -> Array:
        count(multiply_adds=len(forces) * (self.to_coordinates_.size + self.centroids_.size))
        return answer_each(self.scene_, forces, self._solve)

    def nearest(self, load: Array) -> int:
        """Return the cluster with directions nearest to that of a load (n_free,), N."""
        direction = _directions((load @ self.to_coordinates_)[None])
        return int(((direction - self.centroids_) ** 2).sum(axis=1).argmin())

    def _solve(self, load: Array) -> Array:
        nearest = self.nearest(load)
        return predict_corrected(
            self.problems_[nearest],
            self.bases_[nearest],
            self.model_,
            self.compliance_,
            load,
            self.tolerance,
        )


def _of_cluster(model: Mapping[str, NDArray[Any]], cluster: int) -> dict[str, NDArray[Any]]:
    ending = f".{cluster}"
    return {
        name.removesuffix(ending): np.ascontiguousarray(array)
        for name, array in model.items()
        if name.endswith(ending)
    }


def _directions(coordinates: Array) -> Array:
    """Return rows of unit length; zero where there is no load."""
    sizes = np.linalg.norm(coordinates, axis=1, keepdims=True)
    return np.asarray(coordinates / np.where(sizes > 0, sizes, 1.0))


def _clusters(directions: Array, n_clusters: int) -> tuple[Array, NDArray[np.int64]]:
    """Return centroids (k, n_coordinates), and the nearest one of each direction, by k-means."""
    from sklearn.cluster import KMeans

    n_distinct = len(np.unique(directions, axis=0))
    found = KMeans(min(n_clusters, n_distinct), n_init=4, random_state=0).fit(directions)
    used, labels = np.unique(found.labels_, return_inverse=True)  # rounding may empty a cluster
    return found.cluster_centers_[used], labels.astype(np.int64)
