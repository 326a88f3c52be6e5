"""The body of a scene on other meshes."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.scene.constant_pressures import pressures_on_parts
from mor_bench.scene.scene import Scene, scene_without_patches
from mor_bench.scene.springs import on_parts
from mor_bench.scene.subdivision import subdivide
from mor_bench.scene.supports import Held, held_by_parents
from mor_bench.specs import BoxGeometry, ChamberedGeometry, LShapeGeometry


def with_cells(scene: Scene, cells: tuple[int, int, int]) -> Scene:
    """Return the same body and supports on another mesh. Its load patches may not exist.

    Parameters
    ----------
    scene : Scene
        A scene with a box, an L or a chambered box.
    cells : three ints
        Cells per axis.

    Raises
    ------
    UnsupportedSceneError
        If the scene is neither, or cannot have such a mesh.
    """
    geometry = scene.generated.geometry
    name = f"{scene.name} with {' x '.join(map(str, cells))} cells"
    changed: dict[str, Any] = {"cells": cells}
    if isinstance(geometry, LShapeGeometry):
        axes = zip(geometry.cut_cells, cells[::2], geometry.cells[::2], strict=True)
        cut = [Fraction(n * new, old) for n, new, old in axes]
        if any(n.denominator > 1 for n in cut):
            raise UnsupportedSceneError(
                f"{name}: the corner of an L that is cut away must consist of whole cells."
            )
        changed["cut_cells"] = tuple(int(n) for n in cut)
    elif isinstance(geometry, ChamberedGeometry):
        changed["chambers"] = _moved_chambers(geometry, cells, name)
    elif not isinstance(geometry, BoxGeometry):
        raise UnsupportedSceneError(
            f"{scene.name}: only the mesh of a box or an L can be made finer or coarser; "
            f"got `geometry.shape` {geometry.shape!r}."
        )
    try:
        other = geometry.model_copy(update=changed)
        return scene_without_patches(scene.generated.model_copy(update={"geometry": other}))
    except SpecError as error:
        raise UnsupportedSceneError(f"{name}: {error}") from None


def _moved_chambers(
    geometry: ChamberedGeometry, cells: tuple[int, int, int], name: str
) -> tuple[Any, ...]:
    """Return the same chambers, in numbers of other cells."""
    scale = [Fraction(new, old) for new, old in zip(cells, geometry.cells, strict=True)]
    ends = [
        [[n * s for n, s in zip(end, scale, strict=True)] for end in chamber]
        for chamber in geometry.chambers
    ]
    if any(n.denominator > 1 for chamber in ends for end in chamber for n in end):
        raise UnsupportedSceneError(f"{name}: a chamber must consist of whole cells.")
    return tuple(tuple(tuple(int(n) for n in end) for end in chamber) for chamber in ends)


def refined(scene: Scene) -> Scene:
    """Return the same body and supports on a mesh with each cell divided into eight.

    Its load patches may not exist. The steps in the surface of voxels remain.
    """
    geometry = scene.generated.geometry
    if isinstance(geometry, BoxGeometry) and scene.mesh.grid_shape is not None:
        nx, ny, nz = (2 * n for n in geometry.cells)
        return with_cells(scene, (nx, ny, nz))
    mesh, parents = subdivide(scene.mesh)
    sets = {
        name: np.flatnonzero(np.isin(parents, nodes).all(axis=1))
        for name, nodes in scene.point_sets.items()
    }
    held = Held(scene.fixed_nodes, scene.held_dofs, scene.frames)
    finer = held_by_parents(scene.mesh.n_nodes, held, parents)
    springs, pressures = scene.springs, scene.constant_pressures
    if scene.embedded_surface is None:
        of_file = zip(springs, scene.generated.springs, strict=True)
        springs = tuple(on_parts(own, spring, mesh, parents) for own, spring in of_file)
        pressures = pressures_on_parts(pressures, mesh, parents)
    return replace(
        scene,
        mesh=mesh,
        springs=springs,
        constant_pressures=pressures,
        fixed_nodes=finer.fixed_nodes,
        held_dofs=finer.held_dofs,
        frames=finer.frames,
        point_sets=sets,
    )
