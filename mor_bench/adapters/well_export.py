"""Samples in the HDF5 layout of The Well, for its data loaders.

The layout (Ohana and others, The Well, NeurIPS 2024; https://polymathic-ai.org/the_well) holds
fields on uniform grids. Here each sample is a trajectory of two time steps, at rest and loaded: the
vector field `displacement`, m, varies in time, and the vector field `force`, N, does not. The time
is the fraction of the load. Fixed nodes are a boundary condition of type WALL.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Literal, get_args

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.adapters.exported_scene import why_not_written
from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import DatasetSpec

Precision = Literal["float32", "float64"]

FOLDERS = {"train": "train", "validation": "valid", "test": "test"}
"""The layout's name of the folder of each part."""

AXES = ("x", "y", "z")
REGION = "load_region"
"""Name of the scalar with the load-region id; with several forces at once, it has a number."""

OFF_GRID = 1e-6
"""Largest distance of a node from its grid point, relative to the size of the body."""


def export_well(data: Dataset, out: str | Path, *, dtype: Precision = "float32") -> list[Path]:
    """Write each part of a dataset to an HDF5 file in The Well's layout; return the files.

    They are ``out/data/train/NAME.hdf5``, and the same in the folders ``valid`` and ``test``.

    Parameters
    ----------
    data : Dataset
    out : path
        Folder; created if it does not exist.
    dtype : {"float32", "float64"}
        The layout has single precision. Double precision keeps all digits.

    Raises
    ------
    UnsupportedSceneError
        If the nodes and cells are not those of a whole regular grid of hexahedra, the body varies
        between samples, or methods are given displacements instead of forces.
    InvalidInputError
        If the type is another one, or one of the files exists.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> with TemporaryDirectory() as folder:
    ...     files = export_well(mor_bench.load_dataset("beam-tiny"), folder)
    >>> [file.parent.name for file in files]
    ['train', 'valid', 'test']
    """
    if dtype not in get_args(Precision):
        raise InvalidInputError(f"`dtype` must be float32 or float64; got {dtype!r}.")
    grid = GridFields(data.scene, np.dtype(dtype))
    parts = {"train": data.train, "validation": data.validation, "test": data.test}
    files = {
        Path(out) / "data" / FOLDERS[name] / f"{data.scene.name}.hdf5": part
        for name, part in parts.items()
        if len(part)
    }
    for path in files:
        if path.exists():
            raise InvalidInputError(
                f"`out`: {path} exists and is not overwritten; remove it or choose another folder."
            )
    for path, part in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, grid.content(part))
    return list(files)


