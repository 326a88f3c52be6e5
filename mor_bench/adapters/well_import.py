"""Import of files in the HDF5 layout of The Well, see `mor_bench.adapters.well_export`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.adapters.imported_parts import Body, Samples, write_parts
from mor_bench.adapters.well_export import FOLDERS, REGION
from mor_bench.array_files import open_hdf5
from mor_bench.errors import StoreError, printable
from mor_bench.scene.mesh import box_mesh

SUFFIXES = (".h5", ".hdf5")
REST = 1e-6
"""Largest displacement at rest, relative to the largest of the file; single precision rounds."""


def import_well(
    source: str | Path,
    out: str | Path,
    *,
    displacement: str = "displacement",
    force: str = "force",
) -> list[Path]:
    """Turn files in The Well's layout into snapshots; return an NPZ and a TOML file.

    The grid becomes hexahedra. If the force is constant in time, the last time step of each
    trajectory is a sample; otherwise each step with a force is one. Walls are fixed nodes. Steps of
    one trajectory stay in one part: without load regions in the files, a trajectory is a region.

    Samples must be static equilibria, and this layout is also used for motion. So the body must be
    at rest in the first of several time steps under a constant force, and wherever no force acts.

    Parameters
    ----------
    source : path
        One HDF5 file, or a folder with ``data/train`` and ``data/test``, and maybe ``data/valid``.
    out : path
        New file with the ending ``.npz``. The TOML lies beside it: `load_dataset` reads it.
    displacement, force : str
        Names of the vector fields, m and N.

    Raises
    ------
    StoreError
        If a file is damaged, or is not of this layout, or has no such fields on a 3D Cartesian
        grid; the message names the file and the entry.
    InvalidInputError
        If `out` exists or has a wrong name.
    FileNotFoundError
        If the source does not exist.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> from mor_bench.adapters.well_export import export_well
    >>> with TemporaryDirectory() as folder:
    ...     files = export_well(mor_bench.load_dataset("beam-tiny"), f"{folder}/well")
    ...     arrays, toml = import_well(f"{folder}/well", f"{folder}/again.npz")
    ...     len(mor_bench.load_dataset(toml).test)
    40
    """
    source = Path(source)
    found: dict[str, list[_Content]] = {}
    n_trajectories = 0
    for part, files in _files_of(source).items():
        for path in files:
            content = _WellFile(path, displacement, force, n_trajectories).read()
            n_trajectories += content.n_trajectories
            found.setdefault(part, []).append(content)
    first = next(iter(found.values()))[0]
    for file in (file for files in found.values() for file in files):
        first.check_same_body(file)
    parts = {part: _joined([file.samples for file in files]) for part, files in found.items()}
    return write_parts(out, first.body(source), parts)


def _files_of(source: Path) -> dict[str, list[Path]]:
    """Return the files of each part."""
    if not source.is_dir():
        return {"train": [source]}
    found = {
        part: sorted(p for p in (source / "data" / name).glob("*") if p.suffix in SUFFIXES)
        for part, name in FOLDERS.items()
    }
    for part in ("train", "test"):
        if not found[part]:
            raise StoreError(
                f"{source}: the folder data/{FOLDERS[part]} must hold files that end in "
                f"{' or '.join(SUFFIXES)}; it has none."
            )
    return {part: files for part, files in found.items() if files}


def _joined(parts: Sequence[Samples]) -> Samples:
    regions = [part.regions for part in parts if part.regions is not None]
    alike = len(regions) == len(parts) and len({ids.shape[1] for ids in regions}) == 1
    return Samples(
        np.concatenate([part.forces for part in parts]),
        np.concatenate([part.displacements for part in parts]),
        np.concatenate(regions) if alike else None,
    )


@dataclass(frozen=True)
class _Content:
    """What was read from a file: coordinates of the grid, fixed points, and samples."""

    path: Path
    name: str
    coordinates: tuple[NDArray[np.float64], ...]
    fixed: NDArray[np.bool_]
    n_trajectories: int
    samples: Samples

    def check_same_body(self, other: _Content) -> None:
        same = np.array_equal(self.fixed, other.fixed) and all(
            map(np.array_equal, self.coordinates, other.coordinates)
        )
        if not same:
            raise StoreError(
                f"{other.path}: its grid or its walls differ from those in {self.path}."
            )

    def body(self, source: Path) -> Body:
        nx, ny, nz = self.fixed.shape
        cells = box_mesh((1.0, 1.0, 1.0), (nx - 1, ny - 1, nz - 1)).cells
        points = np.stack(np.meshgrid(*self.coordinates, indexing="ij"), axis=-1).reshape(-1, 3)
        title = printable(self.name, 500, "") or "The Well"
        return Body(points, cells, np.flatnonzero(self.fixed), title, str(source))


class _WellFile:
    """Reader of one file; every refusal names the file and the entry."""

    def __init__(self, path: Path, displacement: str, force: str, first: int) -> None:
        self.path, self.displacement, self.force = path, displacement, force
        self.first = first  # number of the file's first trajectory

    def refuse(self, text: str) -> StoreError:
        return StoreError(f"{self.path}: {text}")

    def read(self) -> _Content:
        with open_hdf5(self.path) as file:
            self._check_root(file)
            coordinates = self._coordinates(file)
            shape = tuple(map(len, coordinates))
            n = int(file.attrs["n_trajectories"])
            samples = self._samples(file, n, shape)
            fixed = self._fixed(file, shape)
            name = str(file.attrs["dataset_name"])
            return _Content(self.path, name, coordinates, fixed, n, samples)

    def _check_root(self, file: h5py.File) -> None:
        for name, kind in {"dataset_name": str, "grid_type": str}.items():
            if not isinstance(file.attrs.get(name), kind):
                raise self.refuse(f"the attribute `{name}` must be a text; it is not.")
        for name, wanted in {"n_spatial_dims": "3", "n_trajectories": "at least 1"}.items():
            value = file.attrs.get(name)
            good = isinstance(value, np.integer) and (value == 3 if wanted == "3" else value > 0)
            if not good:
                raise self.refuse(f"`{name}` must be {wanted}; got {_shown(value)}.")
        if file.attrs["grid_type"] != "cartesian":
            got = _shown(file.attrs["grid_type"])
            raise self.refuse(f"`grid_type` must be 'cartesian'; got {got}.")
        for name in ("dimensions", "boundary_conditions", "scalars", "t1_fields"):
            if not isinstance(file.get(name), h5py.Group):
                raise self.refuse(f"the group `{name}` is missing.")

    def _array(self, group: h5py.Group, name: str, kinds: str) -> h5py.Dataset:
        """Return an array of numbers of some kinds, not read yet."""
        array = group.get(name)
        where = f"{group.name}/{name}"
        if not isinstance(array, h5py.Dataset):
            raise self.refuse(f"the array `{where}` is missing.")
        if array.dtype.kind not in kinds or array.shape is None:
            raise self.refuse(f"`{where}` must hold numbers; got {array.dtype}.")
        return array

    def _flag(self, item: Any, name: str, wanted: bool | None = None) -> bool:
        """Return an attribute that is true or false, and perhaps must be one of them."""
        value = item.attrs.get(name)
        if not isinstance(value, np.bool_ | bool):
            raise self.refuse(f"`{name}` of `{item.name}` must be true or false; it is not.")
        if wanted is not None and bool(value) != wanted:
            raise self.refuse(f"`{name}` of `{item.name}` must be {wanted}; got {bool(value)}.")
        return bool(value)

    def _names(self, item: Any, attribute: str) -> list[str]:
        values = item.attrs.get(attribute)
        texts = [values] if isinstance(values, str) else list(np.ravel(np.asarray(values)))
        if values is None or not all(isinstance(text, str) for text in texts):
            raise self.refuse(f"`{attribute}` of `{item.name}` must be a list of texts; it is not.")
        return [str(text) for text in texts]

    def _coordinates(self, file: h5py.File) -> tuple[NDArray[np.float64], ...]:
        names = self._names(file["dimensions"], "spatial_dims")
        if len(set(names)) != 3 or len(names) != 3:
            raise self.refuse(f"`spatial_dims` must be three names; got {_shown(names)}.")
        found = []
        for name in names:
            axis = self._array(file["dimensions"], name, "fiu")
            self._flag(axis, "sample_varying", False)
            values = np.asarray(axis[()], dtype=np.float64)
            got = f"an array of shape {values.shape}"
            if values.ndim == 1 and len(values) > 1:
                growing = np.diff(values) > 0
                if growing.all():
                    found.append(values)
                    continue
                i = int(np.argmin(growing))
                got = f"{values[i + 1]:g} after {values[i]:g}"
            raise self.refuse(f"`{axis.name}` must be at least two growing coordinates; got {got}.")
        return tuple(found)

    def _field(
        self, file: h5py.File, name: str, n: int, shape: tuple[int, ...]
    ) -> tuple[NDArray[Any], bool]:
        """Return a vector field (n, [n_times], nx, ny, nz, 3), and whether it varies in time."""
        names = self._names(file["t1_fields"], "field_names")
        if name not in names:
            raise self.refuse(f"no vector field is called {name!r}; there are {_shown(names)}.")
        field = self._array(file["t1_fields"], name, "f")
        self._flag(field, "sample_varying", True)
        varying, dims = self._flag(field, "time_varying"), field.attrs.get("dim_varying")
        if np.shape(dims) != (3,) or not np.all(dims):
            raise self.refuse(f"`dim_varying` of `{field.name}` must be three times true.")
        times = [self._array(file["dimensions"], "time", "fiu").shape[-1]] if varying else []
        expected = (n, *times, *shape, 3)
        if field.shape != expected:
            raise self.refuse(f"`{field.name}` must have shape {expected}; got {field.shape}.")
        return field[()], varying

    def _samples(self, file: h5py.File, n: int, shape: tuple[int, ...]) -> Samples:
        force, pushes = self._field(file, self.force, n, shape)
        moved, moves = self._field(file, self.displacement, n, shape)
        if pushes and not moves:
            raise self.refuse(f"{self.force!r} varies in time, and {self.displacement!r} does not.")
        trajectory = np.arange(n)
        if pushes:
            loaded = force.reshape(n, force.shape[1], -1).any(axis=2)
            self._check_rest(moved[~loaded], moved, "wherever no force acts")
            trajectory = np.nonzero(loaded)[0]
            force, moved = force[loaded], moved[loaded]
        elif moves:
            if moved.shape[1] > 1:
                self._check_rest(moved[:, 0], moved, "in the first time step")
            moved = moved[:, -1]
        if len(force) == 0:
            raise self.refuse(f"{self.force!r} is zero everywhere.")
        flat = len(force), int(np.prod(shape)), 3
        regions = self._regions(file["scalars"], n)
        if regions is None and pushes:
            regions = np.arange(self.first, self.first + n)[:, None]
        return Samples(
            force.reshape(flat).astype(np.float64),
            moved.reshape(flat).astype(np.float64),
            None if regions is None else regions[trajectory],
        )

    def _check_rest(self, resting: NDArray[Any], moved: NDArray[Any], when: str) -> None:
        largest = np.abs(resting).max(initial=0.0)
        if largest > REST * np.abs(moved).max(initial=0.0):
            raise self.refuse(
                f"{self.displacement!r} must be zero {when}, because samples are static "
                f"equilibria; got up to {largest:.3g} m."
            )

    def _regions(self, group: h5py.Group, n: int) -> NDArray[np.int64] | None:
        columns = []
        for name in self._names(group, "field_names"):
            if name == REGION or name.startswith(f"{REGION}_"):
                scalar = self._array(group, name, "iu")
                if scalar.shape != (n,):
                    raise self.refuse(
                        f"`{scalar.name}` must have shape ({n},); got {scalar.shape}."
                    )
                columns.append(scalar[()].astype(np.int64))
        return np.stack(columns, axis=1) if columns else None

    def _fixed(self, file: h5py.File, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """Return the points of the grid that lie on walls."""
        names = self._names(file["dimensions"], "spatial_dims")
        fixed = np.zeros(shape, dtype=bool)
        for wall in file["boundary_conditions"].values():
            if not isinstance(wall, h5py.Group) or not isinstance(wall.attrs.get("bc_type"), str):
                raise self.refuse(f"`{wall.name}` must be a group with a text `bc_type`.")
            kind, fields = wall.attrs["bc_type"].upper(), self._names(wall, "associated_fields")
            if kind not in ("WALL", "OPEN"):
                raise self.refuse(f"`bc_type` of `{wall.name}` must be WALL or OPEN; got {kind!r}.")
            if kind == "OPEN" or (fields and self.displacement not in fields):
                continue
            for flag in ("sample_varying", "time_varying"):
                self._flag(wall, flag, False)
            axes = [names.index(d) for d in self._names(wall, "associated_dims") if d in names]
            mask = self._array(wall, "mask", "biu")
            if not axes or sorted(set(axes)) != axes or mask.shape != tuple(shape[a] for a in axes):
                raise self.refuse(f"`{mask.name}` must have an entry per point of its axes.")
            if "values" in wall and np.any(self._array(wall, "values", "fiu")[()]):
                raise self.refuse(f"`{wall.name}/values` must be zero: supports do not move.")
            fixed |= (
                mask[()].astype(bool).reshape([n if a in axes else 1 for a, n in enumerate(shape)])
            )
        return fixed


def _shown(value: Any) -> str:
    """Return a value as short text; NumPy's numbers as Python's."""
    return printable(repr(value.item() if isinstance(value, np.generic) else value), 100, "")
