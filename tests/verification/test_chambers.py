"""A box with closed chambers: cells, walls, other meshes, and refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.scene.mesh import corners_of
from mor_bench.scene.other_meshes import refined, with_cells
from mor_bench.scene.scene import Scene, load_scene

from .laws_and_elements import ELEMENTS, discretisation

CHAMBERS = [[[1, 1, 1], [3, 2, 2]], [[4, 1, 1], [5, 2, 2]]]


def chambered(kind: tuple[str, bool] = ELEMENTS[0], **changed: Any) -> Scene:
    """Return a box of 6 x 3 x 3 m with two chambers, of 2 m³ and 1 m³."""
    box = {"shape": "chambered-box", "size_m": [6.0, 3.0, 3.0], "cells": [6, 3, 3]}
    return load_scene(
        {
            "geometry": {**box, "chambers": CHAMBERS, **changed},
            "discretisation": discretisation(kind),
            "material": {"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.4},
            "supports": [{"region": "x-min"}],
        }
    )


def volume_within(scene: Scene, nodes: NDArray[np.int64]) -> float:
    """Return the volume that some facets of the surface enclose, m³; negative for a chamber."""
    corners = scene.mesh.points[corners_of(scene.surface.within(nodes))]
    halves = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
    return float(sum(np.linalg.det(half).sum() for half in halves)) / 6


@pytest.mark.parametrize("kind", [kind for kind in ELEMENTS if not kind[1]])
@pytest.mark.parametrize("finer", [False, True])
def test_walls_enclose_the_chambers(kind: tuple[str, bool], finer: bool) -> None:
    scene = chambered(kind)
    scene = refined(scene) if finer else scene
    volumes = [volume_within(scene, scene.point_sets[f"chamber-{n}"]) for n in "ab"]
    np.testing.assert_allclose(volumes, [-2.0, -1.0], rtol=1e-12)
    n_cells = (54 - 3) * (8 if finer else 1) * (1 if kind[0] == "hexahedron" else 6)
    assert scene.mesh.n_cells == n_cells
    n = (2 if finer else 1) * (2 if "quadratic" in kind[0] else 1)
    assert scene.mesh.grid_shape == (6 * n + 1, 3 * n + 1, 3 * n + 1)


def test_other_numbers_of_cells_keep_the_chambers_or_are_refused() -> None:
    coarse = with_cells(with_cells(chambered(), (12, 6, 6)), (6, 3, 3))
    np.testing.assert_array_equal(coarse.mesh.cells, chambered().mesh.cells)
    with pytest.raises(UnsupportedSceneError, match="must consist of whole cells"):
        with_cells(chambered(), (7, 3, 3))


@pytest.mark.parametrize(
    ("chambers", "message"),
    [
        ([[[0, 1, 1], [3, 2, 2]]], "must be greater than or equal to 1"),
        ([[[1, 1, 1], [3, 2, 3]]], "must lie inside of the"),
        ([[[2, 1, 1], [2, 2, 2]]], "must lie inside of the"),
        ([[[1, 1, 1], [3, 2, 2]], [[3, 1, 1], [5, 2, 2]]], "must have a wall between"),
        ([], "at least 1 item"),
    ],
)
def test_bad_chambers_are_refused(chambers: list[Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        chambered(chambers=chambers)
