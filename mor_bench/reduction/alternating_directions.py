"""Progressive generalised decomposition of an equilibrium, by alternating directions.

One term X P D M is found after the other (Ammar, Mokdad, Chinesta, Keunings, Journal of
Non-Newtonian Fluid Mechanics 139 (2006) 153-176). Its factors solve the weak form,
linearised with the stiffness at rest K₀, in turn: with R the residual and ‖a‖² = ⟨ω a²⟩,

    K₀ X = ⟨ω P D M R⟩ / ‖P D M‖²,   P = ⟨ω D M Xᵀ R⟩ / (XᵀK₀X ‖D M‖²), and so on for D and M.

After each term, all functions X move together along a conjugate gradient of the potential energy Π
with the preconditioner K₀ (the update of Nouy, CMAME 199 (2010), section 3). A line search makes
sure that Π falls. As in the asymptotic series of Niroomandi and others (IJNME 96 (2013) 129-149),
one tangent serves every term.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from mor_bench.errors import OutOfTimeError
from mor_bench.reduction.weak_form import Balance, Term, WeakForm

Array = NDArray[np.float64]

ITERATIONS, STAGNANT = 12, 1e-2
"""Largest number of alternations of a term; relative gain below which they end."""

GUESSES = 3
"""Power iterations for the functions with which the alternation begins."""

EXHAUSTED = 1e-24
"""Gain of energy below which no term is left to find."""

DEPENDENT = 1e-12
"""Shift of the normalised Gram matrix of the terms, so that similar ones can be told apart."""

FLAT = 0.3
"""Slope at the end of a line search, relative to that at its start."""

TRIALS = 5
"""Largest number of steps that a line search tries."""

FINAL = 30
"""Largest number of updates after the last term."""

EVALUATIONS = 2.0
"""Evaluations of the weak form per term; a fit is refused if they would take too long."""


@dataclass(frozen=True)
class Separated:
    """A separated displacement and its weak form.

    Attributes
    ----------
    terms : tuple of Term
    vectors : (n_terms, n_free) float64
        X, m.
    products : (n_terms, n_patches, n_functions) float64
        Coefficients of P D M.
    balance : Balance
    """

    terms: tuple[Term, ...]
    vectors: Array
    products: Array
    balance: Balance

    @property
    def gradient(self) -> Array:
        """(n_terms, n_free) derivative of the energy by X."""
        left = self.balance.residuals
        flat = self.products.reshape(len(self.terms), -1)
        return np.asarray(-flat @ left.reshape(-1, left.shape[2]))


@dataclass(frozen=True)
class Decomposition:
    """A finished decomposition.

    Attributes
    ----------
    terms : tuple of Term
    vectors : (n_terms, n_free) float64
        X, m.
    history : (n_updates + 1, 3) float64
        Number of terms, Π, and relative residual after each update.
    """

    terms: tuple[Term, ...]
    vectors: Array
    history: Array


def rank_one(weak: WeakForm, left: Array, family: int) -> tuple[Term, float] | None:
    """Find one term by alternating directions on the linearised weak form.

    Parameters
    ----------
    weak : WeakForm
    left : (n_patches, n_functions, n_free) float64
        Residuals.
    family : int

    Returns
    -------
    tuple of Term and float, or None
        The term, and the energy that it gains in the linearised problem. None if there is nothing
        to gain.
    """
    block, functions = weak.blocks[family], weak.families[family]
    shape = functions.directions.shape[1], functions.powers.shape[1]
    own = np.ascontiguousarray(left[:, block]).reshape(-1, weak.n_free)
    gram = weak.gram[:, block, block]
    guess = _first_guess(weak, own, len(gram), shape)
    if guess is None:
        return None
    (position, direction, power), gain = guess, 0.0
    for _ in range(ITERATIONS):
        both = np.kron(direction, power)
        norms = np.einsum("i,pij,j->p", both, gram, both)
        total = float(position**2 @ norms)
        load = np.outer(position, both).ravel() @ own
        x = weak.respond(load[None])[0]
        stiffness, before = float(load @ x), gain
        if not (total > 0.0 and stiffness > 0.0):
            return None
        gain = 0.5 * stiffness / total
        work = own @ x
        position = _divide(work.reshape(len(gram), -1) @ both, norms)
        position = position / (np.abs(position).max() or 1.0)
        direction, power = _next_functions(gram, work, position, power)
        if gain - before <= STAGNANT * gain:
            break
    return Term(family, position, direction, power), gain


def _first_guess(
    weak: WeakForm, own: Array, n_patches: int, shape: tuple[int, int]
) -> tuple[Array, Array, Array] | None:
    """Return P, D and M of the product nearest to the main residual in the norm of K₀⁻¹."""
    guess = np.linalg.norm(own, axis=1)
    for _ in range(GUESSES):
        guess = own @ weak.respond((guess @ own)[None])[0]
        size = float(np.linalg.norm(guess))
        if not 0.0 < size < np.inf:
            return None
        guess = guess / size
    positions, _, others = np.linalg.svd(guess.reshape(n_patches, -1), full_matrices=False)
    directions, _, powers = np.linalg.svd(others[0].reshape(shape), full_matrices=False)
    return positions[:, 0], directions[:, 0], powers[0]


def _next_functions(gram: Array, work: Array, position: Array, power: Array) -> tuple[Array, Array]:
    """Return D for given P and M, and then M for given P and D, both of unit length."""
    n_m = len(power)
    n_d = gram.shape[1] // n_m
    folded = np.einsum("p,pij->ij", position**2, gram).reshape(n_d, n_m, n_d, n_m)
    weighted = (position @ work.reshape(len(gram), -1)).reshape(n_d, n_m)
    direction = _solved(np.einsum("akbl,k,l->ab", folded, power, power), weighted @ power)
    power = _solved(np.einsum("akbl,a,b->kl", folded, direction, direction), direction @ weighted)
    return direction, power


def _solved(matrix: Array, rhs: Array) -> Array:
    """Solve a small symmetric problem; return the solution scaled to unit length."""
    shift = 1e-14 * np.trace(matrix)
    found = np.linalg.solve(matrix + shift * np.eye(len(matrix)), rhs)
    return np.asarray(found / (np.linalg.norm(found) or 1.0))


def _divide(above: Array, below: Array) -> Array:
    return np.asarray(np.where(below > 0.0, above / np.where(below > 0.0, below, 1.0), 0.0))


class _Descent:
    """The decomposition as it grows and moves down the energy."""

    def __init__(self, weak: WeakForm) -> None:
        n_functions = weak.functions.shape[1]
        nothing = np.zeros((0, weak.n_patches, n_functions))
        balance = weak.balance(
            np.zeros((0, weak.n_free)), np.zeros((0, weak.n_patches)), np.zeros((0, n_functions))
        )
        self.weak = weak
        self.at = Separated((), np.zeros((0, weak.n_free)), nothing, balance)
        self.history = [(0.0, balance.energy, balance.relative)]
        self._direction = np.zeros((0, weak.n_free))
        self._before: tuple[Array, float] | None = None
        self._length = 1.0

    def _projected(self, gradient: Array) -> Array:
        """Return the forces (n_terms, n_free) whose products with P D M balance a gradient."""
        products = self.at.products.transpose(1, 0, 2)
        own = (products @ self.weak.gram) @ products.transpose(0, 2, 1)
        gram = own.sum(axis=0)
        scale = 1.0 / np.sqrt(gram.diagonal())
        normal = gram * scale * scale[:, None] + DEPENDENT * np.eye(len(gram))
        solved = cho_solve(cho_factor(normal), scale[:, None] * gradient)
        return np.asarray(-scale[:, None] * solved)

    def enrich(self) -> bool:
        """Add the term that gains most, with X = 0 so far; return False if there is none."""
        weak, at = self.weak, self.at
        left = at.balance.residuals
        if at.terms:
            tested = at.products.transpose(1, 0, 2) @ weak.gram
            left = left - tested.transpose(0, 2, 1) @ self._projected(at.gradient)
        found = [rank_one(weak, left, family) for family in range(len(weak.families))]
        best = max((f for f in found if f), key=lambda f: f[1], default=None)
        if best is None or best[1] <= EXHAUSTED:
            return False
        term, _ = best
        product = np.outer(term.position, weak.coefficients(term))
        none = np.zeros((1, weak.n_free))
        self.at = Separated(
            (*at.terms, term),
            np.vstack([at.vectors, none]),
            np.concatenate([at.products, product[None]]),
            at.balance,
        )
        self._direction = np.vstack([self._direction, none])
        if self._before is not None:
            self._before = np.vstack([self._before[0], none]), self._before[1]
        return True

    def update(self) -> float:
        """Move all X down the energy; return the squared length of the step, relative to u.

        The norm is that of the mean linear energy, in which the whole linear response has length 1.
        Returns 0 if the energy no longer falls.
        """
        gradient = self.at.gradient
        step = self.weak.respond(self._projected(gradient))
        squared = -float(np.sum(gradient * step))
        if not squared > 0.0:
            return 0.0
        conjugate = 0.0
        if self._before is not None:
            old, size = self._before
            conjugate = max(0.0, (squared + float(np.sum(gradient * old))) / size)
        direction = step + conjugate * self._direction
        if np.sum(gradient * direction) >= -1e-3 * squared:
            direction = step
        self._before, self._direction = (step, squared), direction
        return squared if self._search(direction, gradient) else 0.0

    def _moved(self, direction: Array, length: float) -> Separated:
        at = self.at
        vectors = at.vectors + length * direction
        positions = np.stack([term.position for term in at.terms])
        coefficients = np.stack([self.weak.coefficients(term) for term in at.terms])
        balance = self.weak.balance(vectors, positions, coefficients)
        return replace(at, vectors=vectors, balance=balance)

    def _search(self, direction: Array, gradient: Array) -> bool:
        """Move along a direction until the slope is small; return whether the energy fell."""
        start, length = self.at, self._length
        slope = float(np.sum(gradient * direction))
        best = start
        for _ in range(TRIALS):
            tried = self._moved(direction, length)
            after = float(np.sum(tried.gradient * direction))
            if tried.balance.energy < best.balance.energy:
                best, self._length = tried, min(max(length, 0.1), 2.0)
                if abs(after) <= -FLAT * slope:
                    break
            secant = slope / (slope - after) if after > slope else 3.0
            length *= min(max(secant, 0.1), 3.0)
        self.at, balance = best, best.balance
        if best is start:
            self._before, self._length = None, 0.3 * self._length
        self.history.append((float(len(best.terms)), balance.energy, balance.relative))
        return best is not start


def decompose(
    weak: WeakForm, n_terms: int, tolerance: float, limit_s: float | None = None
) -> Decomposition:
    """Return the separated displacement that balances the weak form.

    Parameters
    ----------
    weak : WeakForm
    n_terms : int
        Largest number of terms; fewer if nothing is left to gain.
    tolerance : float
        Length of the last update, relative to the linear response in the norm of the linear energy.
    limit_s : float, optional
        Time limit, s.

    Raises
    ------
    OutOfTimeError
        If the first evaluation shows that the limit will not suffice.
    """
    begin = perf_counter()
    descent = _Descent(weak)
    expected_s = (perf_counter() - begin) * EVALUATIONS * n_terms
    if limit_s is not None and expected_s > limit_s:
        raise OutOfTimeError(
            f"{n_terms} terms would take about {expected_s:.0f} s; the limit is {limit_s:.0f} s."
        )
    growing, left = True, FINAL
    while growing or left:
        growing = growing and len(descent.at.terms) < n_terms and descent.enrich()
        left -= 0 if growing else 1
        if not descent.at.terms:
            break
        squared = descent.update()
        if not growing and squared <= tolerance**2:
            break
    return Decomposition(descent.at.terms, descent.at.vectors, np.array(descent.history))
