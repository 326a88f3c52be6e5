"""Sampling plans: the forces and patches of sample i, or the displacement of a tool.

With one patch at a time, sample i acts on patch i modulo the number of patches. So the first n
samples always cover the load region evenly. With several patches, or a total number of samples, all
admissible combinations of patches are listed in one random order and used cyclically. If there are
more than `MAX_COMBINATIONS`, each sample draws its own combination.

Each force has up to three coordinates in the unit interval, which give its direction and magnitude:

random
    from a generator with seed (seed, i);
latin-hypercube, sobol
    from one design for the samples of each patch, with seed (seed, patch); with combinations, from
    one design for all samples.

With several tables, sample i has the i-th loads of each. If a table asks for n steps, sample i is
step i modulo n, plus 1, of load i / n.

Sampled parameters of the body are further coordinates: of the same design, or of a generator with
seed (seed, i) and a constant.

A sample depends neither on the order of generation nor on the number of workers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.acting import Acting
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.specs import (
    MAX_COUNT,
    Contact,
    LineLoads,
    Loads,
    Motion,
    PointLoads,
    Pressure,
    SampledParameters,
    Sampling,
)

MAX_COMBINATIONS = 5_000_000
"""Largest number of listed combinations of patches. With three patches each, they need 120 MB."""

MAX_PAIRED = 10_000
"""Largest number of patches whose distances from each other are computed."""

MAX_DRAWS = 1000
"""Tries per sample to draw patches that are far apart."""

Drawn = Loads | PointLoads | LineLoads | Motion
"""Tables whose loads are vectors."""

N_COORDINATES = {"force": 3, "point": 3, "line": 3, "displacement": 3, "tangential": 2, "normal": 1}
"""Coordinates of one force or displacement, by kind of load."""


def n_samples_of(scene: Scene, limit: int | None = None) -> int:
    """Return the number of samples of a scene's plan, or the limit if that is less.

    Raises
    ------
    SpecError
        If the plan has more than `MAX_COUNT` samples.
    """
    loads = scene.generated.load_plan
    whole = _n_loads(scene) * loads.steps
    if whole > MAX_COUNT:
        if loads.steps > 1:
            raise SpecError(
                f"`steps`: {_n_loads(scene):,} loads in {loads.steps:,} steps each are {whole:,} "
                f"samples; at most {MAX_COUNT:,} are allowed."
            )
        raise SpecError(
            f"`samples_per_patch`: {len(scene.patch_nodes):,} patches with "
            f"{loads.samples_per_patch:,} samples each are {whole:,} samples; at most "
            f"{MAX_COUNT:,} are allowed."
        )
    return whole if limit is None else min(limit, whole)


def _n_loads(scene: Scene) -> int:
    """Return the number of loads of a scene's plan, each of which may be applied in steps."""
    loads = scene.generated.load_plan
    if loads.samples_per_patch:
        return len(scene.patch_nodes) * loads.samples_per_patch
    return loads.samples or 0


