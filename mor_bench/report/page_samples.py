"""Data of the page's charts that come from raw samples: distributions, positions, deformations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.report.entries import Entry, selected_per_method
from mor_bench.report.error_over_position import AZIMUTH, ELEVATION, median_per_patch
from mor_bench.report.projection import View, normals
from mor_bench.report.singular_values import spectrum_of
from mor_bench.results.comparison import Comparison
from mor_bench.scene.mesh import Mesh

MOST_STEPS = 160
"""Most points of a distribution."""

MOST_DOTS = 300
"""Most test samples of a method in the chart of deformations."""

EXACT = 1e-6
"""With a smaller median error, a reference repeats the solutions that it is compared with."""

N_BINS = 10
CREASE = 0.85
"""Edges whose facets' normals have a smaller cosine are drawn."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sampled:
    """A configuration and its raw samples."""

    entry: Entry
    arrays: Mapping[str, NDArray[Any]]


def dataset_arrays(comparison: Comparison, dataset: str) -> Mapping[str, NDArray[Any]]:
    """Read a dataset's arrays; empty if there are none."""
    try:
        return comparison.dataset_arrays(dataset)
    except (OSError, KeyError):
        return {}


def sampled(
    comparison: Comparison, entries: Sequence[Entry], preferred: Sequence[Entry]
) -> list[Sampled]:
    """Read the raw samples of one configuration per method.

    These are the `preferred` ones first, then the selected one of every other method.
    """
    chosen: dict[str, Entry] = {}
    for entry in preferred:
        chosen.setdefault(entry.method, entry)
    others = [entry for entry in selected_per_method(entries) if entry.method not in chosen]
    found = []
    for entry in [*chosen.values(), *others]:
        try:
            found.append(Sampled(entry, comparison.samples(entry.row)))
        except (OSError, KeyError):
            continue
    return found


def rounded(values: Any, digits: int = 4) -> list[float | None]:
    """Round to significant digits; what is not finite becomes None."""
    return [
        float(f"{v:.{digits}g}") if np.isfinite(v) else None
        for v in np.asarray(values, dtype=float).ravel().tolist()
    ]


def distribution(values: Any) -> dict[str, Any]:
    """Return points of the empirical distribution; infinite values keep it below 1."""
    finite = np.sort(np.asarray(values, dtype=float))
    n = len(finite)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return {"x": [], "share": [], "n": n}
    chosen = np.unique(np.linspace(0, len(finite) - 1, MOST_STEPS).round().astype(int))
    return {"x": rounded(finite[chosen]), "share": rounded((chosen + 1) / n), "n": n}


def has_error(entry: Entry) -> bool:
    """Tell whether a configuration has an error of its own; an exact reference has none."""
    return not (entry.row.reference and entry.error < EXACT)


def distributions(found: Sequence[Sampled]) -> list[dict[str, Any]]:
    """Return the distributions of error (%) and latency (ms) of each configuration."""
    return [
        {
            "label": item.entry.label,
            "error": distribution(
                100 * np.asarray(item.arrays.get("relative_l2", ()))
                if has_error(item.entry)
                else ()
            ),
            "latency": distribution(item.arrays.get("latency_ms", ())),
        }
        for item in found
    ]


def deformations(found: Sequence[Sampled]) -> list[dict[str, Any]]:
    """Return dots and medians of ten equal groups of the error over the deformation (mm).

    The error is e (mm) in `y`, and the relative L2 error (%) in `share`, of the same test loads.
    """
    out = []
    for item in found:
        if not {"amplitude_m", "mean_dof_m", "relative_l2"} <= set(item.arrays):
            continue
        x = 1e3 * np.asarray(item.arrays["amplitude_m"], dtype=float)
        y = 1e3 * np.asarray(item.arrays["mean_dof_m"], dtype=float)
        share = 100 * np.asarray(item.arrays["relative_l2"], dtype=float)
        known = np.isfinite(x) & np.isfinite(y) & np.isfinite(share)
        x, y, share = x[known], y[known], share[known]
        if not len(x):
            continue
        order = np.argsort(x)
        groups = np.array_split(order, min(N_BINS, len(order)))
        # The largest errors are kept, because they are what a reader looks for.
        largest = np.concatenate([np.argsort(y)[-20:], np.argsort(share)[-20:]])
        even = order[np.linspace(0, len(order) - 1, min(MOST_DOTS, len(order))).astype(int)]
        dots = np.unique(np.concatenate([largest, even]))
        out.append(
            {
                "label": item.entry.label,
                "x": rounded(x[dots]),
                "y": rounded(y[dots]),
                "share": rounded(share[dots]),
                "n": len(known),
                "n_missing": int((~known).sum()),
                "median_x": rounded([np.median(x[g]) for g in groups]),
                "median_y": rounded([np.median(y[g]) for g in groups]),
                "median_share": rounded([np.median(share[g]) for g in groups]),
            }
        )
    return out


