"""How large the strains of the stored test loads are, from the displacements at the nodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.report.number_format import number
from mor_bench.report.page_bodies import KINDS
from mor_bench.report.page_samples import Sampled, mesh_of


def strain_facts(
    samples: Sequence[Sampled], arrays: Mapping[str, NDArray[Any]]
) -> list[tuple[str, str]]:
    """State the extreme stretches and det F of the stored references; nothing without a mesh."""
    mesh = mesh_of(arrays)
    names = [f"{kind}_reference" for kind in KINDS]
    stored = [item.arrays[name] for item in samples for name in names if name in item.arrays]
    fields = [np.asarray(u, dtype=float) for u in stored]
    if mesh is None or not fields or any(u.shape != mesh.points.shape for u in fields):
        return []
    gradients, _ = shape_gradients(mesh.points, mesh.cells, element_of(mesh.cells).derivatives)
    found = [np.eye(3) + np.einsum("cai,cqaj->cqij", u[mesh.cells], gradients) for u in fields]
    stretches = np.linalg.svd(np.stack(found), compute_uv=False)
    least = float(np.linalg.det(np.stack(found)).min())
    text = (
        f"stretches from {number(float(stretches.min()))} to {number(float(stretches.max()))}, "
        f"det F at least {number(least)}, at the quadrature points of the {len(fields)} stored "
        "test loads (the worst and the middle one of each method shown)"
    )
    return [("strains", text)]
