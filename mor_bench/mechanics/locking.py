"""Warnings about a body whose discretisation or stiffness costs accuracy."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import IllConditionedWarning, LockingWarning
from mor_bench.mechanics.banded import BandedFactor
from mor_bench.mechanics.pattern import Pattern
from mor_bench.mechanics.rotated import condition_number
from mor_bench.scene.scene import Scene

ILL_CONDITIONED = 1e10
"""Condition number above which solutions miss the default tolerance."""

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


def warn_if_ill_conditioned(
    name: str, pattern: Pattern, tangent: NDArray[np.float64], factor: BandedFactor
) -> None:
    """Warn of a scene whose stiffness at rest is too ill-conditioned for the default tolerance."""
    condition = condition_number(pattern, tangent, factor)
    if condition > ILL_CONDITIONED:
        digits = max(0, int(15.9 - np.log10(condition)))
        warnings.warn(
            f"{name}: the condition number of the stiffness at rest is about {condition:.0e}, "
            f"above {ILL_CONDITIONED:.0e}: displacements have about {digits} correct digits.",
            IllConditionedWarning,
            stacklevel=4,
        )
