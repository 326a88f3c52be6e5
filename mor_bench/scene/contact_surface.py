"""Rigid instruments, and the surface that one may touch, as points with penalty stiffnesses.

The contact energy is Π = ½ ∫ k ⟨-g⟩² dA over the undeformed surface: g is the gap between the
deformed surface and the instrument, ⟨x⟩ = max(x, 0), and k the penalty stiffness. The Gauss points
of the facets integrate it: uniform pressures exactly, and the force changes smoothly where the edge
of the contact crosses a facet. With points at the nodes alone, the force of a small instrument
would jump from node to node.

The penetration is the traction over k. By default k = `STIFFER` E / h, with Young's modulus E at
rest and the mean size h of the facets.

Wriggers: Computational Contact Mechanics, 2nd edition (2006), sections 6.3.2 and 9.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.loads import Facets
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.springs import surface_quadrature
from mor_bench.specs import AXES, Contact, PlaneInstrument

Array = NDArray[np.float64]

STIFFER = 1000.0
"""Default penalty stiffness, in Young's moduli per mean size of a facet. A traction of a tenth of
Young's modulus then penetrates by a ten-thousandth of a facet."""

ROUND_OFF = 1e-9
"""Penetration at rest, relative to the size of the touched region, that counts as round-off."""

LEAST_RADIUS = 0.5
"""Least radius of a sphere, in mean sizes of a facet. A smaller one slips between the points."""

MAX_STEP = 0.5
"""Largest step of a sphere, in radii. The surface must never get past its centre."""


class Instrument(Protocol):
    """A rigid body at its place at rest."""

    @property
    def longest_step_m(self) -> float:
        """Largest step in which it may be moved against a surface, m."""
        ...

    def gaps(self, points: Array) -> tuple[Array, Array, Array]:
        """Return distances (n,) of points (n, 3), m, negative inside; their gradients; curvatures.

        The gradients (n, 3) are unit normals out of the instrument. The curvatures (n,), 1/m, are
        those of the level surfaces of the distance.
        """
        ...


@dataclass(frozen=True)
class Ball:
    """A rigid sphere with a centre (3,) and a radius, m."""

    centre: Array
    radius: float

    @property
    def longest_step_m(self) -> float:
        return MAX_STEP * self.radius

    def gaps(self, points: Array) -> tuple[Array, Array, Array]:
        away = points - self.centre
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12 * self.radius)
        return distance - self.radius, away / distance[:, None], 1.0 / distance


@dataclass(frozen=True)
class HalfSpace:
    """A rigid body behind a plane: a point (3,) of it, m, and its unit normal (3,)."""

    point: Array
    normal: Array
    longest_step_m: float = np.inf

    def gaps(self, points: Array) -> tuple[Array, Array, Array]:
        gap = (points - self.point) @ self.normal
        return gap, np.broadcast_to(self.normal, points.shape), np.zeros(len(points))


def unit(direction: Sequence[float]) -> Array:
    """Return a direction (3,) of length 1."""
    vector = np.array(direction, dtype=np.float64)
    vector /= np.abs(vector).max()  # the square of a large one overflows
    return np.asarray(vector / np.linalg.norm(vector))


def instrument_of(plan: Contact) -> Instrument:
    """Return the instrument of a plan."""
    described = plan.instrument
    if isinstance(described, PlaneInstrument):
        return HalfSpace(np.array(described.plane.point_m), unit(described.plane.normal))
    return Ball(np.array(described.sphere.centre_m), described.sphere.radius_m)


@dataclass(frozen=True)
class ContactSurface:
    """The points at which an instrument may touch a body, with their stiffnesses.

    Attributes
    ----------
    instrument : Instrument
    points : (n, 3) float64
        Positions at rest, m.
    values : (n, n_nodes) sparse float64
        Shape functions of the mesh at the points.
    stiffness : (n,) float64
        Penalty stiffness times area, N/m.
    penalty_n_m3 : float
        The penalty stiffness, N/m³.
    axis : (3,) float64
        Unit vector in the middle of the instrument's motions.
    deepest_m : float
        Depth of a node in the instrument that no contact explains, m: the size of a facet. Nodes
        outside a smooth surface may be as far again from it.
    """

    instrument: Instrument
    points: Array
    values: sp.csr_array
    stiffness: Array
    penalty_n_m3: float
    axis: Array
    deepest_m: float

    @property
    def gaps_at_rest(self) -> Array:
        """(n,) gaps between the points and the instrument at rest, m."""
        return self.instrument.gaps(self.points)[0]

    @property
    def nearest(self) -> Array:
        """The point (3,) nearest to the instrument at rest, m."""
        return np.asarray(self.points[self.gaps_at_rest.argmin()])

    @property
    def nodes(self) -> NDArray[np.int64]:
        """Nodes of the mesh that move the points, (n_touched,), sorted."""
        return np.unique(self.values.indices).astype(np.int64)