def path_of_samples(scene: Scene, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of the load that each sample is a step of, (n,) int64."""
    return numbers // scene.generated.load_plan.steps


def draw_loads(scene: Scene, start: int, stop: int) -> PatchLoads:
    """Return the loads of samples ``start`` to ``stop - 1`` of a scene's plan.

    Raises
    ------
    SpecError
        If no patches are as far apart as the plan requires.
    """
    numbers, steps = np.arange(start, stop), scene.generated.load_plan.steps
    if steps == 1:
        return _drawn(scene, numbers)
    paths, row = np.unique(path_of_samples(scene, numbers), return_inverse=True)
    whole = _drawn(scene, paths)[row]
    parts = (numbers % steps + 1) / steps
    return replace(whole, vectors=whole.vectors * parts[:, None, None])


def _drawn(scene: Scene, numbers: NDArray[np.int64]) -> PatchLoads:
    """Return some loads of a plan, each as a whole."""
    whole, sampled = _n_loads(scene), scene.generated.parameters
    if scene.contact:
        return _instrument_motions(scene.contact, scene.contact_surface.axis, numbers, sampled)
    parts = [  # the parameters are drawn with the first table
        _drawn_from(acting, numbers, whole, None if number else sampled)
        for number, acting in enumerate(scene.acting)
    ]
    if len(parts) == 1:
        return parts[0]
    n_patches = [len(acting.nodes) for acting in scene.acting]
    firsts = np.append(0, np.cumsum(n_patches)[:-1])
    return PatchLoads(
        np.hstack([part.patches + first for part, first in zip(parts, firsts, strict=True)]),
        np.concatenate([part.vectors for part in parts], axis=1),
        parts[0].parameters,
    )


def _drawn_from(
    acting: Acting,
    numbers: NDArray[np.int64],
    whole: int,
    sampled: SampledParameters | None,
) -> PatchLoads:
    """Return some of ``whole`` loads of one table, with the sampled parameters of the body."""
    loads = acting.plan
    if isinstance(loads, Pressure):
        return _pressures(loads, numbers, sampled)
    assert not isinstance(loads, Contact)  # see `_drawn`
    chosen, k = _combinations(acting), loads.simultaneous
    if chosen is None:
        patches = np.stack([_apart(acting, int(i)) for i in numbers])
    else:
        patches = chosen[numbers % len(chosen)]
    free = N_COORDINATES[loads.kind] == 3  # directions that depend on no normal
    normals = np.zeros((*patches.shape, 3)) if free else acting.normals[patches]
    if loads.sampling == "random":
        drawn = [_random_forces(loads, int(i), n) for i, n in zip(numbers, normals, strict=True)]
        return PatchLoads(
            patches, np.stack(drawn), _random_parameters(loads.seed, sampled, numbers)
        )
    d = N_COORDINATES[loads.kind]
    n = k * d + _n_parameters(sampled)
    if k == 1:
        assert chosen is not None
        size, turns = -(-whole // len(chosen)), numbers // len(chosen)
        designs = [design(loads.sampling, (loads.seed, int(p)), size, n) for p in patches[:, 0]]
        unit = np.stack([own[turn] for own, turn in zip(designs, turns, strict=True)])
    else:
        unit = design(loads.sampling, (loads.seed,), whole, n)[numbers]
    forces = forces_at(loads, unit[:, : k * d].reshape(len(numbers), k, d), normals)
    return PatchLoads(patches, forces, _parameters(sampled, unit[:, k * d :]))


def _n_parameters(sampled: SampledParameters | None) -> int:
    return 0 if sampled is None else len(sampled.names)


def _parameters(
    sampled: SampledParameters | None, unit: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return sampled parameters for coordinates in [0, 1], (n, n_parameters) both."""
    return unit if sampled is None else sampled.values(unit)


def _random_parameters(
    seed: int, sampled: SampledParameters | None, numbers: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the parameters (n, n_parameters) of samples with a random plan."""
    if sampled is None:
        return np.zeros((len(numbers), 0))
    n = len(sampled.names)
    drawn = [np.random.default_rng([seed, 0xB0D7, int(i)]).uniform(size=n) for i in numbers]
    return _parameters(sampled, np.stack(drawn))


def _pressures(
    loads: Pressure, numbers: NDArray[np.int64], sampled: SampledParameters | None
) -> PatchLoads:
    """Return pressures, as the forces -p e_i on three patches of each region."""
    d = len(loads.regions)
    unit, parameters = _with_parameters(loads, numbers, d, sampled)
    low, high = loads.magnitude
    pressures = low + (high - low) * unit
    vectors = -pressures[:, :, None, None] * np.eye(3)
    patches = np.tile(np.arange(3 * d), (len(numbers), 1))
    return PatchLoads(patches, vectors.reshape(len(numbers), 3 * d, 3), parameters)


def _instrument_motions(
    loads: Contact,
    axis: NDArray[np.float64],
    numbers: NDArray[np.int64],
    sampled: SampledParameters | None,
) -> PatchLoads:
    """Return displacements of an instrument, in directions uniform on a cap of the sphere."""
    drawn, parameters = _with_parameters(loads, numbers, 3, sampled)
    first, second = (found[0, 0] for found in _tangents(axis[None, None]))
    height = 1.0 - drawn[:, 0] * (1.0 - np.cos(np.deg2rad(loads.spread_deg)))
    radius, angle = np.sqrt(np.maximum(1.0 - height**2, 0.0)), 2 * np.pi * drawn[:, 1]
    around = np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second)
    low, high = loads.magnitude
    size = low + (high - low) * drawn[:, 2]
    vectors = size[:, None] * (height[:, None] * axis + radius[:, None] * around)
    return PatchLoads(np.zeros((len(numbers), 1), dtype=np.int64), vectors[:, None], parameters)


def _with_parameters(
    loads: Pressure | Contact,
    numbers: NDArray[np.int64],
    d: int,
    sampled: SampledParameters | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return coordinates (n, d) in the unit cube, and sampled parameters (n, n_parameters)."""
    if loads.sampling == "random":
        drawn = [np.random.default_rng([loads.seed, int(i)]).uniform(size=d) for i in numbers]
        own = _random_parameters(loads.seed, sampled, numbers)
        return np.reshape(drawn, (len(numbers), d)), own
    n = d + _n_parameters(sampled)
    unit = design(loads.sampling, (loads.seed,), loads.samples, n)[numbers]
    return unit[:, :d], _parameters(sampled, unit[:, d:])


def _combinations(acting: Acting) -> NDArray[np.int64] | None:
    """Return the jointly loaded patches (n_combinations, k) in order of use; None if too many."""
    loads = acting.plan
    if loads.samples_per_patch:
        return np.arange(len(acting.nodes))[:, None]
    distance = loads.min_distance_m or 0.0
    found: NDArray[np.int64] | None = far_apart(
        acting.centres.tobytes(), loads.simultaneous, distance
    )
    if found is None:
        return None
    return found[np.random.default_rng([loads.seed, 0xC0B1]).permutation(len(found))]


@lru_cache(maxsize=2)
def far_apart(centres: bytes, k: int, distance: float) -> NDArray[np.int64] | None:
    """Return all sets (n, k) of k points with pairwise distances of at least `distance`.

    None if there are more than `MAX_COMBINATIONS`.

    Parameters
    ----------
    centres : bytes
        The points (n_points, 3) float64, m, as bytes.
    k : int
    distance : float
        Smallest distance, m.

    Raises
    ------
    SpecError
        If there is no such set.
    """
    from scipy.spatial.distance import cdist  # slow to import

    points = np.frombuffer(centres).reshape(-1, 3)
    if k > 1 and len(points) > MAX_PAIRED:
        raise SpecError(
            f"with `simultaneous` > 1 there must be at most {MAX_PAIRED:,} patches; "
            f"got {len(points):,}."
        )
    # Allow for round-off in the distance.
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
            f"`min_distance_m` is too large: no {k} of the {len(points)} patches are "
            f"{distance:g} m apart."
        )
    return sets


def _apart(acting: Acting, number: int) -> NDArray[np.int64]:
    """Return the patches (k,) of one sample, each drawn far enough from all before it."""
    loads, centres = acting.plan, acting.centres
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
        f"`min_distance_m`: in {MAX_DRAWS} tries no {loads.simultaneous} patches were "
        f"{loads.min_distance_m:g} m apart."
    )


