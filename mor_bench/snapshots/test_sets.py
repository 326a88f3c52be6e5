"""Named test sets beside a dataset's main one, in and out of its range.

in-range
    The main plan with other draws.
2x, 4x
    The loads of `in-range`, two and four times as large.
paper-amplitude
    The loads of `in-range`, scaled so that the largest deformation is that of the paper's scene.
unseen-regions
    Forces on a part of the surface where no load of the main set acts.
unseen-directions
    Tangential forces if the main set has normal ones, and vice versa. If the main set has
    directions all over the sphere, use the split by direction instead.
several-forces
    Three simultaneous forces, far apart, if the main set has one.
unseen-parameters
    The loads of the main plan, on bodies whose sampled parameters all lie outside their ranges.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.specs import (
    AnyTable,
    Contact,
    DatasetSpec,
    LineLoads,
    Loads,
    Motion,
    Pressure,
    SampledParameters,
    Several,
    wrong_parameters,
)

SetName = Literal[
    "in-range",
    "2x",
    "4x",
    "paper-amplitude",
    "unseen-regions",
    "unseen-directions",
    "several-forces",
    "unseen-parameters",
]

SET_NAMES: tuple[SetName, ...] = get_args(SetName)

SEED_SHIFT = 1_000_003
"""Difference between the seeds of the main set and of the other sets."""

N_SEVERAL = 3

FAR = 0.25
"""Distance between simultaneous forces, in diagonals of the load region's bounding box."""


def why_not(spec: DatasetSpec, name: SetName) -> str | None:
    """Return the reason why a dataset has no such test set, or None if it has one."""
    if name not in SET_NAMES:
        return f"there is no such set; known: {', '.join(SET_NAMES)}"
    if name == "unseen-parameters":
        return _no_parameters_outside(spec)
    if name == "unseen-regions" and spec.tests.unseen_region is None:
        return "its file names no `tests.unseen_region`"
    if name == "unseen-regions" and isinstance(spec.load_plan, LineLoads):
        return "its loads act along given lines"
    if name == "paper-amplitude" and spec.tests.paper_magnitude_n is None:
        return "its file names no `tests.paper_magnitude_n`"
    if name == "unseen-directions" and spec.load_plan.kind == "pressure":
        return "a pressure has one direction"
    if name == "unseen-directions" and spec.load_plan.kind == "several":
        return "several tables of loads act together"
    if name == "unseen-directions" and spec.load_plan.kind == "contact":
        return "its directions are those of an instrument, around `loads.direction`"
    if name == "unseen-directions" and spec.load_plan.kind not in ("normal", "tangential"):
        return (
            "its directions are all over the sphere; "
            "the split by direction holds some of them out of training"
        )
    if name == "several-forces" and not isinstance(spec.load_plan, Loads):
        return "its loads are no forces on patches"
    if name == "several-forces" and spec.load_plan.simultaneous > 1:
        return "its main set has several forces"
    if name == "several-forces":
        scene = load_scene(spec)
        distance = FAR * _diagonal(scene)
        if distance == 0 or _farthest(scene.patch_centres, distance) < N_SEVERAL:
            return f"it has no {N_SEVERAL} load patches that are {distance:g} m apart"
    return None


def _no_parameters_outside(spec: DatasetSpec) -> str | None:
    """Return why parameters cannot be drawn outside their ranges; None if they can."""
    if spec.parameters is None:
        return "it has no table `parameters`"
    wrong = list(wrong_parameters(_outside(spec, spec.parameters), spec.material))
    return f"`tests.unseen_parameters` is too large: {'. '.join(wrong)}" if wrong else None


def _outside(spec: DatasetSpec, parameters: SampledParameters) -> SampledParameters:
    return parameters.model_copy(update={"outside": spec.tests.unseen_parameters})


def available_sets(spec: DatasetSpec) -> list[SetName]:
    """Return the names of the test sets that a dataset has."""
    return [name for name in SET_NAMES if why_not(spec, name) is None]


def spec_of_set(spec: DatasetSpec, name: SetName) -> DatasetSpec:
    """Return a named test set as a dataset with its own generation and storage.

    Raises
    ------
    InvalidInputError
        If the dataset has no such set; the message gives the reason.
    """
    if reason := why_not(spec, name):
        raise InvalidInputError(f"{spec.name} has no test set {name!r}: {reason}.")
    plan = spec.load_plan
    if isinstance(plan, Several):
        tables = [_changed(spec, table, name) for table in plan.tables]
        loads: dict[str, Any] = {"kind": "several", "tables": tables}
    else:
        loads = _changed(spec, plan, name)
    content = {**spec.model_dump(), "name": f"{spec.name}--{name}"}
    if name == "unseen-parameters" and spec.parameters is not None:
        content["parameters"] = _outside(spec, spec.parameters).model_dump()
    return DatasetSpec.model_validate({**content, "loads": loads})


def _changed(spec: DatasetSpec, loads: AnyTable, name: SetName) -> dict[str, Any]:
    """Return a table of loads of a named test set."""
    low, high = loads.magnitude
    changed: dict[str, Any] = {"samples": spec.tests.samples, "seed": loads.seed + SEED_SHIFT}
    if not isinstance(loads, Motion | Pressure | Contact):
        changed["samples_per_patch"] = None
    if name in ("2x", "4x"):
        times = int(name[0])
        changed[f"magnitude_{loads.unit.lower()}"] = times * low, times * high
    elif name == "paper-amplitude":
        changed["magnitude_n"] = spec.tests.paper_magnitude_n
    elif name == "unseen-regions":
        changed.update(region=spec.tests.unseen_region, n_patches=None)
    elif name == "unseen-directions":
        changed["kind"] = "tangential" if loads.kind == "normal" else "normal"
    elif name == "several-forces":
        changed.update(simultaneous=N_SEVERAL, min_distance_m=FAR * _diagonal(load_scene(spec)))
    return {**loads.model_dump(), **changed}


def with_test_sets(spec: DatasetSpec) -> list[DatasetSpec]:
    """Return a dataset and all its test sets.

    Raises
    ------
    InvalidInputError
        If the loads of `unseen-regions` overlap those of the main set.
    """
    names = available_sets(spec)
    if "unseen-regions" in names:
        check_regions(spec)
    return [spec, *(spec_of_set(spec, name) for name in names)]


def check_regions(spec: DatasetSpec) -> None:
    """Check that the loads of `unseen-regions` act apart from those of the main set.

    Raises
    ------
    InvalidInputError
        If they share a facet of the surface or the centre of a patch.
    """
    main, other = load_scene(spec), load_scene(spec_of_set(spec, "unseen-regions"))
    n_centres = len(np.intersect1d(main.patch_nodes, other.patch_nodes))
    facets = [{tuple(sorted(f)) for f in s.loaded_facets.tolist()} for s in (main, other)]
    n_facets = len(facets[0] & facets[1])
    if n_centres or n_facets:
        raise InvalidInputError(
            f"{spec.name}: `tests.unseen_region` must lie apart from `loads.region`; they share "
            f"{n_facets} facets of the surface and {n_centres} centres of patches."
        )


def _farthest(centres: NDArray[np.float64], distance: float) -> int:
    """Count greedily chosen points with pairwise distances of at least `distance`, m."""
    chosen: list[NDArray[np.float64]] = []
    for centre in centres:
        if all(np.linalg.norm(centre - other) >= distance for other in chosen):
            chosen.append(centre)
    return len(chosen)


def _diagonal(scene: Scene) -> float:
    return float(np.linalg.norm(np.ptp(scene.patch_centres, axis=0)))
