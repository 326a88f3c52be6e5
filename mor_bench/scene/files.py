"""Readers for mesh and surface files of other programs."""

from __future__ import annotations

import re
import warnings
from contextlib import redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from xml.parsers.expat import ExpatError, ParserCreate

import meshio
import numpy as np
from numpy.typing import NDArray

from mor_bench.array_files import is_hdf5, open_hdf5
from mor_bench.checked_files import check_file, limited_memory, read_bytes
from mor_bench.errors import SpecError, printable
from mor_bench.scene.gmsh1 import is_gmsh1, read_gmsh1
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.point_sets import (
    PointSets,
    abaqus_keyword,
    abaqus_lines,
    check_abaqus,
    named_point_sets,
)
from mor_bench.scene.soundness import FARTHEST_M, tidied

MOST_MESH_BYTES, MOST_CELLS = 1 * 2**30, 4_000_000
"""Size limits of a mesh or surface file: bytes, and cells of all kinds."""

_IMPLICIT_CELLS = {"STRUCTURED_POINTS", "STRUCTURED_GRID", "RECTILINEAR_GRID"}
"""Types of a VTK file of a few bytes that may stand for millions of cells."""

FORMATS = [
    ".vtu",
    ".vtk",
    ".msh",
    ".inp",
    ".med",
    ".xdmf",
    ".xmf",
    ".mesh",
    ".meshb",
    ".bdf",
    ".fem",
    ".nas",
    ".avs",
    ".su2",
    ".f3grid",
    ".ugrid",
    ".stl",
    ".obj",
]
"""Formats that are read. meshio has others, but damaged files can keep it busy for ever."""

CELLS = ("hexahedron", "tetra", "tetra10")
"""Supported volume cells, by meshio's names."""


def read_mesh(path: Path, unit_m: float) -> tuple[Mesh, PointSets]:
    """Read the H8, T4 or T10 cells of a mesh file, and its named sets of nodes.

    Cells of lower dimension only name nodes, see `mor_bench.scene.point_sets`. Unused nodes are
    dropped, cells are oriented and nodes may be renumbered, see `mor_bench.scene.soundness`.

    Parameters
    ----------
    path : Path
        A file in one of the `FORMATS`, or in version 1 of Gmsh's format.
    unit_m : float
        Length of the file's unit, m.

    Returns
    -------
    mesh : Mesh
    point_sets : dict of str to (n,) int64

    Raises
    ------
    SpecError
        If the file is missing or unreadable, or its mesh is not valid.
    """
    raw = read_with_meshio(path)
    point_sets = named_point_sets(raw, path)
    kinds = {block.type for block in raw.cells if block.dim == 3}
    if len(kinds) != 1 or not kinds <= {*CELLS}:
        found = " and ".join(sorted(kinds)) or "no volume cells"
        raise SpecError(
            f"{path}: all cells must be hexahedra with 8 nodes, or all tetrahedra with 4 nodes, or "
            f"all tetrahedra with 10 nodes ({', '.join(CELLS)}); got {found}."
        )
    blocks = [np.asarray(block.data, np.int64) for block in raw.cells if block.type in kinds]
    try:
        mesh, place = tidied(_positions(raw, unit_m), np.concatenate(blocks))
    except SpecError as error:
        raise SpecError(f"{path}: {error}") from None
    renumbered = {name: np.sort(place[nodes]) for name, nodes in point_sets.items()}
    return mesh, {name: nodes[nodes >= 0] for name, nodes in renumbered.items()}


