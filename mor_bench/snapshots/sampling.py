"""Sampling plans: which forces act on which patches in sample number i.

With one patch at a time sample i acts on patch i modulo the number of patches, so that every beginning of a dataset covers
the load region evenly. With several, or a total number of samples, all admissible combinations of patches stand in one
random order and are gone through again and again; where there are more than `MAX_COMBINATIONS`, each sample draws its own.

Each force has up to three coordinates in the unit interval, which become its direction and magnitude. They are

random
    from a generator seeded with (seed, i);
latin-hypercube, sobol
    from a design for the samples of one patch, seeded with (seed, patch), or, with combinations, from one for all samples.
    A single Sobol sequence dealt out to 64 patches would give each patch directions from a 64th of the sphere.

Neither the order of generation nor the number of workers changes a sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from mor_bench.errors import SpecError
from mor_bench.scene.scene import Scene
from mor_bench.specs import Loads, Sampling

MAX_COMBINATIONS = 5_000_000
"""Combinations of patches that are listed at most, 120 MB of three each."""

MAX_DRAWS = 1000
"""Tries for each sample to draw patches that are far apart."""


@dataclass(frozen=True)
class PatchLoads:
    """Loads in compact form: k force vectors on k patches per sample.

    Attributes
    ----------
    patches : (n_samples, k) int64
        Patch numbers, which are also the load-region ids; they rise along a row.
    vectors : (n_samples, k, 3) float64
        Forces, N.
    """

    patches: NDArray[np.int64]
    vectors: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.patches)

    def __getitem__(self, index: NDArray[np.int64] | slice) -> PatchLoads:
        return PatchLoads(self.patches[index], self.vectors[index])

    def nodal_forces(self, weights: sp.csr_array) -> NDArray[np.float64]:
        """(n_samples, n_nodes, 3) nodal forces, N, from the scene's patch weights."""
        total = np.zeros((len(self), weights.shape[1], 3))
        for patches, vectors in zip(self.patches.T, np.moveaxis(self.vectors, 1, 0), strict=True):
            total += weights[patches].toarray()[:, :, None] * vectors[:, None, :]
        return total


def n_samples_of(scene: Scene) -> int:
    """How many samples a scene's plan has."""
    loads = scene.generated.loads
    return (
        len(scene.patch_nodes) * loads.samples_per_patch
        if loads.samples_per_patch
        else loads.samples or 0
    )