def contact_surface(
    plan: Contact,
    surface: Facets,
    facets: NDArray[np.int64],
    mesh: Mesh,
    young_pa: float,
) -> ContactSurface:
    """Return the points of facets (n_facets, 4 or 3) of a surface that an instrument may touch.

    Parameters
    ----------
    plan : Contact
    surface : Facets
        The mesh's boundary, or a smooth surface embedded in the mesh.
    facets : (n_facets, 4 or 3) int64
    mesh : Mesh
    young_pa : float
        Young's modulus at rest, for the default penalty stiffness.

    Raises
    ------
    SpecError
        If there is no facet; or for every problem of the instrument: it penetrates the facets at
        rest, no motion reaches them, or it is much smaller than they are.
    """
    if len(facets) == 0:
        raise SpecError(
            "`loads.region` holds nodes but no facet of the surface, so no instrument can touch it."
        )
    points, vectors, shapes = surface_quadrature(surface, facets)
    areas = np.linalg.norm(vectors, axis=1)
    instrument = instrument_of(plan)
    size = float(np.sqrt(areas.sum() / len(facets)))
    problems = [
        *_misplaced(
            plan, instrument, np.concatenate([points, surface.points[facets].reshape(-1, 3)])
        ),
        *_too_small(instrument, size),
    ]
    if problems:
        raise SpecError(" ".join(problems))
    penalty = plan.penalty_n_m3 or STIFFER * young_pa / size
    if surface.points is mesh.points:
        rows = np.repeat(np.arange(len(points)), shapes.shape[1])
        columns = np.repeat(facets, len(shapes), axis=0).ravel()
        at = rows, columns
        entries = np.tile(shapes, (len(facets), 1)).ravel()
        values = sp.csr_array((entries, at), shape=(len(points), mesh.n_nodes))
    else:
        values = interpolation_matrix(mesh, points)
    axis = unit(plan.direction or (-vectors[instrument.gaps(points)[0].argmin()]).tolist())
    deepest = size if surface.points is mesh.points else 2.0 * size
    return ContactSurface(
        instrument, points, values, penalty * areas, float(penalty), axis, deepest
    )


def _misplaced(plan: Contact, instrument: Instrument, points: Array) -> list[str]:
    """Return what is wrong with the place of an instrument near points (n, 3), m."""
    nearest, farthest = float(instrument.gaps(points)[0].min()), plan.magnitude_m[1]
    if nearest < -ROUND_OFF * float(np.ptp(points, axis=0).max()):
        return [
            "`loads.instrument` must not penetrate `loads.region` at rest; it does, by "
            f"{-nearest:.6g} m. Move it back by at least as much."
        ]
    if nearest >= farthest:
        return [
            f"`loads.magnitude_m` must reach `loads.region`: the instrument is {nearest:.6g} m "
            f"away from it and moves by at most {farthest:g} m."
        ]
    return []


def _too_small(instrument: Instrument, size: float) -> list[str]:
    """Return whether a ball is too small for facets of a mean size, m."""
    if isinstance(instrument, Ball) and instrument.radius < LEAST_RADIUS * size:
        return [
            f"`loads.instrument.sphere.radius_m` must be at least {LEAST_RADIUS * size:.6g}, "
            f"{LEAST_RADIUS:g} mean sizes of a facet of `loads.region`, or the mesh finer; "
            f"got {instrument.radius:g}."
        ]
    return []


def touched_nodes(
    plan: Contact, surface: ContactSurface, fixed_dofs: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the nodes that an instrument may touch and that are free to move, sorted.

    Raises
    ------
    SpecError
        If the instrument moves along a component that the supports hold at all of them.
    """
    nodes = surface.nodes
    free = ~np.isin(3 * nodes[:, None] + np.arange(3), fixed_dofs)
    axis, spread = surface.axis, np.deg2rad(min(plan.spread_deg, 90.0))
    most = np.abs(axis) * np.cos(spread) + np.sqrt(np.maximum(1 - axis**2, 0)) * np.sin(spread)
    held = [AXES[i] for i in range(3) if not free[:, i].any() and most[i] > ROUND_OFF]
    if held:
        raise SpecError(
            f"the instrument moves along {' and '.join(held)}, but the supports hold this "
            "component at every node of `loads.region`; choose another `loads.direction` or a "
            "smaller `loads.spread_deg`."
        )
    return nodes[free.any(axis=1)]