class GridFields:
    """A scene on a regular grid, as the layout describes it; errors as in `export_well`."""

    def __init__(self, scene: Scene, dtype: np.dtype[Any]) -> None:
        self.scene, self.dtype = scene, dtype
        mesh = scene.mesh
        shape, index = mesh.grid_shape, mesh.grid_index
        if reason := _why_no_grid(scene):
            raise UnsupportedSceneError(
                f"{scene.name} cannot be written in the layout of The Well: {reason}."
            )
        assert shape is not None
        assert index is not None
        self.shape, self.index = shape, index
        first = np.argsort(index).reshape(shape)
        points = mesh.points[first]
        self.coordinates = points[:, 0, 0, 0], points[0, :, 0, 1], points[0, 0, :, 2]
        found = np.stack(np.meshgrid(*self.coordinates, indexing="ij"), axis=-1)
        if np.abs(found - points).max() > OFF_GRID * np.ptp(mesh.points, axis=0).max():
            raise UnsupportedSceneError(
                f"{scene.name} cannot be written in the layout of The Well: its nodes are not on "
                "planes of equal x, y and z."
            )

    def on_grid(self, fields: NDArray[Any], dtype: np.dtype[Any] | None = None) -> NDArray[Any]:
        """Return nodal fields (n, n_nodes, ...) on the grid, (n, nx, ny, nz, ...)."""
        found = np.zeros((len(fields), len(self.index), *fields.shape[2:]), dtype or self.dtype)
        found[:, self.index] = fields
        return found.reshape(len(fields), *self.shape, *fields.shape[2:])

    def content(self, samples: Snapshots) -> bytes:
        """Return the content of the file of some samples; the same samples give the same bytes."""
        buffer = io.BytesIO()
        with h5py.File(buffer, "w") as file:
            self._write_root(file, len(samples))
            self._write_dimensions(file.create_group("dimensions"))
            self._write_boundary(file.create_group("boundary_conditions"))
            self._write_scalars(file.create_group("scalars"), samples.regions)
            for order in (0, 2):
                file.create_group(f"t{order}_fields").attrs["field_names"] = []
            group = file.create_group("t1_fields")
            group.attrs["field_names"] = ["displacement", "force"]
            loaded = self.on_grid(samples.displacements)
            path = np.stack([np.zeros_like(loaded), loaded], axis=1)
            self._write(group, "displacement", path, True)
            self._write(group, "force", self.on_grid(samples.forces), False)
        return buffer.getvalue()

    def _write_root(self, file: h5py.File, n: int) -> None:
        file.attrs["dataset_name"], file.attrs["grid_type"] = self.scene.name, "cartesian"
        file.attrs["n_spatial_dims"], file.attrs["n_trajectories"] = 3, n
        numbers = _numbers(self.scene)
        file.attrs["simulation_parameters"] = list(numbers)
        for name, value in numbers.items():
            file.attrs[name] = value

    def _write_dimensions(self, group: h5py.Group) -> None:
        group.attrs["spatial_dims"] = list(AXES)
        time = _array(group, "time", np.array([0.0, 1.0], dtype=self.dtype))
        time.attrs["sample_varying"] = False
        for name, values in zip(AXES, self.coordinates, strict=True):
            axis = _array(group, name, values.astype(self.dtype))
            axis.attrs["sample_varying"] = axis.attrs["time_varying"] = False

    def _write_boundary(self, group: h5py.Group) -> None:
        """Write fixed nodes: as planes if they fill some, because readers pad along axes."""
        fixed = np.zeros((1, self.scene.mesh.n_nodes), dtype=bool)
        fixed[:, self.scene.fixed_nodes] = True
        mask = self.on_grid(fixed, np.dtype(bool))[0]
        if not mask.any():
            return
        planes = [mask.all(axis=tuple({0, 1, 2} - {axis})) for axis in range(3)]
        x, y, z = planes
        if (mask == x[:, None, None] | y[:, None] | z).all():
            for name, plane in zip(AXES, planes, strict=True):
                if plane.any():
                    _wall(group, f"{name}_wall", [name], plane)
        else:
            _wall(group, "wall", list(AXES), mask)

    def _write_scalars(self, group: h5py.Group, regions: NDArray[np.int64]) -> None:
        columns = regions.reshape(len(regions), -1).T
        names = [REGION] if len(columns) == 1 else [f"{REGION}_{i}" for i in range(len(columns))]
        group.attrs["field_names"] = names
        for name, values in zip(names, columns, strict=True):
            scalar = _array(group, name, values.astype(np.int64))
            scalar.attrs["sample_varying"], scalar.attrs["time_varying"] = True, False

    def _write(self, group: h5py.Group, name: str, values: NDArray[Any], in_time: bool) -> None:
        field = _array(group, name, values)
        field.attrs["dim_varying"] = [True, True, True]
        field.attrs["sample_varying"], field.attrs["time_varying"] = True, in_time


def _why_no_grid(scene: Scene) -> str | None:
    """Return why a scene's mesh is not a whole grid; None if it is one."""
    mesh = scene.mesh
    if reason := why_not_written(scene):
        return reason
    if mesh.cells.shape[1] != 8:
        return "its cells are not hexahedra, and the layout holds the points of a grid alone"
    if mesh.grid_shape is None:
        return "its mesh is not a regular grid"
    cells = int(np.prod(np.subtract(mesh.grid_shape, 1)))
    if mesh.n_nodes < np.prod(mesh.grid_shape) or mesh.n_cells < cells:
        return (
            f"its mesh is a part of a grid ({mesh.n_cells} of {cells} cells), and the layout "
            "cannot leave out points"
        )
    return None


def _numbers(scene: Scene) -> dict[str, float]:
    """Return the numbers of the material, by their names in the dataset file."""
    if not isinstance(scene.spec, DatasetSpec):
        return {}
    values = scene.spec.material.model_dump(exclude_none=True)
    return {name: float(v) for name, v in values.items() if type(v) in (int, float)}


def _array(group: h5py.Group, name: str, values: NDArray[Any]) -> h5py.Dataset:
    return group.create_dataset(name, data=values, track_times=False)


def _wall(group: h5py.Group, name: str, axes: list[str], mask: NDArray[np.bool_]) -> None:
    """Write that displacements are zero on the masked points."""
    wall = group.create_group(name)
    wall.attrs["associated_dims"], wall.attrs["associated_fields"] = axes, ["displacement"]
    wall.attrs["bc_type"] = "WALL"
    wall.attrs["sample_varying"] = wall.attrs["time_varying"] = False
    _array(wall, "mask", mask)
