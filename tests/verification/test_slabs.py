"""Kernels on several threads: the same results bit by bit, in any number of threads."""

import threading
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.machine import kernel_threads, pinned_threads
from mor_bench.mechanics import assembly
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.mechanics.slabs import N_SLABS, slabs_of

Array = NDArray[np.float64]


def _touched(links: list[tuple[int, int]], n: int) -> Callable[[int, int], NDArray[np.int64]]:
    """Return a function of rows: themselves and the rows that they are linked to."""
    neighbours = [{i} for i in range(n)]
    for a, b in links:
        neighbours[a].add(b)
        neighbours[b].add(a)
    return lambda first, last: np.array(sorted(set().union(*neighbours[first:last])))


def test_slabs_of_a_chain_meet_every_row_once_and_neighbours_not_together() -> None:
    n = 64
    slabs = slabs_of(n, _touched([(i, i + 1) for i in range(n - 1)], n))
    assert [len(group) for group in slabs.groups] == [N_SLABS // 2] * 2
    rows = np.concatenate(slabs.run(np.arange))
    assert sorted(rows) == list(range(n))
    assert list(np.concatenate(slabs.run(np.arange, backward=True))) != list(rows)
    assert sorted(np.concatenate(slabs.run_all(np.arange))) == list(range(n))


def test_rows_that_are_linked_across_slabs_stay_together() -> None:
    n = 64
    chain = [(i, i + 1) for i in range(n - 1)]
    slabs = slabs_of(n, _touched([*chain, (0, n // 2)], n))
    assert slabs.groups == [[(0, n)]]


def test_kernels_use_one_thread_unless_more_are_allowed() -> None:
    assert kernel_threads() == 1
    with suppress(RuntimeError), pinned_threads(2):
        assert kernel_threads() == 2
        raise RuntimeError
    assert kernel_threads() == 1


def _states(model: FullOrderModel, q: Array, load: Array) -> dict[str, Array]:
    """Return what kernels on slabs compute at displacements q (n,), m, and of a load (n,), N."""
    state, tangent = model.linearise(q)
    corrections = load.astype(np.float32)[None]
    factor = model.rest_factor
    if isinstance(factor, MultigridFactor):
        factor.solve_in_place(corrections)
    return {
        "force": model.force(q).force,
        "energy and det F": np.array([state.energy_j, state.min_det_f]),
        "tangent": tangent,
        "cycle": corrections,
        "answer": model.solve(load).displacement,
    }


@pytest.mark.parametrize("law", ["saint-venant-kirchhoff", "neo-hookean"])
def test_answers_on_several_threads_are_the_same_bit_by_bit(
    law: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And they are those without slabs, up to round-off."""
    spec = mor_bench.load_scene("beam-fine").spec.model_dump(mode="json")
    spec["geometry"]["cells"], spec["material"]["law"] = [32, 6, 6], law
    scene = mor_bench.load_scene(spec)
    q, load = np.random.default_rng(0).normal(size=(2, len(scene.free_dofs)))
    q, load = 1e-3 * q, 0.1 * load
    usual = _states(FullOrderModel(scene), q, load)
    monkeypatch.setattr("mor_bench.mechanics.model.MAX_BAND_ENTRIES", 0)
    monkeypatch.setattr("mor_bench.mechanics.assembly.PARALLEL_FROM", 1)
    monkeypatch.setattr("mor_bench.mechanics.cycles.PARALLEL_FROM", 1)
    model = FullOrderModel(scene)
    assert isinstance(model.rest_factor, MultigridFactor)
    found: list[dict[str, Array]] = []
    names: set[str] = set()
    for threads in (1, 2, 4):
        monkeypatch.setattr("mor_bench.machine._kernel_threads", threads)
        found.append(_states(model, q, load))
        names |= {thread.name for thread in threading.enumerate()}
    assert sum("mor-bench-slabs" in name for name in names) >= 2
    for name, values in found[0].items():
        for other in found[1:]:
            np.testing.assert_array_equal(values, other[name], name)
        if name != "cycle":
            size = np.abs(usual[name]).max()
            tolerance = 1e-6 if name == "answer" else 1e-12
            np.testing.assert_allclose(values, usual[name], 0, tolerance * size, err_msg=name)


def test_slabs_of_a_box_of_tetrahedra_use_the_gradients_of_their_own_cells(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three batches of gradients repeat, and most slabs do not begin with the first of them."""
    scene = mor_bench.load_scene(
        {
            "geometry": {"shape": "box", "size_m": [1.3, 1.1, 0.9], "cells": [15, 15, 13]},
            "discretisation": {"element": "tetrahedron"},
            "material": {"law": "saint-venant-kirchhoff", "young_pa": 500.0, "poisson": 0.3},
            "supports": [{"region": "x-min"}],
        }
    )
    q = 1e-3 * np.random.default_rng(0).normal(size=len(scene.free_dofs))
    model = FullOrderModel(scene)
    assert model.assembler.in_slabs
    state, tangent = model.linearise(q)
    monkeypatch.setattr(assembly, "PARALLEL_FROM", 10**9)
    whole = FullOrderModel(scene)
    assert not whole.assembler.in_slabs
    expected, values = whole.linearise(q)
    np.testing.assert_allclose(state.force, expected.force, atol=1e-12 * abs(expected.force).max())
    np.testing.assert_allclose(tangent, values, atol=1e-12 * abs(values).max())
