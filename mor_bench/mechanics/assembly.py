"""Assembly of the internal force and the tangent stiffness of a set of cells."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.counting import count, is_counting
from mor_bench.mechanics import inversion
from mor_bench.mechanics.discretisation import (
    Discretisation,
    distinct,
    law_parameters,
    quadrature_of,
)
from mor_bench.mechanics.elements import H8, T4, is_straight, shape_gradients
from mor_bench.mechanics.kernels import (
    ADVANCE_MULTIPLY_ADDS,
    FORCE_MULTIPLY_ADDS,
    LANES,
    RUNNING,
    TANGENT_MULTIPLY_ADDS,
    advance,
    internal_force,
    internal_force_and_tangent,
    relax,
)
from mor_bench.mechanics.laws import general_force, general_multiply_adds
from mor_bench.mechanics.pattern import build_pattern
from mor_bench.mechanics.pressed_facets import ConstantFollowers
from mor_bench.mechanics.slabs import Slabs, slabs_of
from mor_bench.mechanics.surface_springs import SurfaceSprings
from mor_bench.mechanics.turned import TurnedDofs
from mor_bench.scene.materials import SaintVenantKirchhoff
from mor_bench.scene.supports import Frames

Array = NDArray[np.float64]

Batches = tuple[Array, Array, Array, NDArray[np.uint32]]
"""Gradients, two arrays of the kernel of the law, and slots of batches of cells."""

PARALLEL_FROM = 512
"""Batches of cells from which they are summed in slabs."""


@dataclass(frozen=True)
class State:
    """Internal force, N, stored energy, J, and the smallest det F over all quadrature points."""

    force: NDArray[np.float64]
    energy_j: float
    min_det_f: float


def _batched(values: NDArray[Any], fill: float) -> NDArray[Any]:
    """Rearrange (n_cells, ...) to (n_batches, ..., LANES), padded with ``fill``."""
    n_batches = -(-len(values) // LANES)
    padded = np.full((n_batches * LANES, *values.shape[1:]), fill, dtype=values.dtype)
    padded[: len(values)] = values
    return np.ascontiguousarray(
        np.moveaxis(padded.reshape(n_batches, LANES, *values.shape[1:]), 1, -1)
    )


def _triples(
    dof_of_node: NDArray[np.int64], n: int
) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Return where each node's three displacements start in the vectors of the kernels.

    These vectors end in three zeros, for fixed nodes. Then follow copies of the entries of nodes
    whose dofs are not neighbours, as where only some components are fixed; also return their dofs.
    """
    starts = dof_of_node[:, 0].copy()
    fixed = (dof_of_node == n).all(axis=1)
    copied = ~fixed & (np.diff(dof_of_node, axis=1) != 1).any(axis=1)
    starts[copied] = n + 3 + 3 * np.arange(copied.sum())
    return starts.astype(np.uint32), dof_of_node[copied].ravel()


