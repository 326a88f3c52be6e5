"""Data of the page's bodies: surface, reference and prediction of single test samples."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.selection_text import ERROR
from mor_bench.report.number_format import number, percent
from mor_bench.report.page_samples import Sampled, outline
from mor_bench.report.page_worst import LOAD_OF_KIND
from mor_bench.report.projection import normals
from mor_bench.scene.mesh import Mesh

KINDS = ("worst", "middle")
"""Samples that a run stores: the largest error e, and the median deformation."""

MOST_EDGES = 4000
"""Larger surfaces show only their sharp edges."""


def bodies(found: Sequence[Sampled], mesh: Mesh | None, most_bytes: int) -> dict[str, Any] | None:
    """Return the surface and samples of as many methods as `most_bytes` allow; None without any.

    `found` has the most important configurations first.
    """
    if mesh is None:
        return None
    nodes, facets = np.unique(mesh.drawn_facets, return_inverse=True)
    facets = facets.reshape(mesh.drawn_facets.shape)
    samples: list[dict[str, Any]] = []
    n_left_out, used = 0, 0
    for item in found:
        mine = [s for kind in KINDS if (s := _sample(item, kind, mesh, nodes)) is not None]
        size = sum(len(s[name]["data"]) for s in mine for name in ("reference", "error"))
        if used + size > most_bytes:
            n_left_out += 1
            continue
        used += size
        samples += mine
    if not samples:
        return None
    return {
        "points": packed(mesh.points[nodes]),
        "corners": mesh.drawn_facets.shape[1],
        "facets": _encoded(facets.astype("<i4")),
        "edges": _encoded(_edges(mesh, nodes).astype("<i4")),
        "size_m": float(np.linalg.norm(np.diff(mesh.bounds, axis=0))),
        "samples": samples,
        "n_left_out": n_left_out,
    }


def packed(values: NDArray[np.float64]) -> dict[str, Any]:
    """Encode an array with 16 bits per number, relative to its largest one."""
    largest = float(np.abs(values).max(initial=0.0)) or 1.0
    whole = np.round(values / largest * 32767).astype("<i2")
    return {"scale": largest / 32767, "data": _encoded(whole)}


def _encoded(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _edges(mesh: Mesh, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return all edges of the surface, or its sharp ones if there are many."""
    facets = mesh.drawn_facets
    pairs = np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges = np.unique(np.sort(pairs, axis=1), axis=0)
    if len(edges) > MOST_EDGES:
        edges = outline(mesh)
    return np.asarray(np.searchsorted(nodes, edges))


def _sample(
    item: Sampled, kind: str, mesh: Mesh, nodes: NDArray[np.int64]
) -> dict[str, Any] | None:
    """Return one stored sample of a configuration; None if it has no finite prediction."""
    names = [f"{kind}_{name}" for name in ("prediction", "reference", "forces")]
    if not set(names) <= set(item.arrays):
        return None
    prediction, reference, forces = (np.asarray(item.arrays[n], dtype=float) for n in names)
    shapes = {array.shape for array in (prediction, reference, forces)}
    if shapes != {mesh.points.shape} or not np.isfinite(prediction).all():
        return None
    size_m = float(np.linalg.norm(np.diff(mesh.bounds, axis=0)))
    error = prediction - reference
    force = _arrow(mesh, reference, forces)
    return {
        "label": item.entry.label,
        "kind": kind,
        "reference": packed(reference[nodes]),
        # A wild prediction would shrink the body to a dot.
        "error": packed(np.clip(error[nodes], -0.5 * size_m, 0.5 * size_m)),
        **_said(item, kind, error, reference),
        "force": force,
    }


def _said(
    item: Sampled, kind: str, error: NDArray[np.float64], reference: NDArray[np.float64]
) -> dict[str, str]:
    """Return a short caption of a sample, and a sentence that says which load it is.

    The load with the largest mean error may not be the one with the largest relative error; then
    the sentence states that one as well.
    """
    nodal = f"{number(1e3 * float(np.linalg.norm(error, axis=1).max()))} mm"
    norm = float(np.linalg.norm(reference))
    if not norm:
        return {"caption": nodal, "said": f"{LOAD_OF_KIND[kind]}: {nodal} at a node"}
    relative = float(np.linalg.norm(error)) / norm
    said = f"{LOAD_OF_KIND[kind]}: {nodal} at a node, {ERROR} {percent(relative)} %"
    largest = item.entry.figure("error", "rel_l2_max")
    if kind == "worst" and largest is not None and percent(largest) != percent(relative):
        said += f" (largest of all test loads: {percent(largest)} %)"
    return {"caption": f"{nodal}, {percent(relative)} %", "said": said}


def _arrow(
    mesh: Mesh, reference: NDArray[np.float64], forces: NDArray[np.float64]
) -> Mapping[str, Any] | None:
    """Return the total force as an arrow that touches the undeformed body, and its size in N."""
    size, total = np.linalg.norm(forces, axis=1), forces.sum(axis=0)
    if not size.sum() > 0 or not np.linalg.norm(total) > 0:
        return None
    place, moved = (size @ points / size.sum() for points in (mesh.points, reference))
    length = 0.2 * float(np.linalg.norm(np.diff(mesh.bounds, axis=0)))
    arrow = length * total / np.linalg.norm(total)
    facets = mesh.drawn_facets
    loaded = facets[np.isin(facets, np.flatnonzero(size > 0)).any(axis=1)]
    pushes = normals(mesh.points, loaded).sum(axis=0) @ total < 0
    return {
        "start": (place - arrow if pushes else place).tolist(),
        "vector": arrow.tolist(),
        "pushes": bool(pushes),
        "moved": moved.tolist(),
        "newton": float(np.linalg.norm(total)),
    }
