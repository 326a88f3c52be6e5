"""Meshes and surfaces of other programs, read from files."""

from __future__ import annotations

import warnings
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.gmsh1 import is_gmsh1, read_gmsh1
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.point_sets import PointSets, check_abaqus, named_point_sets
from mor_bench.scene.soundness import tidied

CELLS = {"hexahedron": 8, "tetra": 4}
"""Cells that are computed with, in meshio's words, and their nodes."""


def read_mesh(path: Path, unit_m: float) -> tuple[Mesh, PointSets]:
    """Read the H8 or T4 cells of a mesh file, whatever its format, and its named sets of nodes.

    Cells of fewer dimensions only name nodes, see `mor_bench.scene.point_sets`. Nodes that no cell uses are dropped, cells
    are turned outwards, and nodes may be numbered anew, see `mor_bench.scene.soundness`.

    Parameters
    ----------
    path : Path
        Of a format that meshio reads, or of Gmsh's first one.
    unit_m : float
        Length of the file's unit, m.

    Returns
    -------
    mesh : Mesh
    point_sets : dict of str to (n,) int64

    Raises
    ------
    SpecError
        If the file is missing, cannot be read, or holds no such mesh that is sound.
    """
    raw = read_with_meshio(path)
    point_sets = named_point_sets(raw, path)
    kinds = {block.type for block in raw.cells if block.dim == 3}
    if len(kinds) != 1 or not kinds <= CELLS.keys():
        came = " and ".join(sorted(kinds)) or "no volume cells"
        raise SpecError(
            f"{path}: the cells must all be linear hexahedra or all linear tetrahedra, {' or '.join(CELLS)}; got {came}."
        )
    cells = np.concatenate(
        [np.asarray(block.data, dtype=np.int64) for block in raw.cells if block.type in kinds]
    )
    try:
        mesh, place = tidied(_positions(raw, unit_m), cells)
    except SpecError as error:
        raise SpecError(f"{path}: {error}") from None
    renumbered = {name: np.sort(place[nodes]) for name, nodes in point_sets.items()}
    return mesh, {name: nodes[nodes >= 0] for name, nodes in renumbered.items()}


def read_triangles(path: Path, unit_m: float) -> NDArray[np.float64]:
    """The triangles of a surface, open or closed, of an STL or OBJ file; polygons are cut from their first corner.

    Parameters
    ----------
    path : Path
    unit_m : float
        Length of the file's unit, m.

    Returns
    -------
    (n_triangles, 3, 3) float64
        Corners, m.

    Raises
    ------
    SpecError
        If the file is missing, cannot be read, or holds no triangle or a position that is not finite.
    """
    if path.suffix.lower() not in (".stl", ".obj"):
        raise SpecError(f"{path}: a surface must be an .stl or .obj file; got {path.suffix!r}.")
    raw = read_with_meshio(path)
    points = _positions(raw, unit_m)
    fans = [np.asarray(block.data) for block in raw.cells if block.dim == 2]
    triangles = [fan[:, [0, i, i + 1]] for fan in fans for i in range(1, fan.shape[1] - 1)]
    if not triangles:
        raise SpecError(f"{path}: a surface must hold triangles; got none.")
    numbers = np.concatenate(triangles)
    if numbers.min() < 0 or numbers.max() >= len(points):
        raise SpecError(
            f"{path}: triangles must have points in [1, {len(points)}]; got {numbers.min() + 1} to {numbers.max() + 1}."
        )
    corners: NDArray[np.float64] = points[numbers]
    if not np.isfinite(corners).all():
        raise SpecError(f"{path}: positions must be finite.")
    return corners


def _positions(raw: meshio.Mesh, unit_m: float) -> NDArray[np.float64]:
    points = np.asarray(raw.points, dtype=np.float64)
    return (points if points.size else points.reshape(0, 3)) * unit_m


def read_with_meshio(path: Path) -> meshio.Mesh:
    """Read a file; what meshio prints is swallowed, and where it would end the process it raises.

    Raises
    ------
    SpecError
        If the file is missing, cannot be read, or has positions that are not three-dimensional.
    """
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except FileNotFoundError:
        raise SpecError(f"{path}: no such file.") from None
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}.") from None
    if is_gmsh1(head):
        return read_gmsh1(path)
    if path.suffix.lower() == ".inp":
        check_abaqus(path)
    # Both Ansys and Gmsh write .msh; told which, meshio says what is wrong rather than that neither fits.
    file_format = "gmsh" if path.suffix.lower() == ".msh" and head.startswith(b"$") else None
    printed = StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            raw = meshio.read(path, file_format)
    except UnicodeDecodeError:
        broken = (
            "neither text nor a binary file of the length that it names"
            if path.suffix.lower() == ".stl"
            else "damaged, or of another format"
        )
        raise SpecError(
            f"{path}: cannot be read as {path.suffix[1:].upper()}: it is {broken}."
        ) from None
    except (Exception, SystemExit) as error:
        if "need at least one array" in str(error):
            raise SpecError(f"{path}: the file is empty or holds no mesh.") from None
        said = " ".join(
            (printed.getvalue() if isinstance(error, SystemExit) else str(error)).split()
        )
        raise SpecError(
            f"{path}: meshio cannot read it ({said or type(error).__name__})."
        ) from None
    if raw.points.size and (raw.points.ndim != 2 or raw.points.shape[1] != 3):
        raise SpecError(
            f"{path}: positions must have three coordinates; got an array of shape {raw.points.shape}."
        )
    return raw
