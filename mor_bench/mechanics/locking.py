"""Warning about a discretisation that is too stiff for a nearly incompressible material."""

from __future__ import annotations

import warnings

from mor_bench.errors import LockingWarning
from mor_bench.scene.scene import Scene

LOCKING_FROM = 0.45
"""Poisson's ratio above which H8 with full integration and T4 lock in volume; T10 do not."""


def locking_risk(scene: Scene) -> str | None:
    """Return why a scene locks, and the remedy; None if it does not, or its law is unknown."""
    if scene.material is None:
        return None
    poisson = scene.material.poisson_at_rest
    n_nodes = scene.mesh.cells.shape[1]
    if poisson <= LOCKING_FROM or scene.selective or n_nodes == 10:
        return None
    cells, remedy = "fully integrated H8", 'integration = "selective"'
    if n_nodes == 4:
        cells, remedy = "T4", f'order = 2, or element = "hexahedron" and {remedy},'
    return (
        f"{scene.name}: with Poisson's ratio {poisson:.6g} at rest, above {LOCKING_FROM}, {cells} "
        f"cells lock: displacements are too small; set {remedy} under [discretisation]."
    )


def warn_of_locking(scene: Scene) -> None:
    """Give a `LockingWarning` if a scene locks; called where a model is built."""
    risk = locking_risk(scene)
    if risk:
        warnings.warn(risk, LockingWarning, stacklevel=3)
