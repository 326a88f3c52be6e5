"""Named test sets beside a dataset's main one: in its range and out of it.

in-range
    The main plan with other draws.
2x, 4x
    The loads of `in-range`, two and four times as large.
unseen-regions
    Forces on a part of the surface where no load of the main set acts.
unseen-directions
    Forces across the surface's normal, where the main set's are along it, or along it where they are across. A plan with
    directions all over the sphere leaves none unseen: for it there is the split by direction.
several-forces
    Three at once, far apart, where the main set has one.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.specs import DatasetSpec

SetName = Literal["in-range", "2x", "4x", "unseen-regions", "unseen-directions", "several-forces"]

SET_NAMES: tuple[SetName, ...] = get_args(SetName)

SEED_SHIFT = 1_000_003
"""Between the seeds of the main set and of the others."""

N_SEVERAL = 3

FAR = 0.25
"""Distance between simultaneous forces, in diagonals of the load region's bounding box."""


def why_not(spec: DatasetSpec, name: SetName) -> str | None:
    """None, or the reason why a dataset has no such test set."""
    if name not in SET_NAMES:
        return f"there is no such set; known: {', '.join(SET_NAMES)}"
    if name == "unseen-regions" and spec.tests.unseen_region is None:
        return "its file names no `tests.unseen_region`"
    if name == "unseen-directions" and spec.loads.kind == "force":
        return "its directions are all over the sphere; the split by direction holds some of them out of training"
    if name == "several-forces" and spec.loads.simultaneous > 1:
        return "its main set has several forces"
    if name == "several-forces":
        scene = load_scene(spec)
        distance = FAR * _diagonal(scene)
        if distance == 0 or farthest(scene.patch_centres, distance) < N_SEVERAL:
            return f"it has no {N_SEVERAL} load patches that are {distance:g} m apart"
    return None


def available_sets(spec: DatasetSpec) -> list[SetName]:
    """The test sets that a dataset has."""
    return [name for name in SET_NAMES if why_not(spec, name) is None]


def spec_of_set(spec: DatasetSpec, name: SetName) -> DatasetSpec:
    """The dataset that a named test set is, generated and stored as any other.

    Raises
    ------
    InvalidInputError
        If the dataset has no such set; the message says why.
    """
    reason = why_not(spec, name)
    if reason:
        raise InvalidInputError(f"{spec.name} has no test set {name!r}: {reason}.")
    loads = spec.loads
    low, high = loads.magnitude_n
    changed: dict[str, Any] = {
        "samples_per_patch": None,
        "samples": spec.tests.samples,
        "seed": loads.seed + SEED_SHIFT,
    }
    if name in ("2x", "4x"):
        times = int(name[0])
        changed["magnitude_n"] = times * low, times * high
    elif name == "unseen-regions":
        changed.update(region=spec.tests.unseen_region, n_patches=None)
    elif name == "unseen-directions":
        changed["kind"] = "tangential" if loads.kind == "normal" else "normal"
    elif name == "several-forces":
        changed.update(simultaneous=N_SEVERAL, min_distance_m=FAR * _diagonal(load_scene(spec)))
    content = {
        **spec.model_dump(),
        "name": f"{spec.name}--{name}",
        "loads": {**loads.model_dump(), **changed},
    }
    return DatasetSpec.model_validate(content)


def with_test_sets(spec: DatasetSpec) -> list[DatasetSpec]:
    """A dataset and all the test sets that it has.

    Raises
    ------
    InvalidInputError
        If the loads of `unseen-regions` act where those of the main set do.
    """
    names = available_sets(spec)
    if "unseen-regions" in names:
        check_regions(spec)
    return [spec, *(spec_of_set(spec, name) for name in names)]


def farthest(centres: NDArray[np.float64], distance: float) -> int:
    """How many points, found one after the other from the first on, are all a distance apart."""
    chosen: list[NDArray[np.float64]] = []
    for centre in centres:
        if all(np.linalg.norm(centre - other) >= distance for other in chosen):
            chosen.append(centre)
    return len(chosen)


def check_regions(spec: DatasetSpec) -> None:
    """Check that the loads of the set `unseen-regions` act nowhere where those of the main set do.

    Raises
    ------
    InvalidInputError
        If they share a facet of the surface or the centre of a patch.
    """
    main, other = load_scene(spec), load_scene(spec_of_set(spec, "unseen-regions"))
    shared = np.intersect1d(main.patch_nodes, other.patch_nodes)
    facets = {tuple(sorted(facet)) for facet in main.loaded_facets.tolist()} & {
        tuple(sorted(facet)) for facet in other.loaded_facets.tolist()
    }
    if len(shared) or facets:
        raise InvalidInputError(
            f"{spec.name}: `tests.unseen_region` must lie apart from `loads.region`; they share {len(facets)} facets of the surface "
            f"and {len(shared)} centres of patches."
        )


def _diagonal(scene: Scene) -> float:
    return float(np.linalg.norm(np.ptp(scene.patch_centres, axis=0)))
