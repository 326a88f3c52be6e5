"""Grids of single loads on a scene: every patch, directions on the sphere, and magnitudes.

The grid is the quadrature of an integral over all single loads of a scene. No load of the grid is
solved for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from mor_bench.reduction.derivative_modes import patch_forces
from mor_bench.scene.scene import Scene
from mor_bench.specs.load_ranges import largest_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoadGrid:
    """Loads m d on each patch, with the weights of their mean.

    Attributes
    ----------
    forces : (n_patches, 3, n_free) float64
        Forces on the free dofs, N, of 1 N along each axis on each patch.
    directions : (n_directions, 3) float64
        Unit vectors d.
    magnitudes : (n_magnitudes,) float64
        m, N.
    weights : (n_directions, n_magnitudes) float64
        Their sum is 1.
    """

    forces: Array
    directions: Array
    magnitudes: Array
    weights: Array

    @property
    def vectors(self) -> Array:
        """(n_directions * n_magnitudes, 3) force vectors m d, N; the magnitude varies fastest."""
        return (self.directions[:, None] * self.magnitudes[:, None]).reshape(-1, 3)


def sphere_rule(n_rings: int) -> tuple[Array, Array]:
    """Return directions (2 n_rings², 3) and their weights, whose sum is 1.

    Gauss points between the poles and equal angles around them. The mean of a polynomial of degree
    2 n_rings - 1 is exact.
    """
    heights, shares = legendre.leggauss(n_rings)
    angles = (np.arange(2 * n_rings) + 0.5) * np.pi / n_rings
    radii = np.sqrt(1.0 - heights**2)
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.empty((n_rings, 2 * n_rings, 3))
    points[:, :, :2] = radii[:, None, None] * around
    points[:, :, 2] = heights[:, None]
    return points.reshape(-1, 3), np.repeat(shares / 2, 2 * n_rings) / (2 * n_rings)


def interval_rule(n: int) -> tuple[Array, Array]:
    """Return n points in (0, 1], the last of which is 1, and their weights, whose sum is 1.

    This is the rule of Gauss and Radau: the mean of a polynomial of degree 2n - 2 is exact.
    """
    difference = np.zeros(n + 1)
    difference[n - 1 :] = 1.0, -1.0  # Pₙ₋₁ - Pₙ vanishes at the points
    points = np.sort(legendre.legroots(difference).real)
    points[-1] = 1.0
    means = np.zeros(n)
    means[0] = 1.0
    weights = np.linalg.solve(legendre.legvander(points, n - 1).T, means)
    return (points + 1.0) / 2.0, np.asarray(weights, dtype=np.float64)


def load_grid(scene: Scene, n_rings: int, n_magnitudes: int) -> LoadGrid:
    """Return the grid of a scene's single loads, up to its largest magnitude."""
    directions, shares = sphere_rule(n_rings)
    sizes, parts = interval_rule(n_magnitudes)
    on_patches = patch_forces(scene)
    forces = on_patches.reshape(3, -1, on_patches.shape[1]).transpose(1, 0, 2)
    largest = largest_of(scene.generated.load_plan.magnitude)
    return LoadGrid(
        np.ascontiguousarray(forces), directions, largest * sizes, shares[:, None] * parts
    )