def _random_forces(loads: Drawn, number: int, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the forces (k, 3) of one sample on patches with normals (k, 3)."""
    generator = np.random.default_rng([loads.seed, number])
    if N_COORDINATES[loads.kind] < 3:
        unit = generator.uniform(size=(1, loads.simultaneous, N_COORDINATES[loads.kind]))
        return np.asarray(forces_at(loads, unit, normals[None])[0])
    vectors = np.empty((loads.simultaneous, 3))
    for vector in vectors:
        direction = generator.normal(size=3)
        vector[:] = direction * (generator.uniform(*loads.magnitude) / np.linalg.norm(direction))
    return vectors


@lru_cache(maxsize=4096)
def design(sampling: Sampling, seed: tuple[int, ...], n: int, d: int) -> NDArray[np.float64]:
    """Return n points (n, d) of a space-filling design in the unit cube."""
    from scipy.stats import qmc  # slow to import

    generator = np.random.default_rng(seed)
    if sampling == "latin-hypercube":
        return np.asarray(qmc.LatinHypercube(d, rng=generator).random(n))
    # A scrambled Sobol sequence is balanced in powers of two. Points beyond n are dropped.
    n_bits = max(0, (n - 1).bit_length())
    return np.asarray(qmc.Sobol(d, scramble=True, rng=generator).random_base2(n_bits)[:n])


def forces_at(
    loads: Drawn, unit: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return forces (n, k, 3), N, for coordinates (n, k, d) in [0, 1] and normals (n, k, 3).

    d = 3: height and azimuth on the sphere (Archimedes) and magnitude. d = 2: angle in the tangent
    plane and magnitude. d = 1: the lower half of the interval presses, the upper half pulls.
    """
    low, high = loads.magnitude
    if loads.kind == "normal":
        signed = 2 * unit[:, :, 0] - 1
        size = np.sign(signed) * (low + (high - low) * np.abs(signed))
        return np.asarray(size[:, :, None] * normals)
    magnitude = (low + (high - low) * unit[:, :, -1])[:, :, None]
    angle = 2 * np.pi * unit[:, :, -2]
    cosine, sine = np.cos(angle), np.sin(angle)
    if loads.kind == "tangential":
        first, second = _tangents(normals)
        return np.asarray(magnitude * (cosine[:, :, None] * first + sine[:, :, None] * second))
    height = 2 * unit[:, :, 0] - 1
    radius = np.sqrt(1 - height**2)
    return np.asarray(magnitude * np.stack([radius * cosine, radius * sine, height], axis=2))


def _tangents(normals: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two orthogonal unit tangents (n, k, 3) for each normal."""
    # The axis furthest from the normal gives a cross product far from zero.
    axes = np.eye(3)[np.abs(normals).argmin(axis=2)]
    first = np.cross(normals, axes)
    first /= np.linalg.norm(first, axis=2, keepdims=True)
    return first, np.cross(normals, first)


def repeated(parts: Sequence[tuple[Scene, PatchLoads]]) -> int:
    """Return how many samples repeat others, in several sets of loads on one body."""
    rows = [
        np.hstack(
            [
                loads.parameters,
                scene.patch_nodes[loads.patches],
                loads.vectors.reshape(len(loads), -1),
            ]
        )
        for scene, loads in parts
    ]
    width = max(row.shape[1] for row in rows)
    padded = [
        np.pad(row, ((0, 0), (0, width - row.shape[1])), constant_values=np.inf) for row in rows
    ]
    together = np.concatenate(padded)
    ordered = together[np.lexsort(together.T)]
    return int((ordered[1:] == ordered[:-1]).all(axis=1).sum())
