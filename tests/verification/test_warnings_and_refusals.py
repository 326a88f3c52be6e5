"""Warnings of full-order models about their scene, and refused inputs."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import (
    IllConditionedWarning,
    InvalidInputError,
    LockingWarning,
    NoEquilibriumError,
    SpecError,
)
from mor_bench.hard_cases.setups import free_assembler
from mor_bench.mechanics.contact import ContactModel
from mor_bench.mechanics.contact_points import ContactPoints
from mor_bench.mechanics.model import SOLVERS, FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.runs.file_check import check_file
from mor_bench.scene.mesh import Mesh

from .laws_and_elements import ELEMENTS, LAWS
from .pressed_blocks import block, given
from .scenes import scene_of


@pytest.mark.parametrize("kind", ELEMENTS[:1] + ELEMENTS[2:3])
@pytest.mark.parametrize("law", list(LAWS))
def test_a_scene_that_locks_is_warned_of(law: str, kind: tuple[str, bool]) -> None:
    with pytest.warns(
        LockingWarning,
        match=r"beam-tiny: with Poisson's ratio 0\.46 at rest.*integration = \"selective\"",
    ) as caught:
        FullOrderModel(scene_of(law, kind, 0.46))
    assert len(caught) == 1
    assert ('element = "hexahedron"' in str(caught[0].message)) == (kind[0] == "tetrahedron")
    assert ("order = 2" in str(caught[0].message)) == (kind[0] == "tetrahedron")


@pytest.mark.filterwarnings("error::mor_bench.errors.LockingWarning")
@pytest.mark.parametrize("law", list(LAWS))
def test_a_scene_that_does_not_lock_is_not_warned_of(law: str) -> None:
    for kind, poisson in (
        (("hexahedron", True), 0.4999),
        (("hexahedron", False), 0.449),
        (("tetrahedron", False), 0.449),
        (("quadratic tetrahedron", False), 0.4999),
    ):
        FullOrderModel(scene_of(law, kind, poisson))


def test_check_says_that_a_dataset_locks(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "datasets" / "beam-tiny.toml").read_text(encoding="utf-8")
    path = tmp_path / "soft.toml"
    path.write_text(text.replace("poisson  = 0.4", "poisson  = 0.48"), encoding="utf-8")
    assert "warning: soft: with Poisson's ratio 0.48" in check_file(path)
    path.write_text(text, encoding="utf-8")
    assert "warning" not in check_file(path)


def test_an_ill_conditioned_stiffness_is_reported() -> None:
    spec = mor_bench.load_scene("beam-tiny").spec.model_dump(mode="json")
    spec["loads"]["patch_area_m2"] = 10.0
    for length, ill in ((20.0, False), (1000.0, True)):
        spec["geometry"] = {"shape": "box", "size_m": [length, 1.0, 1.0], "cells": [160, 1, 1]}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            _ = FullOrderModel(mor_bench.load_scene(spec)).rest_factor
        assert any(issubclass(warning.category, IllConditionedWarning) for warning in caught) == ill


@pytest.mark.parametrize("bad", ["nan", "inf", "shape", "complex", "text"])
def test_forces_that_are_not_real_numbers_of_the_right_shape_are_refused(bad: str) -> None:
    scene = mor_bench.load_scene("beam-tiny")
    method = mor_bench.load_method("fem").fit(scene, None)
    force: NDArray[Any] = np.zeros((scene.mesh.n_nodes, 3))
    if bad in ("nan", "inf"):
        force[3, 1] = float(bad)
    force = {"shape": force[:-1], "complex": force + 1j, "text": force.astype(str)}.get(bad, force)
    with pytest.raises(InvalidInputError, match="forces"):
        method.predict(force)


@pytest.mark.parametrize("bad", ["nan", "inf"])
def test_points_that_are_not_finite_are_refused(bad: str) -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    points[2, 1] = float(bad)
    with np.errstate(invalid="ignore"), pytest.raises(InvalidInputError, match="cell 0"):
        free_assembler(Mesh(points, np.array([[0, 1, 2, 3]])))


@pytest.mark.parametrize("name", ["load 0", "`start`"])
@pytest.mark.parametrize(
    "bad", ["nan", "inf", "short", "empty", "column", "complex", "text", "huge"]
)
def test_the_solver_itself_refuses_what_is_not_a_finite_vector(bad: str, name: str) -> None:
    model = FullOrderModel(mor_bench.load_scene("beam-tiny"))
    good = np.linspace(0.0, 1e-3, model.n_unknowns)
    wrong: Any = {
        "short": good[:-3],
        "empty": good[:0],
        "column": good[:, None],
        "complex": good + 1j,
        "text": good.astype(str),
    }.get(bad)
    if wrong is None:
        wrong = good.copy()
        wrong[3] = {"huge": 1e160}.get(bad) or float(bad)
    load, start = (wrong, None) if name == "load 0" else (good, wrong)
    if bad == "huge" and start is not None:  # a start may be of any size
        ours, best = model.solve(load, start).displacement, model.solve(load).displacement
        np.testing.assert_allclose(ours, best, rtol=0, atol=1e-9)
        return
    said = "within ±1e\\+30 N; got 1e\\+160" if bad == "huge" else "finite real numbers"
    with pytest.raises(InvalidInputError, match=f"{name} must be {said}"):
        model.solve(load, start)


@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_and_tolerances_that_do_not_exist_are_refused(solver: str) -> None:
    with pytest.raises(SpecError, match=f"`solver` must be one of .*{solver}.*; got '{solver}s'"):
        FullOrderModel(mor_bench.load_scene("beam-tiny"), f"{solver}s")  # type: ignore[arg-type]
    for tolerance in (0.0, -1.0, 2.0, float("nan")):
        with pytest.raises(InvalidInputError, match=r"`tolerance` must be in \(0, 1\]"):
            NewtonOptions(tolerance)


def test_a_body_that_has_passed_through_an_instrument_is_refused() -> None:
    """The block folds through its own base. Its sides then lie far behind the plate."""
    scene = block(
        {"plane": {"point_m": [0.0, 0.0, 2.01], "normal": [0.0, 0.0, -1.0]}},
        geometry={"shape": "box", "size_m": [2.0, 2.0, 2.0], "cells": [4, 4, 4]},
        loads={"magnitude_m": [0.0, 1.3]},
    )
    model, points = ContactModel(scene), ContactPoints(scene)
    motion = given(scene, [0.0, 0.0, -1.2]).ravel()[scene.free_dofs]
    with pytest.raises(NoEquilibriumError, match=r"0\.89 m deep in the instrument, more than 0\.5"):
        model.solve(motion)
    found = model.solve(0.5 * motion).displacement
    moved = scene.at_all_dofs(found[None]).reshape(-1, 3)
    assert points.depth_of_nodes(moved, np.array([0.0, 0.0, -0.6])) < 0.002
    assert points.depth_of_nodes(0.0 * moved, np.array([0.0, 0.0, -0.6])) == pytest.approx(0.59)