def read_triangles(path: Path, unit_m: float) -> NDArray[np.float64]:
    """Read the triangles of an open or closed surface. Polygons become fans of triangles.

    Parameters
    ----------
    path : Path
        An STL or OBJ file.
    unit_m : float
        Length of the file's unit, m.

    Returns
    -------
    (n_triangles, 3, 3) float64
        Corners, m.

    Raises
    ------
    SpecError
        If the file is missing or unreadable, has no triangle, or has a position that is not finite.
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
            f"{path}: triangles must have points in [1, {len(points)}]; "
            f"got {numbers.min() + 1} to {numbers.max() + 1}."
        )
    corners: NDArray[np.float64] = points[numbers]
    if not np.isfinite(corners).all():
        raise SpecError(f"{path}: positions must be finite.")
    if np.abs(corners).max() > FARTHEST_M:
        raise SpecError(f"{path}: positions must be in [-{FARTHEST_M:g}, {FARTHEST_M:g}] m.")
    return corners


def _positions(raw: meshio.Mesh, unit_m: float) -> NDArray[np.float64]:
    points = np.asarray(raw.points, dtype=np.float64)
    with np.errstate(over="ignore"):  # the range is checked later
        return (points if points.size else points.reshape(0, 3)) * unit_m


def read_with_meshio(path: Path) -> meshio.Mesh:
    """Read a file with meshio, without its output, and raise an error where meshio would exit.

    Raises
    ------
    SpecError
        If the file is missing or unreadable, or its positions are not three-dimensional.
    """
    try:
        check_file(path, MOST_MESH_BYTES, SpecError)
        with path.open("rb") as file:
            head = file.read(64)
    except FileNotFoundError:
        raise SpecError(f"{path}: no such file.") from None
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}.") from None
    _check_alone(path)
    with limited_memory(path, SpecError):
        raw = read_gmsh1(path) if is_gmsh1(head) else _read_by_suffix(path, head)
    if (n_cells := sum(len(block.data) for block in raw.cells)) > MOST_CELLS:
        raise SpecError(
            f"{path}: {n_cells:,} cells; a mesh or surface file may have at most {MOST_CELLS:,}."
        )
    if raw.points.size and (raw.points.ndim != 2 or raw.points.shape[1] != 3):
        shape = raw.points.shape
        raise SpecError(
            f"{path}: positions must have three coordinates; got an array of shape {shape}."
        )
    return raw


def _check_alone(path: Path) -> None:
    """Refuse a mesh that other files or links continue: a dataset's checksum covers one file."""
    suffix = path.suffix.lower()
    if suffix in (".node", ".ele", ".xml", ".gz"):
        raise SpecError(f"{path}: a mesh must be one file, not packed; convert it to .vtu or .msh.")
    if suffix not in FORMATS:
        raise SpecError(f"{path}: a mesh must be one of {', '.join(FORMATS)}; got {suffix!r}.")
    if reference := _reference(suffix, path):
        words = printable(" ".join(reference.split())[:80])
        raise SpecError(
            f"{path}: refers to another file ({words!r}); a mesh must be one file. "
            "Convert it to .vtu or .msh."
        )
    if suffix == ".vtk":
        _check_lists_cells(path)
    if is_hdf5(path):
        with open_hdf5(path, SpecError):
            pass


def _check_lists_cells(path: Path) -> None:
    """Refuse a VTK file whose cells are implied; words are split as meshio splits them."""
    content = read_bytes(path, MOST_MESH_BYTES, SpecError)
    for line in re.finditer(rb"[^\n]{0,200}_[^\n]{0,200}", content):
        words = line[0].decode("utf-8", errors="replace").upper().split()
        if kind := _IMPLICIT_CELLS & {*words}:
            raise SpecError(
                f"{path}: a grid of type {kind.pop()} lists no cells; convert it to .vtu."
            )


def _reference(suffix: str, path: Path) -> str | None:
    """Return the first reference to another file in a format that allows them."""
    if suffix == ".inp":
        return next(
            (line for line in abaqus_lines(path) if abaqus_keyword(line) == "INCLUDE"), None
        )
    if suffix in (".xdmf", ".xmf", ".vtu"):
        return _xml_reference(read_bytes(path, MOST_MESH_BYTES, SpecError))
    return None


def _xml_reference(content: bytes) -> str | None:
    """Return the first element of an XML file that names another file, or a document type.

    A document type may define references that no element shows.
    """
    found: list[str] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        external = attributes.get("Format", "XML") != "XML"
        if external or name.endswith("include"):
            found.append(" ".join([name, *(f"{key}={text}" for key, text in attributes.items())]))

    parser = ParserCreate()
    parser.StartElementHandler = begin
    parser.StartDoctypeDeclHandler = lambda name, *_: found.append(f"DOCTYPE {name}")
    with suppress(ExpatError, ValueError, LookupError):  # meshio's message explains the error
        parser.Parse(content, True)
    return found[0] if found else None


def _read_by_suffix(path: Path, head: bytes) -> meshio.Mesh:
    suffix = path.suffix.lower()
    if suffix == ".inp":
        check_abaqus(path)
    if suffix in (".bdf", ".fem", ".nas"):
        _check_nastran(path)
    # meshio would try Ansys too, whose reader waits for the end of a cut file for ever.
    file_format = "gmsh" if suffix == ".msh" else None
    if file_format and not head.strip():
        raise SpecError(f"{path}: the file is empty or holds no mesh.")
    printed = StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return meshio.read(path, file_format)
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:
        text = printed.getvalue() if isinstance(error, SystemExit) else str(error)
        raise SpecError(f"{path}: {_reason(error, text, suffix)}.") from None


def _check_nastran(path: Path) -> None:
    """Refuse bulk data without an end, in which meshio would read for ever."""
    with path.open(errors="replace") as lines:
        begun = any(line.strip().startswith("BEGIN BULK") for line in lines)
        if begun and not any(line.startswith("ENDDATA") for line in lines):
            raise SpecError(f"{path}: ENDDATA is missing after BEGIN BULK; the file was cut short.")


def _reason(error: BaseException, text: str, suffix: str) -> str:
    if isinstance(error, UnicodeDecodeError):
        binary = "neither text nor a binary file of the length given in its header"
        broken = binary if suffix == ".stl" else "damaged, or in another format"
        return f"cannot be read as {suffix[1:].upper()}: it is {broken}"
    if "need at least one array" in text:
        return "the file is empty or holds no mesh"
    words = printable(" ".join(text.split()), 300, keep="") or type(error).__name__
    return f"meshio cannot read it ({words})"
