"""Several samples, or the load path of one, as a PVD collection of VTU files for ParaView."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, is_integer
from mor_bench.export.growing_load import load_steps
from mor_bench.export.output_path import new_file
from mor_bench.export.vtu_files import Part, samples_of, write_fields
from mor_bench.mechanics.stresses import CellDeformations
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.store import write_atomically

Array = NDArray[np.float64]


def export_pvd(
    data: Dataset, samples: Sequence[int], out: str | Path, *, part: Part = "test"
) -> list[Path]:
    """Write samples as one PVD collection; return its file and the VTU files.

    The time of a sample in ParaView is its number. Each VTU file holds the mesh at rest with the
    point data `displacement`, m, and `force`, N, and the cell data `volume_ratio`: det F at the
    centre of the cell. They lie in a folder beside the collection, with the same name.

    Parameters
    ----------
    data : Dataset
    samples : sequence of int
        Numbers of samples in their part, growing.
    out : path
        New file with the ending ``.pvd``.
    part : {"train", "validation", "test"} or the name of a test set
        The dataset must have been read with that test set.

    Raises
    ------
    InvalidInputError
        If the part or a sample does not exist, no sample is given, or a file or folder exists.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> with TemporaryDirectory() as folder:
    ...     files = export_pvd(mor_bench.load_dataset("beam-tiny"), [0, 3], f"{folder}/samples.pvd")
    >>> [file.name for file in files]
    ['samples.pvd', '00000.vtu', '00001.vtu']
    """
    found, numbers = samples_of(data, part), list(samples)
    growing = all(map(is_integer, numbers)) and all(a < b for a, b in pairwise(numbers))
    if not numbers or not growing or numbers[0] < 0 or numbers[-1] >= len(found):
        raise InvalidInputError(
            f"`samples` must be growing integers in [0, {len(found) - 1}], "
            f"the samples of part {part!r}; got {numbers}."
        )
    rows = np.array(numbers, dtype=np.int64)
    return _write_collection(
        data.scene, rows.astype(float), found.displacements[rows], found.forces[rows], out
    )


def export_load_path_pvd(
    data: Dataset, sample: int, out: str | Path, *, n_steps: int = 20
) -> list[Path]:
    """Write the deformation under a growing load of the test set as PVD; return its files.

    The full-order model solves each step from an extrapolation of the steps before. The time in
    ParaView is the fraction of the load, from 0 to 1. See `export_pvd` for the content.

    Parameters
    ----------
    data : Dataset
    sample : int
        Number of the sample in the test set, counted from 0.
    out : path
        New file with the ending ``.pvd``.
    n_steps : int
        Steps from rest to the whole load.

    Raises
    ------
    InvalidInputError
        If the sample does not exist, `n_steps` is less than 1, or a file or folder exists.
    UnsupportedSceneError
        If the full-order model cannot solve the scene for given forces.
    SolverError
        If a step has no solution.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> with TemporaryDirectory() as folder:
    ...     len(export_load_path_pvd(data, 3, f"{folder}/path.pvd", n_steps=2))
    4
    """
    _check_new(out)
    fractions, moved = load_steps(data, sample, n_steps)
    forces = fractions[:, None, None] * data.test.forces[sample]
    return _write_collection(data.scene, fractions, moved, forces, out)


def _check_new(out: str | Path) -> tuple[Path, Path]:
    """Return the collection and the folder of its files, neither of which may exist."""
    path = new_file(out, ".pvd", "")
    return path, path.with_suffix("")


def _write_collection(
    scene: Scene, times: Array, displacements: Array, forces: Array, out: str | Path
) -> list[Path]:
    """Write the VTU files first, so that a collection never names a missing file."""
    path, folder = _check_new(out)
    folder.mkdir(parents=True)
    deformations = CellDeformations(scene)
    entries, written = [], []
    for number, (time, u, force) in enumerate(zip(times, displacements, forces, strict=True)):
        fields = {"displacement": u, "force": force}
        ratios = {"volume_ratio": np.linalg.det(deformations(u))}
        files = write_fields(scene, fields, folder, f"{number:05d}", cell_fields=ratios)
        written += files
        entries += [
            f'    <DataSet timestep="{float(time)!r}" group="" part="{part}" '
            f"file={quoteattr(f'{folder.name}/{file.name}')}/>"
            for part, file in enumerate(files)
        ]
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">',
        "  <Collection>",
        *entries,
        "  </Collection>",
        "</VTKFile>",
    ]
    write_atomically(path, ("\n".join(lines) + "\n").encode())
    return [path, *written]