def draw_loads(scene: Scene, start: int, stop: int) -> PatchLoads:
    """The loads of samples ``start`` to ``stop - 1`` of a scene's plan.

    Raises
    ------
    SpecError
        If no patches are as far from each other as the plan asks.
    """
    loads, numbers = scene.generated.loads, np.arange(start, stop)
    chosen, k = _combinations(scene), loads.simultaneous
    if chosen is None:
        patches = np.stack([_apart(scene, int(i)) for i in numbers])
    else:
        patches, turn = chosen[numbers % len(chosen)], numbers // len(chosen)
    if loads.sampling == "random":
        vectors = np.stack(
            [
                _random_forces(loads, int(i), scene.patch_normals[p])
                for i, p in zip(numbers, patches, strict=True)
            ]
        )
        return PatchLoads(patches, vectors)
    d = 3 * k if loads.kind == "force" else 2 * k if loads.kind == "tangential" else k
    if k == 1:
        assert chosen is not None
        size = -(-n_samples_of(scene) // len(chosen))
        unit = np.stack(
            [
                _design(loads.sampling, (loads.seed, int(p[0])), size, d)[t]
                for p, t in zip(patches, turn, strict=True)
            ]
        )
    else:
        unit = _design(loads.sampling, (loads.seed,), n_samples_of(scene), d)[numbers]
    return PatchLoads(
        patches, _forces(loads, unit.reshape(len(numbers), k, d // k), scene.patch_normals[patches])
    )


def _combinations(scene: Scene) -> NDArray[np.int64] | None:
    """(n_combinations, k) patches that are loaded together, in the order in which samples go through them; None if too many."""
    loads = scene.generated.loads
    n_patches = len(scene.patch_nodes)
    if loads.samples_per_patch:
        return np.arange(n_patches)[:, None]
    found: NDArray[np.int64] | None = far_apart(
        scene.patch_centres.tobytes(), loads.simultaneous, loads.min_distance_m or 0.0
    )
    return (
        found
        if found is None
        else found[np.random.default_rng([loads.seed, 0xC0B1]).permutation(len(found))]
    )


@lru_cache(maxsize=2)
def far_apart(centres: bytes, k: int, distance: float) -> NDArray[np.int64] | None:
    """(n, k) all sets of k points, given as the bytes of (n_points, 3) float64, m, that are pairwise a distance or more apart.

    None if there are more than `MAX_COMBINATIONS`.

    Raises
    ------
    SpecError
        If there is none.
    """
    points = np.frombuffer(centres).reshape(-1, 3)
    # A distance that is met up to round-off is met.
    apart = cdist(points, points) >= distance * (1 - 1e-9)
    apart &= np.triu(np.ones_like(apart), 1)
    sets, allowed = np.arange(len(points))[:, None], np.ones_like(apart)
    for _ in range(k - 1):
        allowed = allowed & apart[sets[:, -1]] if sets.shape[1] > 1 else apart
        if allowed.sum() > MAX_COMBINATIONS:
            return None
        row, new = np.nonzero(allowed)
        sets, allowed = np.hstack([sets[row], new[:, None]]), allowed[row]
    if not len(sets):
        raise SpecError(
            f"`min_distance_m` must leave some {k} of the {len(points)} patches that far apart; {distance:g} leaves none."
        )
    return sets


def _apart(scene: Scene, number: int) -> NDArray[np.int64]:
    """(k,) patches of one sample, drawn one after the other from those that are far enough from all before."""
    loads, centres = scene.generated.loads, scene.patch_centres
    generator = np.random.default_rng([loads.seed, 0xC0B1, number])
    for _ in range(MAX_DRAWS):
        chosen, allowed = np.zeros(0, dtype=np.int64), np.arange(len(centres))
        while len(allowed) and len(chosen) < loads.simultaneous:
            chosen = np.append(chosen, generator.choice(allowed))
            near = np.linalg.norm(centres[allowed] - centres[chosen[-1]], axis=1)
            allowed = allowed[near >= (loads.min_distance_m or 0.0) * (1 - 1e-9)]
        if len(chosen) == loads.simultaneous:
            return np.sort(chosen)
    raise SpecError(
        f"`min_distance_m`: in {MAX_DRAWS} tries no {loads.simultaneous} patches were {loads.min_distance_m:g} m apart."
    )


def _random_forces(loads: Loads, number: int, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """(k, 3) the forces of one sample on patches with given normals (k, 3)."""
    generator = np.random.default_rng([loads.seed, number])
    if loads.kind != "force":
        unit = generator.uniform(
            size=(1, loads.simultaneous, 2 if loads.kind == "tangential" else 1)
        )
        return np.asarray(_forces(loads, unit, normals[None])[0])
    vectors = np.empty((loads.simultaneous, 3))
    for vector in vectors:
        direction = generator.normal(size=3)
        vector[:] = direction * (generator.uniform(*loads.magnitude_n) / np.linalg.norm(direction))
    return vectors


@lru_cache(maxsize=4096)
def _design(sampling: Sampling, seed: tuple[int, ...], n: int, d: int) -> NDArray[np.float64]:
    """n points of a space-filling design in the d-dimensional unit cube, (n, d)."""
    from scipy.stats import (
        qmc,
    )  # here, since it takes a quarter of the time of importing this package

    generator = np.random.default_rng(seed)
    if sampling == "latin-hypercube":
        return np.asarray(qmc.LatinHypercube(d, rng=generator).random(n))
    # A scrambled Sobol sequence is balanced in whole powers of two; what is beyond n is left out.
    return np.asarray(
        qmc.Sobol(d, scramble=True, rng=generator).random_base2(max(0, (n - 1).bit_length()))[:n]
    )


def _forces(
    loads: Loads, unit: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Forces (n, k, 3), N, from coordinates (n, k, d) in the unit cube and outward normals (n, k, 3).

    d = 3: height and azimuth on the sphere (Archimedes) and magnitude. d = 2: angle in the tangent plane and magnitude.
    d = 1: the lower half of the interval presses, the upper half pulls.
    """
    low, high = loads.magnitude_n
    if loads.kind == "normal":
        signed = 2 * unit[:, :, 0] - 1
        return np.asarray(
            (np.sign(signed) * (low + (high - low) * np.abs(signed)))[:, :, None] * normals
        )
    magnitude = (low + (high - low) * unit[:, :, -1])[:, :, None]
    angle = 2 * np.pi * unit[:, :, -2]
    if loads.kind == "tangential":
        first, second = _tangents(normals)
        return np.asarray(
            magnitude * (np.cos(angle)[:, :, None] * first + np.sin(angle)[:, :, None] * second)
        )
    height = 2 * unit[:, :, 0] - 1
    radius = np.sqrt(1 - height**2)
    return np.asarray(
        magnitude * np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2)
    )


def _tangents(normals: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two unit vectors (n, k, 3) across each normal and each other."""
    # The axis that is furthest from the normal gives a cross product that is far from zero.
    axes = np.eye(3)[np.abs(normals).argmin(axis=2)]
    first = np.cross(normals, axes)
    first /= np.linalg.norm(first, axis=2, keepdims=True)
    return first, np.cross(normals, first)


def repeated(parts: Sequence[tuple[Scene, PatchLoads]]) -> int:
    """How many samples of some sets of loads, all on one body, are there already in the same or an earlier set."""
    rows = [
        np.hstack([scene.patch_nodes[loads.patches], loads.vectors.reshape(len(loads), -1)])
        for scene, loads in parts
    ]
    widest = max(row.shape[1] for row in rows)
    together = np.concatenate(
        [np.pad(row, ((0, 0), (0, widest - row.shape[1])), constant_values=np.inf) for row in rows]
    )
    ordered = together[np.lexsort(together.T)]
    return int((ordered[1:] == ordered[:-1]).all(axis=1).sum())