class Assembler:
    """Internal force and tangent of a set of cells over chosen dofs.

    Parameters
    ----------
    body : Discretisation
    dof_of_node : (n_nodes, 3) int
        Row of each nodal displacement component in the vectors; ``n_dofs`` at supports.
    n_dofs : int
        Length of the vectors.
    cell_weights : (n_cells,) float64, optional
        Cubature weights that multiply each cell's energy; 1 by default.
    frames : Frames, optional
        Axes of the nodes whose vectors are not along x, y and z.

    Attributes
    ----------
    pattern : Pattern
        Pattern of the tangent.
    turned : TurnedDofs or None
        The dofs along x, y and z over which cells are summed, if some nodes have frames.
    summed_pattern : Pattern
        Pattern of the sum over cells, before `turned` reduces it.

    Raises
    ------
    InvalidInputError
        If a cell is inverted or degenerate, or no element has its number of nodes.
    """

    def __init__(
        self,
        body: Discretisation,
        dof_of_node: NDArray[np.int64],
        n_dofs: int,
        cell_weights: Array | None = None,
        frames: Frames | None = None,
    ) -> None:
        quadrature = quadrature_of(body)  # checks the cells
        self.pattern, slots = build_pattern(dof_of_node, body.cells, n_dofs)
        self.n_dofs = n_dofs
        # The kernels sum over dofs along x, y and z, which nodes with frames have beside their own.
        self.turned: TurnedDofs | None = None
        self.summed_pattern, self._n_summed = self.pattern, n_dofs
        own, self._cells = dof_of_node, body.cells
        if frames is not None:
            self.turned = TurnedDofs(frames, dof_of_node, n_dofs)
            dof_of_node, self._n_summed = self.turned.dof_of_node, self.turned.n
            self.summed_pattern, slots = build_pattern(dof_of_node, body.cells, self._n_summed)
            self.turned.of_patterns(self.summed_pattern, self.pattern)
        self.n_cells = len(body.cells)
        self._n_values = len(self.summed_pattern.indices) + 1
        self._dof_of_node, self._own, self._frames = dof_of_node, own, frames
        starts, self._copied = _triples(dof_of_node, self._n_summed)
        self._n_padded = self._n_summed + 3 + len(self._copied)
        self._dofs = _batched(starts[body.cells], self._n_summed)
        self._slots = _batched(slots.astype(np.uint32), len(self.summed_pattern.indices))
        self._slabs: Slabs | None = None
        if len(self._dofs) >= PARALLEL_FROM:
            self._slabs = slabs_of(len(self._dofs), self._touched)
        self._is_straight = is_straight(body.points, body.cells)
        gradients = quadrature.gradients
        if self._is_straight:
            corners = body.cells[:, : T4.n_nodes]
            gradients = shape_gradients(body.points, corners, T4.derivatives)[0][:, :, 1:]
        batches = _batched(distinct(gradients, LANES), 0.0)
        self._gradients = batches.reshape(*batches.shape[:2], -1)
        self._rule = quadrature.weights
        if cell_weights is not None:
            self._rule = quadrature.weights * cell_weights[:, None]
        self._take(body)

    def scaled(self, body: Discretisation, scale: Array) -> Assembler:
        """Return an assembler of the same cells with another material, scaled along the axes.

        Parameters
        ----------
        body : Discretisation
            The same cells with the material, the springs, the rest state and the scaled positions.
        scale : (3,) float64
        """
        found = copy(self)
        if (scale != 1.0).any():
            n_batches, n_points, _ = self._gradients.shape
            by_axis = self._gradients.reshape(n_batches, n_points, -1, 3, LANES) / scale[:, None]
            found._gradients = by_axis.reshape(self._gradients.shape)
            found._rule = self._rule * float(np.prod(scale))
        found._take(body)
        return found

    def _take(self, body: Discretisation) -> None:
        """Compute what depends on the material, the springs and the rest state."""
        material, weights, parameters = body.material, self._rule, law_parameters(body)
        (n_cells, n_nodes), n_points = body.cells.shape, weights.shape[1]
        self.extent_m = float(np.ptp(body.points, axis=0).max())
        self.material = material
        self._has_own_kernel = isinstance(material, SaintVenantKirchhoff) and n_nodes == H8.n_nodes
        if self._has_own_kernel:
            self._w_lam = _batched(weights * parameters[:, 0], 0.0)
            self._w_mu = _batched(weights * parameters[:, 1], 0.0)
            by_force = n_points * FORCE_MULTIPLY_ADDS
            per_cell = by_force, by_force + n_points * TANGENT_MULTIPLY_ADDS
        else:
            self._kernel = general_force(material.law, n_nodes, self._is_straight)
            self._weights = _batched(weights, 0.0)
            self._parameters = np.repeat(parameters, LANES, axis=1)
            shape = n_nodes, n_points, self._is_straight
            per_cell = general_multiply_adds(material.law, parameters.shape[1], *shape)
        self._batches = self._chosen(slice(None))
        self._multiply_adds = n_cells * per_cell[0], n_cells * per_cell[1]
        self._plain = (
            body.springs is None
            and body.rest is None
            and not body.followers
            and self._frames is None
            and not len(self._copied)
        )
        self._springs: SurfaceSprings | None = None
        own = self._dof_of_node
        if body.springs is not None:
            self._springs = SurfaceSprings(body.springs, own.ravel(), self.summed_pattern)
        self._followers: ConstantFollowers | None = None
        if body.followers:
            where = body.points, body.followers, own
            self._followers = ConstantFollowers(*where, self.summed_pattern)
        self._rest: tuple[Array, Array] | None = None
        if body.rest is not None:
            frames = self._frames
            rest = np.zeros(self.n_dofs + 1)
            rest[self._own] = body.rest
            if frames is not None:
                rest[self._own] = frames.to_local(body.rest.ravel()).reshape(-1, 3)
            self._rest = self._total(rest[:-1]), self.force(rest[:-1]).force
            if self._followers is not None:
                self._followers.begin_at(self._rest[0][: self._n_summed])

    def _total(self, u: Array) -> Array:
        """Return total displacements along x, y and z, as the kernels read them."""
        padded = np.zeros(self._n_padded)
        padded[: self._n_summed] = u if self.turned is None else self.turned.spread(u)
        self._copy(padded)
        return padded if self._rest is None else padded + self._rest[0]

    def _copy(self, padded: Array) -> None:
        """Copy displacements to where the kernels read them."""
        if len(self._copied):
            padded[self._n_summed + 3 :] = padded[self._copied]

    def _collect(self, force: Array) -> None:
        """Move forces at copies of displacements to their own dofs."""
        if len(self._copied):
            force[self._copied] += force[self._n_summed + 3 :]
        force[self._n_summed :] = 0.0

    def _from_rest(self, u: Array, force: Array, energy: float, min_det_f: float) -> State:
        """Return the state without the force of the pre-load, whose work is stored energy."""
        if self._rest is None:
            return State(force, energy, min_det_f)
        held = self._rest[1]
        return State(force - held, energy - float(held @ u), min_det_f)

    def _sum(
        self, u: Array, dofs: NDArray[np.uint32], force: Array, values: Array
    ) -> tuple[float, float]:
        """Add forces and, where ``values`` is not empty, tangents; return energy and min det F."""
        if is_counting():
            work = self._multiply_adds[len(values) > 0]
            count(element_evaluations=self.n_cells, multiply_adds=work)
        if self._slabs is None:
            return self._sum_of(u, dofs, self._batches, force, values)

        def sum_of(first: int, last: int) -> tuple[float, float]:
            chosen = slice(first, last)
            return self._sum_of(u, dofs[chosen], self._chosen(chosen), force, values)

        energies, min_dets = zip(*self._slabs.run(sum_of), strict=True)
        return sum(energies), min(min_dets)

    @property
    def in_slabs(self) -> bool:
        """Whether cells are summed in slabs, on as many threads as kernels may use."""
        return self._slabs is not None

    def _chosen(self, chosen: slice) -> Batches:
        """Return the data of some batches of cells."""
        gradients = self._gradients
        if len(gradients) == len(self._dofs):
            gradients = gradients[chosen]
        elif (chosen.start or 0) % len(gradients):  # a few batches serve all, in turn
            gradients = np.roll(gradients, -chosen.start, axis=0)
        if self._has_own_kernel:
            return gradients, self._w_lam[chosen], self._w_mu[chosen], self._slots[chosen]
        return gradients, self._weights[chosen], self._parameters, self._slots[chosen]

    def _sum_of(
        self, u: Array, dofs: NDArray[np.uint32], batches: Batches, force: Array, values: Array
    ) -> tuple[float, float]:
        """Add forces and tangents of batches of cells; return energy and min det F."""
        gradients, second, third, slots = batches
        cells = gradients, second, third
        out: tuple[float, float]
        if not self._has_own_kernel:
            tangent = (slots, force, values) if len(values) else (None, force, None)
            out = self._kernel(u, dofs, *cells, *tangent)
        elif len(values) == 0:
            out = internal_force(u, dofs, *cells, force)
        else:
            out = internal_force_and_tangent(u, dofs, *cells, slots, force, values)
        return out

    def _touched(self, first: int, last: int) -> NDArray[np.uint32]:
        """Return the first dofs of the nodes of some batches of cells."""
        dofs = self._dofs[first:last]
        return np.asarray(dofs[dofs != self._n_summed])

    def _sum_all(self, total: Array, force: Array, values: Array) -> tuple[float, float]:
        """Add forces and tangents of cells, springs and followers; return energy and min det F."""
        energy, min_det_f = self._sum(total, self._dofs, force, values)
        self._collect(force)
        moved = total[: self._n_summed]
        if self._springs is not None:
            energy += self._springs.add(moved, force, values)
        if self._followers is not None:
            energy += self._followers.add(moved, force, values)
        return energy, min_det_f

    @property
    def force_at_rest(self) -> Array:
        """The internal force (n_dofs,), N, of the rest state; zero without any."""
        return np.zeros(self.n_dofs) if self._rest is None else self._rest[1]

    def skew_tangent(self, u: Array) -> sp.csr_array | None:
        """Return the skew part of the tangent, N/m, of followers; None without any."""
        if self._followers is None:
            return None
        skew = self._followers.skew_stiffness(self._total(u)[: self._n_summed])
        return skew if self.turned is None else self.turned.matrix(skew)

    def force(self, u: Array) -> State:
        """Return the state at displacements ``u`` (n_dofs,), m."""
        force = np.zeros(self._n_padded)
        if self._plain:  # four calls fewer
            padded = np.zeros(self._n_padded)
            padded[: self.n_dofs] = u
            return State(force[: self.n_dofs], *self._sum(padded, self._dofs, force, np.zeros(0)))
        found = self._sum_all(self._total(u), force, np.zeros(0))
        return self._from_rest(u, self._at_unknowns(force), *found)

    def least_det_f(self, u: Array) -> float:
        """Return the smallest det F at displacements ``u`` (n_dofs,), m."""
        if self._dofs.shape[1] != H8.n_nodes:
            return self.force(u).min_det_f
        work = self.n_cells * self._gradients.shape[1] * inversion.MULTIPLY_ADDS
        count(element_evaluations=self.n_cells, multiply_adds=work)
        return float(inversion.least_det_f(self._total(u), self._dofs, self._gradients))

    def _at_unknowns(self, force: Array) -> Array:
        """Return the forces at the unknowns, of forces in a vector of the kernels."""
        own = force[: self._n_summed]
        return own if self.turned is None else self.turned.gather(own)

    def force_and_tangent(self, u: Array) -> tuple[State, Array]:
        """Return the state and the values of the tangent stiffness, N/m, in ``pattern``."""
        force, values = np.zeros(self._n_padded), np.zeros(self._n_values)
        found = self._sum_all(self._total(u), force, values)
        state = self._from_rest(u, self._at_unknowns(force), *found)
        return state, values[:-1] if self.turned is None else self.turned.tangent(values[:-1])

    def cell_forces(self, u: Array) -> Array:
        """Return each cell's own internal force, (n_cells, 3 n_nodes), N, to train cubatures.

        The components are along the axes of the nodes' frames.
        """
        own = self._cell_forces(self._total(u))
        if self._rest is not None:
            own = own - self._cell_forces(self._rest[0])
        forces = own.swapaxes(1, 2).reshape(-1, 3 * self._dofs.shape[1])[: self.n_cells]
        return forces if self.turned is None else self.turned.cell_forces(forces, self._cells)

    def _cell_forces(self, total: Array) -> Array:
        """Return forces (n_batches, n_nodes, LANES, 3) of total displacements."""
        local = 3 * np.arange(self._dofs.size, dtype=np.uint32).reshape(self._dofs.shape)
        force = np.zeros(3 * local.size)
        own = total[self._dofs[..., None] + np.arange(3)].ravel()
        self._sum(own, local, force, np.zeros(0))
        return force.reshape(*local.shape, 3)

    def relax(
        self, u: Array, load: Array, mass: Array, control: Array, n_steps: int
    ) -> tuple[int, int, float]:
        """Take steps of dynamic relaxation from u (n_dofs,), m, at rest; see `kernels.advance`.

        Frames of nodes are not known here. Overwrites ``u``. Returns the number of steps, how the
        last one ended, and min det F there.
        """
        padded, v, before = self._total(u), np.zeros(self.n_dofs), np.zeros(self.n_dofs)
        load = load if self._rest is None else load + self._rest[1]
        done, status, min_det = 0, RUNNING, np.inf
        none_else = self._springs is None and self._followers is None
        if self._has_own_kernel and none_else and not len(self._copied):
            cells = self._dofs, self._gradients, self._w_lam, self._w_mu
            done, status, min_det = relax(padded, v, before, load, mass, control, n_steps, *cells)
            count(
                element_evaluations=done * self.n_cells,
                multiply_adds=done * self._multiply_adds[0],
            )
        else:
            force, none = np.zeros(self._n_padded), np.zeros(0)
            while done < n_steps and status == RUNNING:
                self._copy(padded)
                min_det = self._sum_all(padded, force, none)[1]
                status = advance(padded, v, force, before, load, mass, control)
                done += 1
        count(multiply_adds=done * ADVANCE_MULTIPLY_ADDS * self.n_dofs)
        u[:] = (padded if self._rest is None else padded - self._rest[0])[: self.n_dofs]
        return done, status, min_det
