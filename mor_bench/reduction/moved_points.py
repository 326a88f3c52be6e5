"""Cubature with few points that may stand anywhere in the cells of an H8 mesh.

A cubature that chooses among quadrature points needs as many points as equations. A point that
moves has four unknowns, its weight and its position, and so serves up to four equations.

Source: Hernández, Bravo, Ares de Parga: CECM: a continuous empirical cubature method with
application to the dimensional hyperreduction of parameterized finite element models, CMAME 418
(2024). As there, points leave one by one while the others move, within and between cells, until the
integrals are good again. Two things differ. The integrals are those of all reduced forces to a
tolerance, as in ECSW, in place of exact integrals of a truncated basis. So the least-squares
problem is overdetermined, and Levenberg and Marquardt's damping replaces steps of minimum norm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from mor_bench.mechanics.elements import GAUSS
from mor_bench.reduction.empirical_cubature import cell_basis
from mor_bench.scene.interpolation import reference_positions, trilinear
from mor_bench.scene.mesh import FACES, Mesh

Array = NDArray[np.float64]
Integrands = Callable[[NDArray[np.int64], Array], Array]
"""Maps cells (n,) and positions (n, 3) to integrands times det J, (n, n_rows)."""

SAMPLED_CELLS = 200
"""Cells, spread evenly, whose quadrature points span the directions of the integrands."""
LEFT_OUT = 0.1
"""Part of the integrands outside these directions, relative to the tolerance."""
MARGIN = 0.95
"""Residual that the moves aim at, relative to the tolerance; the rest covers interpolation."""
LONGEST_STEP = 0.5
"""Longest move along an axis of a cell in one step; a cell has length 2."""
LEAST_SHARE = 0.05
"""Least share of its weight that a point keeps in one step, and of the squared tolerance in use."""
MAX_STEPS = 30
"""Steps of one least-squares fit."""
DAMPINGS = 8
"""Dampings tried for one step."""
CORRECTIONS = 4
"""Fits of one rule, each with the error of interpolation of the one before."""
PATIENCE = 6
"""Steps after which a fit ends that would not reach its aim at its present rate."""
SAMPLED_AT_ONCE = 32
"""Cells sampled together; bounds the memory."""
CANDIDATES = 6
"""Points tried one after another; if none of them can go, no point goes."""


@dataclass(frozen=True)
class PointRule:
    """Points of a cubature.

    Attributes
    ----------
    cells : (n,) int64
        The cell of each point; a cell may hold several.
    positions : (n, 3) float64
        Reference coordinates in the cell, in [-1, 1].
    weights : (n,) float64
        Positive; they multiply det J.
    """

    cells: NDArray[np.int64]
    positions: Array
    weights: Array

    def __len__(self) -> int:
        return len(self.cells)

    def without(self, points: NDArray[np.int64]) -> PointRule:
        """Return the rule without some of its points."""
        kept = np.ones(len(self), dtype=bool)
        kept[points] = False
        return PointRule(self.cells[kept], self.positions[kept], self.weights[kept])

    def integrate(self, integrands: Integrands) -> Array:
        """Return the integrals, (n_rows,)."""
        return np.asarray(self.weights @ integrands(self.cells, self.positions))


class _Interpolant:
    """Integrands on a few directions (n_rows, k): sampled in a cell when a point first comes there.

    A quadratic function of each coordinate interpolates 27 samples of a cell.
    """

    def __init__(self, integrands: Integrands, directions: Array) -> None:
        self._integrands, self._directions = integrands, directions
        self._samples: dict[int, Array] = {}
        axis = np.array([-1.0, 0.0, 1.0])
        self._nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)

    def _sample(self, cells: NDArray[np.int64]) -> None:
        for start in range(0, len(cells), SAMPLED_AT_ONCE):
            some = cells[start : start + SAMPLED_AT_ONCE]
            positions = np.tile(self._nodes, (len(some), 1))
            found = self._integrands(np.repeat(some, len(self._nodes)), positions)
            samples = (found @ self._directions).reshape(len(some), len(self._nodes), -1)
            self._samples.update(zip(some.tolist(), samples, strict=True))

    def __call__(self, cells: NDArray[np.int64], positions: Array) -> Array:
        """Return the integrands and their derivatives by the positions, (n, 4, k)."""
        self._sample(np.array([c for c in np.unique(cells) if int(c) not in self._samples]))
        x = positions
        values = np.stack([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2], axis=2)
        slopes = np.stack([x - 0.5, -2 * x, x + 0.5], axis=2)
        factors = np.empty((len(x), 4, len(self._nodes)))
        for row in range(4):
            own = [slopes[:, i] if row == i + 1 else values[:, i] for i in range(3)]
            factors[:, row] = np.einsum("pa,pb,pc->pabc", *own).reshape(len(x), -1)
        samples = np.stack([self._samples[int(c)] for c in cells])
        return np.asarray(np.matmul(factors, samples))


class _Cells:
    """The cells of an H8 mesh and their neighbours across faces."""

    def __init__(self, mesh: Mesh) -> None:
        self._corners = mesh.points[mesh.cells]
        faces = np.sort(mesh.cells[:, FACES[8]].reshape(-1, 4), axis=1)
        key = np.unique(faces, axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(key, kind="stable")
        shared = np.flatnonzero(key[order][1:] == key[order][:-1])
        one, other = order[shared], order[shared + 1]
        across = np.full(len(faces), -1)
        across[one], across[other] = other // 6, one // 6
        self._across = across.reshape(-1, 3, 2)  # of axis and side, as in `FACES`

    def on_surface(self, rule: PointRule) -> NDArray[np.bool_]:
        """Return where a point touches the surface of the body along an axis, (n, 3)."""
        side = (rule.positions > 0).astype(int)
        beyond = self._across[rule.cells[:, None], np.arange(3), side]
        return np.asarray((np.abs(rule.positions) >= 1) & (beyond < 0))

    def moved(self, rule: PointRule, step: Array, cross: bool) -> PointRule:
        """Return a rule after a step (n, 4): relative weights, and positions.

        A point that leaves its cell goes to the next one or, without ``cross``, stops at the face.
        """
        steps = np.clip(step[:, 1:], -LONGEST_STEP, LONGEST_STEP)
        cells, positions = rule.cells.copy(), rule.positions + steps
        rows, axis = np.arange(len(rule)), np.abs(positions).argmax(axis=1)
        farthest = positions[rows, axis]
        into = self._across[cells, axis, (farthest > 0).astype(int)]
        going = np.flatnonzero((np.abs(farthest) > 1) & (into >= 0) & cross)
        shape = trilinear(positions[going])[0]
        points = np.einsum("na,nai->ni", shape, self._corners[cells[going]])
        cells[going] = into[going]
        positions[going] = reference_positions(self._corners[into[going]], points)
        weights = rule.weights + rule.weights.mean() * step[:, 0]
        return PointRule(
            cells, np.clip(positions, -1.0, 1.0), np.maximum(weights, LEAST_SHARE * rule.weights)
        )


class _Fit:
    """Least squares of integrals over weights and positions.

    Parameters
    ----------
    mesh : Mesh
    integrands : callable
    target : (n_rows,) float64
    directions : (n_rows, k) float64
        Orthonormal; the fit sees the integrands along these only.
    """

    def __init__(
        self, mesh: Mesh, integrands: Integrands, target: Array, directions: Array
    ) -> None:
        self._cells, self._at = _Cells(mesh), _Interpolant(integrands, directions)
        self._integrands, self._target, self._directions = integrands, target, directions
        self._interpolated = target @ directions  # the target less the error of interpolation
        self._outside = 0.0  # the error outside of the directions

    def __call__(self, rule: PointRule, tolerance: float) -> PointRule | None:
        """Return a rule whose integrals meet the tolerance, or None if none is found.

        Each fit of interpolated integrands ends with the exact ones. Their difference, nearly the
        same from one rule to the next, corrects the target and the residual that is aimed at.
        """
        enough = tolerance * float(np.linalg.norm(self._target))
        for _ in range(CORRECTIONS):
            share = np.sqrt(max(1 - (self._outside / enough) ** 2, LEAST_SHARE))
            found = self._fitted(rule, MARGIN * share * enough)
            if found is None:
                return None
            rule, error = found, self._target - found.integrate(self._integrands)
            if np.linalg.norm(error) <= enough:
                return rule
            seen = error @ self._directions
            self._outside = float(np.linalg.norm(error - self._directions @ seen))
            self._interpolated = rule.weights @ self._at(rule.cells, rule.positions)[:, 0] + seen
        return None

    def _slopes(self, rule: PointRule, found: Array) -> Array:
        """Return derivatives of the integrals by relative weights and positions, (4 n, k)."""
        slopes = found * rule.weights[:, None, None]
        slopes[:, 0] = rule.weights.mean() * found[:, 0]
        return np.asarray(slopes.reshape(4 * len(rule), -1))

    def losses(self, rule: PointRule) -> Array:
        """Return the squared residual that each point's removal adds, to first order, (n,).

        The other unknowns of all points adjust (Hassibi & Stork 1993: optimal brain surgeon).
        """
        slopes = self._slopes(rule, self._at(rule.cells, rule.positions))
        normal = slopes @ slopes.T
        normal[np.diag_indices(len(normal))] += 1e-6 * np.diag(normal) + 1e-14 * normal.max()
        inverse = np.diag(np.linalg.inv(normal))[::4]
        return np.asarray((rule.weights / rule.weights.mean()) ** 2 / inverse)

    def _fitted(self, rule: PointRule, enough: float) -> PointRule | None:
        """Return a rule with an interpolated residual of at most ``enough``, or None."""
        found = self._at(rule.cells, rule.positions)
        residual, damping = rule.weights @ found[:, 0] - self._interpolated, 1e-4
        for step in range(MAX_STEPS):
            size = float(np.linalg.norm(residual))
            if size <= enough:
                return rule
            trial = self._step(rule, found, residual, damping)
            if trial is None:
                return None
            rule, found, damping = trial
            residual = rule.weights @ found[:, 0] - self._interpolated
            left, gain = MAX_STEPS - step, size / float(np.linalg.norm(residual))
            if step >= PATIENCE and gain**left < size / enough:
                return None
        return None

    def _step(
        self, rule: PointRule, found: Array, residual: Array, damping: float
    ) -> tuple[PointRule, Array, float] | None:
        """Return a rule with a smaller residual, its integrands and the next damping; or None.

        The integrands jump between cells, so every other attempt stops points at the faces.
        """
        slopes = self._slopes(rule, found)
        gradient, normal = slopes @ residual, slopes @ slopes.T
        outwards = rule.positions * gradient.reshape(-1, 4)[:, 1:] < 0
        held = np.zeros((len(rule), 4), dtype=bool)
        held[:, 1:] = self._cells.on_surface(rule) & outwards
        free, size = np.flatnonzero(~held.ravel()), float(np.linalg.norm(residual))
        normal, diagonal = normal[np.ix_(free, free)], np.diag(normal)[free].copy()
        for attempt in range(DAMPINGS):
            np.fill_diagonal(normal, diagonal * (1 + damping) + 1e-12 * diagonal.max())
            step = np.zeros(4 * len(rule))
            try:
                step[free] = -cho_solve(cho_factor(normal, check_finite=False), gradient[free])
            except LinAlgError:
                damping *= 10
                continue
            trial = self._cells.moved(rule, step.reshape(-1, 4), cross=attempt % 2 == 0)
            new = self._at(trial.cells, trial.positions)
            left = np.linalg.norm(trial.weights @ new[:, 0] - self._interpolated)
            if left < (1 - 1e-4) * size:
                return trial, new, max(damping / 8, 1e-12)
            damping *= 4
        return None


def move_points(
    mesh: Mesh, integrands: Integrands, target: Array, start: PointRule, tolerance: float
) -> PointRule:
    """Remove points while the others move, as long as the integrals meet the tolerance.

    Parameters
    ----------
    mesh : Mesh
        Of H8 cells.
    integrands : callable
        Values at any positions, for example reduced forces of several states.
    target : (n_rows,) float64
    start : PointRule
        Meets the tolerance.
    tolerance : float
        Largest norm of the error of the integrals, relative to that of the target.

    Returns
    -------
    PointRule
        It meets the tolerance with the integrands themselves.
    """
    fit = _Fit(mesh, integrands, target, _directions(mesh, integrands, start, tolerance))
    rule, batch = start, max(1, len(start) // 8)
    while len(rule) > 1:
        batch = min(batch, len(rule) // 2)
        order = np.argsort(fit.losses(rule), kind="stable")
        tries = 1 if batch > 1 else min(CANDIDATES, len(rule))
        shorter = (rule.without(order[i : i + batch]) for i in range(tries))
        found = next(filter(None, (fit(candidate, tolerance) for candidate in shorter)), None)
        if found is not None:
            rule = found
        elif batch == 1:
            break
        else:
            batch //= 2
    return rule


def _directions(mesh: Mesh, integrands: Integrands, start: PointRule, tolerance: float) -> Array:
    """Return orthonormal directions (n_rows, k) that hold nearly all of the integrands."""
    spread = np.linspace(0, len(mesh.cells) - 1, min(SAMPLED_CELLS, len(mesh.cells))).astype(int)
    cells = np.union1d(spread, start.cells)
    found = integrands(np.repeat(cells, len(GAUSS)), np.tile(GAUSS, (len(cells), 1)))
    return cell_basis(found, LEFT_OUT * tolerance)
