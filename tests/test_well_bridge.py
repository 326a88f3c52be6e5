"""Files in The Well's layout follow its specification, come back exactly, and are checked."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import mor_bench
from mor_bench.adapters.well_export import export_well
from mor_bench.adapters.well_import import import_well
from mor_bench.errors import InvalidInputError, StoreError, UnsupportedSceneError
from mor_bench.scene.mesh import box_mesh, l_mesh
from mor_bench.snapshots.dataset import Dataset

PARTS = ("train", "validation", "test")


@pytest.fixture(scope="module")
def exported(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("well") / "tiny"
    paths = export_well(tiny, folder)
    names = [path.relative_to(folder).as_posix() for path in paths]
    assert names == [f"data/{name}/beam-tiny.hdf5" for name in ("train", "valid", "test")]
    return folder


def check_field(file: h5py.File, field: h5py.Dataset, order: int) -> None:
    """Check one field by the rules of the specification."""
    sizes = [file["dimensions"][name].shape[-1] for name in "xyz"]
    expected = [file.attrs["n_trajectories"]] if field.attrs["sample_varying"] else []
    expected += [file["dimensions/time"].shape[-1]] if field.attrs["time_varying"] else []
    varying = field.attrs["dim_varying"]
    assert varying.dtype == bool
    expected += [size for size, varies in zip(sizes, varying, strict=True) if varies]
    assert field.shape == (*expected, *[3] * order)
    assert field.dtype == np.float32


def test_every_file_follows_the_specification(exported: Path, tiny: Dataset) -> None:
    for folder, part in {"train": tiny.train, "valid": tiny.validation, "test": tiny.test}.items():
        with h5py.File(exported / "data" / folder / "beam-tiny.hdf5") as file:
            assert file.attrs["dataset_name"] == "beam-tiny"
            assert file.attrs["grid_type"] == "cartesian"
            assert (file.attrs["n_spatial_dims"], file.attrs["n_trajectories"]) == (3, len(part))
            assert list(file.attrs["simulation_parameters"]) == ["young_pa", "poisson"]
            assert (file.attrs["young_pa"], file.attrs["poisson"]) == (500.0, 0.4)
            assert set(file) == {
                "boundary_conditions",
                "dimensions",
                "scalars",
                *(f"t{order}_fields" for order in range(3)),
            }
            assert list(file["dimensions"].attrs["spatial_dims"]) == ["x", "y", "z"]
            for name in ("time", *"xyz"):
                assert not file["dimensions"][name].attrs["sample_varying"]
            for order in range(3):
                group = file[f"t{order}_fields"]
                assert set(group.attrs["field_names"]) == set(group)
                for field in group.values():
                    check_field(file, field, order)
            for name in file["scalars"].attrs["field_names"]:
                scalar = file["scalars"][name]
                assert scalar.attrs["sample_varying"]
                assert not scalar.attrs["time_varying"]
                assert scalar.shape == (len(part),)
            wall = file["boundary_conditions/x_wall"]
            assert (wall.attrs["bc_type"], list(wall.attrs["associated_dims"])) == ("WALL", ["x"])
            np.testing.assert_array_equal(wall["mask"][()], [1, 0, 0, 0, 0, 0, 0])


def test_fields_lie_where_their_nodes_are(exported: Path, tiny: Dataset) -> None:
    with h5py.File(exported / "data" / "test" / "beam-tiny.hdf5") as file:
        axes = [file["dimensions"][name][()] for name in "xyz"]
        moved, force = file["t1_fields/displacement"][()], file["t1_fields/force"][()]
    assert not moved[:, 0].any()
    for node, point in enumerate(tiny.scene.mesh.points):
        i, j, k = (int(np.abs(axis - x).argmin()) for axis, x in zip(axes, point, strict=True))
        expected = tiny.test.displacements[:, node].astype(np.float32)
        np.testing.assert_array_equal(moved[:, 1, i, j, k], expected)
        np.testing.assert_array_equal(force[:, i, j, k], tiny.test.forces[:, node].astype("f4"))


def test_the_wells_own_loader_reads_the_files(exported: Path, tiny: Dataset) -> None:
    well = pytest.importorskip("the_well.data", reason="needs the package the_well")
    for folder, part in {"train": tiny.train, "valid": tiny.validation, "test": tiny.test}.items():
        read = well.WellDataset(
            path=str(exported), well_split_name=folder, n_steps_input=1, n_steps_output=1
        )
        assert len(read) == len(part)
        sample = read[3]
        for name, expected in (
            ("input_fields", np.zeros((63, 3))),
            ("output_fields", part.displacements[3].astype("f4")),
            ("constant_fields", part.forces[3].astype("f4")),
        ):
            np.testing.assert_array_equal(sample[name].numpy().reshape(-1, 3), expected)
        # One row per axis, for its two ends: 0 is a wall, 1 is open.
        assert sample["boundary_conditions"].tolist() == [[0, 1], [1, 1], [1, 1]]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_samples_come_back_exactly(dtype: Any, tiny: Dataset, tmp_path: Path) -> None:
    export_well(tiny, tmp_path / "well", dtype=dtype)
    paths = import_well(tmp_path / "well", tmp_path / "back.npz")
    assert [path.name for path in paths] == ["back.npz", "back.toml"]
    back = mor_bench.load_dataset(paths[1])
    assert back.scene.spec.title == "beam-tiny"
    for name in PARTS:
        before, after = getattr(tiny, name), getattr(back, name)
        for array in ("forces", "displacements"):
            expected = getattr(before, array).astype(dtype)
            np.testing.assert_array_equal(getattr(after, array), expected)
        np.testing.assert_array_equal(after.regions, before.regions)
    mesh = tiny.scene.mesh
    np.testing.assert_array_equal(back.scene.mesh.points, mesh.points.astype(dtype))
    np.testing.assert_array_equal(back.scene.mesh.cells, mesh.cells)
    np.testing.assert_array_equal(back.scene.fixed_nodes, tiny.scene.fixed_nodes)
    assert back.scene.mesh.grid_shape == mesh.grid_shape
    again = export_well(back, tmp_path / "again", dtype=dtype)
    with h5py.File(again[0]) as one, h5py.File(tmp_path / "well/data/train/beam-tiny.hdf5") as two:
        for name in ("t1_fields/force", "t1_fields/displacement", "scalars/load_region"):
            np.testing.assert_array_equal(one[name][()], two[name][()])


def test_fixed_nodes_that_fill_no_plane_come_back(tiny: Dataset, tmp_path: Path) -> None:
    fewer = tiny.scene.fixed_nodes[:-1]
    data = replace(tiny, scene=replace(tiny.scene, fixed_nodes=fewer))
    export_well(data, tmp_path / "well")
    back = mor_bench.load_scene(import_well(tmp_path / "well", tmp_path / "back.npz")[1])
    np.testing.assert_array_equal(back.fixed_nodes, fewer)


def test_steps_of_a_growing_force_become_samples(exported: Path, tmp_path: Path) -> None:
    """A file of another simulation: trajectories in which force and displacement vary."""
    path = tmp_path / "steps.hdf5"
    shutil.copy(exported / "data/test/beam-tiny.hdf5", path)
    with h5py.File(path, "a") as file:
        group = file["t1_fields"]
        moved, force = group["displacement"][:5], group["force"][:5]
        for name, field in {"displacement": moved[:, 1], "force": force}.items():
            attributes = dict(group[name].attrs)
            del group[name]
            values = np.arange(4.0, dtype="f4").reshape(1, 4, 1, 1, 1, 1) * field[:, None]
            group[name] = values
            group[name].attrs.update({**attributes, "time_varying": True})
        del file["dimensions/time"]
        file["dimensions/time"] = np.arange(4.0)
        del file["scalars/load_region"]
        file["scalars"].attrs["field_names"] = []
        file.attrs["n_trajectories"] = 5
    written, toml = import_well(path, tmp_path / "back.npz")
    with np.load(written) as arrays:
        assert "test" not in arrays
        assert arrays["regions"].ravel().tolist() == np.repeat(range(5), 3).tolist()
        steps = np.arange(1.0, 4.0, dtype="f4")[:, None, None]
        expected = np.concatenate([steps * each.reshape(1, -1, 3) for each in force])
        np.testing.assert_array_equal(arrays["forces"], expected)
    data = mor_bench.load_dataset(toml)
    parts = [set(part.loads.patches.ravel()) for part in (data.train, data.test, data.validation)]
    assert all(parts[0].isdisjoint(part) for part in parts[1:])
    assert parts[1].isdisjoint(parts[2])
    with h5py.File(path, "a") as file:
        file["t1_fields/displacement"][0, 0, 4, 1, 1, 0] = 0.2
    with pytest.raises(StoreError, match=r"must be zero wherever no force acts, .*; got up to 0.2"):
        import_well(path, tmp_path / "other.npz")


def test_scenes_that_are_no_whole_grid_are_refused(tiny: Dataset, tmp_path: Path) -> None:
    whole = tiny.scene.mesh
    moved = whole.points.copy()
    moved[40, 1] += 0.01
    meshes = {
        "its cells are not hexahedra": box_mesh((2.0, 1.0, 1.0), (6, 2, 2), tetrahedra=True),
        r"a part of a grid \(20 of 24 cells\)": l_mesh((2.0, 1.0, 1.0), (6, 2, 2), (2, 1)),
        "its mesh is not a regular grid": replace(whole, grid_shape=None, grid_index=None),
        "its nodes are not on planes of equal x, y and z": replace(whole, points=moved),
    }
    for message, mesh in meshes.items():
        data = replace(tiny, scene=replace(tiny.scene, mesh=mesh))
        with pytest.raises(UnsupportedSceneError, match=f"in the layout of The Well: .*{message}"):
            export_well(data, tmp_path / "out")
    varying = replace(tiny, scene=mor_bench.load_scene("beam-stiffness"))
    with pytest.raises(UnsupportedSceneError, match="its body varies between samples"):
        export_well(varying, tmp_path / "out")
    with pytest.raises(InvalidInputError, match="`dtype` must be float32 or float64; got 'int8'"):
        export_well(tiny, tmp_path / "out", dtype="int8")  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_nothing_is_overwritten(exported: Path, tiny: Dataset, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"beam-tiny.hdf5 exists and is not overwritten"):
        export_well(tiny, exported)
    (tmp_path / "back.toml").write_text("mine")
    with pytest.raises(InvalidInputError, match=r"back.toml exists and is not overwritten"):
        import_well(exported, tmp_path / "back.npz")


def removed(name: str) -> Callable[[h5py.File], None]:
    return lambda file: file.__delitem__(name)


def attribute(item: str, name: str, value: Any) -> Callable[[h5py.File], None]:
    return lambda file: file[item].attrs.__setitem__(name, value)


def replaced(name: str, values: Any) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        attributes = dict(file[name].attrs)
        del file[name]
        file[name] = values
        file[name].attrs.update(attributes)

    return change


def one_entry(name: str, value: float) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        flat = file[name][()]
        flat.reshape(-1)[-1] = value
        file[name][...] = flat

    return change


def first_step(value: float) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[DISPLACEMENT][3, 0, 5, 1, 1, 2] = value

    return change


DISPLACEMENT = "t1_fields/displacement"
DAMAGES: list[tuple[Callable[[h5py.File], None], str]] = [
    (attribute("/", "grid_type", "spherical"), "`grid_type` must be 'cartesian'; got 'spherical'"),
    (attribute("/", "grid_type", 3), "the attribute `grid_type` must be a text"),
    (attribute("/", "n_spatial_dims", 2), "`n_spatial_dims` must be 3; got 2"),
    (attribute("/", "n_trajectories", 41), r"`.*force` must have shape \(41, 7, 3, 3, 3\); got"),
    (attribute("/", "n_trajectories", -1), "`n_trajectories` must be at least 1"),
    (attribute("dimensions", "spatial_dims", ["x", "y"]), "`spatial_dims` must be three names"),
    (attribute("dimensions", "spatial_dims", [1, 2, 3]), "`spatial_dims` .* a list of texts"),
    (attribute("dimensions/x", "sample_varying", True), "`sample_varying` of `/dimensions/x` .* F"),
    (attribute(DISPLACEMENT, "time_varying", "yes"), "`time_varying` .* must be true or false"),
    (attribute(DISPLACEMENT, "dim_varying", [True, True, False]), "`dim_varying` .* three times"),
    (attribute("t1_fields", "field_names", ["force"]), "no vector field is called 'displacement'"),
    (
        attribute("boundary_conditions/x_wall", "bc_type", "PERIODIC"),
        "WALL or OPEN; got 'PERIODIC'",
    ),
    (removed("t1_fields"), "the group `t1_fields` is missing"),
    (removed(DISPLACEMENT), "the array `/t1_fields/displacement` is missing"),
    (removed("dimensions/y"), "the array `/dimensions/y` is missing"),
    (removed("boundary_conditions/x_wall/mask"), "the array `/boundary_conditions/x_wall/mask`"),
    (replaced("dimensions/z", [0.0, 1.0, 0.5]), "two growing coordinates; got 0.5 after 1"),
    (replaced("dimensions/z", [1.0, 0.5, 0.0]), "`/dimensions/z` .* growing .*; got 0.5 after 1"),
    (replaced("dimensions/z", [[1.0, 0.5]]), r"coordinates; got an array of shape \(1, 2\)"),
    (replaced("dimensions/x", np.zeros(7)), "`/dimensions/x` must be at least two growing"),
    (
        replaced(DISPLACEMENT, np.zeros((3, 2))),
        r"must have shape \(40, 2, 7, 3, 3, 3\); got \(3, 2",
    ),
    (replaced(DISPLACEMENT, ["a"]), "`/t1_fields/displacement` must hold numbers; got object"),
    (replaced("boundary_conditions/x_wall/mask", np.ones(6, bool)), "an entry per point of its"),
    (replaced("scalars/load_region", [1, 2]), r"must have shape \(40,\); got \(2,\)"),
    (first_step(0.3), r"'displacement' must be zero in the first time step, .*; got up to 0.3 m"),
    (one_entry(DISPLACEMENT, np.nan), "its samples are refused: .*`displacements` must be finite"),
    (one_entry("t1_fields/force", np.inf), "its samples are refused: .*`forces` must be finite"),
    (
        one_entry("boundary_conditions/x_wall/mask", True),
        "its samples are refused: .*`displacements` must be zero at `fixed_nodes`",
    ),
    (
        lambda f: f.__setitem__("x", h5py.ExternalLink("/etc/passwd", "/")),
        "a link to another place",
    ),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_a_damaged_file_gives_one_clear_error(
    damage: Callable[[h5py.File], None], message: str, exported: Path, tmp_path: Path
) -> None:
    path = tmp_path / "bad.hdf5"
    shutil.copy(exported / "data/test/beam-tiny.hdf5", path)
    with h5py.File(path, "a") as file:
        damage(file)
    with pytest.raises(StoreError, match=message) as refused:
        import_well(path, tmp_path / "back.npz")
    assert "bad.hdf5: " in str(refused.value)
    assert "\n" not in str(refused.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.hdf5"]


def test_cut_and_scrambled_files_are_refused(exported: Path, tmp_path: Path) -> None:
    content = (exported / "data/test/beam-tiny.hdf5").read_bytes()
    path, generator = tmp_path / "bad.hdf5", np.random.default_rng(0)
    for size in (0, 7, 1000, len(content) // 2, len(content) - 9):
        path.write_bytes(content[:size])
        with pytest.raises(StoreError, match=r"bad.hdf5: "):
            import_well(path, tmp_path / "back.npz")
    for _ in range(40):  # the structure lies at the beginning; values have no checksum
        changed = np.frombuffer(content, dtype=np.uint8).copy()
        changed[generator.integers(8, 6000, 12)] = generator.integers(0, 256, 12)
        path.write_bytes(changed.tobytes())
        written: list[Path] = []
        with suppress(StoreError):  # any other error fails the test
            written = import_well(path, tmp_path / "back.npz")
        for file in written:
            file.unlink()


def test_a_folder_needs_both_parts_and_one_body(
    exported: Path, tiny: Dataset, tmp_path: Path
) -> None:
    with pytest.raises(StoreError, match=r"data/train must hold files that end in .h5 or .hdf5"):
        import_well(tmp_path, tmp_path / "back.npz")
    folder = tmp_path / "two"
    shutil.copytree(exported, folder)
    with h5py.File(folder / "data/test/beam-tiny.hdf5", "a") as file:
        file["dimensions/x"][...] = 2 * file["dimensions/x"][()]
    with pytest.raises(StoreError, match="its grid or its walls differ from those in"):
        import_well(folder, tmp_path / "back.npz")
    with pytest.raises(FileNotFoundError):
        import_well(tmp_path / "none.hdf5", tmp_path / "back.npz")
