"""Anderson acceleration against a least-squares solve of its own definition."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.mechanics.anderson import WINDOW, Anderson

Array = NDArray[np.float64]


def by_definition(iterates: list[Array], corrections: list[Array]) -> Array:
    """Return the step g - (ΔQ + ΔG) c, with c of least |ΔG c - g|, from the last differences."""
    g = corrections[-1]
    if len(iterates) == 1:
        return g
    steps = np.diff(np.array(iterates[-WINDOW - 1 :]), axis=0).T
    changes = np.diff(np.array(corrections[-WINDOW - 1 :]), axis=0).T
    c = np.linalg.lstsq(changes, g, rcond=1e-6)[0]
    return np.asarray(g - (steps + changes) @ c)


@pytest.mark.parametrize("n", [30, 5000])
def test_every_step_solves_the_least_squares_problem(n: int) -> None:
    """Also where the window is full and old differences are replaced, and for parts of a vector."""
    random = np.random.default_rng(n)
    rates, load = np.linspace(0.1, 1.9, n), random.normal(size=n)
    memory, iterates, corrections = Anderson(n), [np.zeros(n)], []
    for _ in range(2 * WINDOW + 2):
        q = iterates[-1]
        corrections.append(load - rates * q - 0.01 * np.sin(q))
        step = memory.advance(q, corrections[-1])
        expected = by_definition(iterates, corrections)
        np.testing.assert_allclose(step, expected, atol=1e-7 * np.abs(expected).max())
        iterates.append(q + step)


def test_a_linear_problem_with_few_rates_is_solved_at_once() -> None:
    """The answer lies in the span of as many differences as there are rates."""
    rates = np.repeat([0.3, 0.9, 1.7], 20)
    load = np.random.default_rng(0).normal(size=len(rates))
    memory, q = Anderson(len(rates)), np.zeros(len(rates))
    for _ in range(5):
        correction = load - rates * q
        q = q + memory.advance(q, correction)
    np.testing.assert_allclose(rates * q, load, atol=1e-10)


def test_changes_without_length_or_direction_of_their_own_are_left_out() -> None:
    load = np.random.default_rng(0).normal(size=10)
    memory, q = Anderson(10), np.zeros(10)
    for _ in range(WINDOW + 3):  # one rate: all changes are parallel, then zero
        correction = load - 0.5 * q
        step = memory.advance(q, correction)
        assert np.isfinite(step).all()
        q = q + step
    np.testing.assert_allclose(0.5 * q, load, atol=1e-12)