def positions(
    found: Sequence[Sampled], arrays: Mapping[str, NDArray[Any]], mesh: Mesh | None
) -> dict[str, Any] | None:
    """Return the load patches on a view of the body, and the median error (%) at each patch."""
    if mesh is None or not {"patch_centres", "test_regions"} <= set(arrays):
        return None
    centres, regions = np.asarray(arrays["patch_centres"]), np.asarray(arrays["test_regions"])
    maps = [
        {
            "label": item.entry.label,
            "error": rounded(
                100
                * median_per_patch(np.asarray(item.arrays["relative_l2"]), regions, len(centres))
            ),
        }
        for item in found
        if len(item.arrays.get("relative_l2", ())) == len(regions)
    ]
    if not any(value for shown in maps for value in shown["error"]):
        return None
    above = centres[:, 2].mean() >= mesh.bounds[:, 2].mean()
    view = View(AZIMUTH, ELEVATION if above else -ELEVATION)
    screen = view.project(centres)[0]
    edges = view.project(mesh.points)[0][outline(mesh, view)]
    return {
        "x": rounded(screen[:, 0]),
        "y": rounded(screen[:, 1]),
        "centres": [rounded(centre, 3) for centre in centres],
        "edges": rounded(edges),
        "maps": maps,
    }


def outline(mesh: Mesh, view: View | None = None) -> NDArray[np.int64]:
    """Return the surface's sharp edges (n, 2); with a view, the visible ones and the silhouette."""
    facets = mesh.drawn_facets
    pairs = np.sort(np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(facets)), facets.shape[1])
    edges, place, count = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(place.ravel(), kind="stable")
    starts = np.cumsum(count) - count
    first, last = owner[order][starts], owner[order][starts + count - 1]
    normal = normals(mesh.points, facets)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    kept = (np.einsum("ij,ij->i", normal[first], normal[last]) < CREASE) | (count != 2)
    if view is not None:
        seen = view.facing(mesh.points, facets)
        kept = (kept & (seen[first] | seen[last])) | (seen[first] != seen[last])
    return np.asarray(edges[kept], dtype=np.int64)


def mesh_of(arrays: Mapping[str, NDArray[Any]]) -> Mesh | None:
    """Return the dataset's mesh; None if it was not recorded."""
    if not {"points", "cells"} <= set(arrays):
        return None
    return Mesh(np.asarray(arrays["points"]), np.asarray(arrays["cells"]))


def singular_values(
    arrays: Mapping[str, NDArray[Any]], error: float | None
) -> dict[str, Any] | None:
    """Return the decay of the training snapshots' singular values, and what r modes leave out."""
    found = spectrum_of(arrays)
    if found is None or not len(found.tail):
        return None
    return {
        "sigma": rounded(found.sigma),
        "tail": rounded(found.tail),
        "finding": found.finding(error or 0.01),
    }


def losses(comparison: Comparison, entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return the loss curves of all trainings, over the part of the training in percent."""
    out = []
    for entry in entries:
        if not (entry.ran and entry.row.training):
            continue
        try:
            arrays = comparison.samples(entry.row)
        except (OSError, KeyError):
            continue
        curves = {
            name: rounded(arrays[key])
            for name, key in (("loss", "loss_curve"), ("validation", "validation_curve"))
            if len(arrays.get(key, ()))
        }
        if curves:
            out.append({"label": entry.label, **curves})
    return out
