"""Snapshots of other programs: who competes on them, who says why not, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import (
    InvalidInputError,
    MissingDependencyError,
    SpecError,
    StoreError,
    UnsupportedSceneError,
)
from mor_bench.export.npz_file import snapshot_arrays
from mor_bench.measure.discretisation_error import refine
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.runs.configurations import CORE_METHODS, DATA_METHODS, checked_specs
from mor_bench.runs.file_check import check_file
from mor_bench.scene.mesh import box_mesh
from mor_bench.scene.snapshot_file import MAX_SIZE
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.given import MAX_FORCE_N
from mor_bench.specs import ImportedDatasetSpec, list_suite, load_generated_spec
from tests.commands import mor_bench_command as command

Arrays = dict[str, NDArray[Any]]

TOML = 'title = "Mine"\nsource = "SOFA"\n[snapshots]\nfile = "mine.npz"\n[needs]\nerror = 0.01\nlatency_ms = 3.0\n'

COMPETE = {
    "pca-regression-force",
    "pca-polynomial-force",
    "pod-nn-force",
    "sparse-polynomial-force",
    "pgd-force",
    "umesh",
    "umesh-small",
}
COMPETE |= {"deeponet", "pod-deeponet", "fno", "mesh-graph-net"}
CHEAP = {name: {"channels": 4, "steps": 1, "iterations": 5} for name in ("umesh", "umesh-small")}
CHEAP |= {"deeponet": {"iterations": 5}, "pod-deeponet": {"iterations": 5}}
CHEAP |= {
    "fno": {"channels": 4, "layers": 2, "iterations": 5},
    "mesh-graph-net": {"width": 8, "steps": 2, "iterations": 5},
}


@pytest.fixture(scope="module")
def arrays(tiny: Dataset) -> Arrays:
    """The samples of beam-tiny as another program would write them."""
    found = snapshot_arrays(tiny)
    del found["test"]
    return found


def written(folder: Path, arrays: Arrays, text: str = TOML) -> Path:
    """The TOML of a dataset of these arrays."""
    if 'file = "mine.npz"' in text:
        np.savez(folder / "mine.npz", **arrays)  # type: ignore[arg-type]
    else:
        with h5py.File(folder / "mine.h5", "w") as file:
            for name, array in arrays.items():
                file[name] = array
    (folder / "mine.toml").write_text(text)
    return folder / "mine.toml"


@pytest.mark.parametrize("text", [TOML, TOML.replace(".npz", ".h5")])
def test_what_is_read_is_what_was_written(
    text: str, arrays: Arrays, tiny: Dataset, tmp_path: Path
) -> None:
    data = mor_bench.load_dataset(written(tmp_path, arrays, text))
    assert isinstance(data.scene.spec, ImportedDatasetSpec)
    np.testing.assert_array_equal(data.scene.mesh.points, tiny.scene.mesh.points)
    np.testing.assert_array_equal(data.scene.mesh.cells, tiny.scene.mesh.cells)
    np.testing.assert_array_equal(data.scene.fixed_nodes, tiny.scene.fixed_nodes)
    assert data.scene.material is None
    assert len(data.train) + len(data.test) == len(arrays["forces"])
    rows = {
        force.tobytes(): u
        for force, u in zip(arrays["forces"], arrays["displacements"], strict=True)
    }
    for part in (data.train, data.test):
        for force, u in zip(part.forces, part.displacements, strict=True):
            np.testing.assert_array_equal(u, rows[force.tobytes()])
    assert not set(data.train.regions) & set(data.test.regions)
    with pytest.raises(ValueError, match="read-only"):
        data.train.forces[0] = 0


def test_splits(arrays: Arrays, tmp_path: Path) -> None:
    path = written(tmp_path, arrays)
    n = len(arrays["forces"])
    assert len(mor_bench.load_dataset(path, split="sample").test) == round(0.2 * n)
    by_direction = mor_bench.load_dataset(path, split="direction")
    sums = [part.forces.sum(axis=1) for part in (by_direction.train, by_direction.test)]
    train, test = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in sums)
    axis = test.mean(axis=0)
    assert (test @ axis).min() > (train @ axis).max() - 0.2 * np.linalg.norm(axis)
    assert len(mor_bench.load_dataset(path, 50).train) < 50
    test = mor_bench.load_dataset(path).test.forces
    far = written(tmp_path, {**arrays, "regions": 10**15 * arrays["regions"]})
    np.testing.assert_array_equal(mor_bench.load_dataset(far).test.forces, test)
    without = {name: array for name, array in arrays.items() if name != "regions"}
    assert len(mor_bench.load_dataset(written(tmp_path, without), split="sample").test) == round(
        0.2 * n
    )
    with pytest.raises(
        InvalidInputError,
        match=r"a split by region needs the array `regions` in .*mine.npz; or split by sample",
    ):
        mor_bench.load_dataset(path)
    held = np.arange(n) % 3 == 0
    by_file = written(
        tmp_path, {**arrays, "test": held}, TOML.replace(".npz", ".h5") + '[split]\nby = "file"\n'
    )
    np.testing.assert_array_equal(
        mor_bench.load_dataset(by_file).test.forces, arrays["forces"][held]
    )
    as_numbers = written(
        tmp_path,
        {**arrays, "test": held.astype(np.uint8)},
        TOML.replace(".npz", ".h5") + '[split]\nby = "file"\n',
    )
    np.testing.assert_array_equal(
        mor_bench.load_dataset(as_numbers).test.forces, arrays["forces"][held]
    )
    with pytest.raises(
        InvalidInputError, match="`test` must be true for some samples and false for others"
    ):
        mor_bench.load_dataset(
            written(tmp_path, {**arrays, "test": held | True}, TOML + '[split]\nby = "file"\n')
        )
    with pytest.raises(InvalidInputError, match="a split by file needs the array `test`"):
        mor_bench.load_dataset(written(tmp_path, arrays, TOML + '[split]\nby = "file"\n'))


@pytest.mark.parametrize("name", sorted(list_suite("methods")))
def test_every_method_competes_or_says_why_not(name: str, arrays: Arrays, tmp_path: Path) -> None:
    data = mor_bench.load_dataset(written(tmp_path, arrays))
    try:
        method = mor_bench.load_method(name, **CHEAP.get(name, {}))
    except MissingDependencyError as error:
        pytest.skip(str(error))
    if name == "gappy-pod":
        assert (
            method.supports(data.scene)
            == "it is given forces, and no displacements of a part of the surface to be completed"
        )
        return
    if name not in COMPETE:
        assert (
            method.supports(data.scene)
            == "its snapshots were imported, so its equations are not known"
        )
        with pytest.raises(
            UnsupportedSceneError, match="cannot handle mine: its snapshots were imported"
        ):
            method.fit(data.scene, data.train)
        return
    assert method.supports(data.scene) is None
    predicted = method.fit(data.scene, data.train).predict(data.test.forces)
    assert predicted.shape == data.test.displacements.shape
    assert not predicted[:, data.scene.fixed_nodes].any()
    method.save(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(
        mor_bench.load_surrogate(tmp_path / "model.safetensors").predict(data.test.forces[0]),
        method.predict(data.test.forces[0]),
    )
    with (tmp_path / "mine.npz").open("ab") as file:
        file.write(b"x")
    with pytest.raises(
        StoreError,
        match=r"model.safetensors: .*mine.npz: the file has changed since the dataset was read",
    ):
        mor_bench.load_surrogate(tmp_path / "model.safetensors")
    (tmp_path / "mine.npz").unlink()
    with pytest.raises(StoreError, match=r"model.safetensors: .*mine.npz: no such file"):
        mor_bench.load_surrogate(tmp_path / "model.safetensors")


@pytest.mark.parametrize(
    "none", [np.zeros(0), np.zeros(0, dtype=int), np.zeros(0, dtype=bool), np.zeros((0, 0))]
)
def test_no_node_need_be_fixed(none: NDArray[Any], arrays: Arrays, tmp_path: Path) -> None:
    assert mor_bench.load_scene(
        written(tmp_path, {**arrays, "fixed_nodes": none})
    ).fixed_nodes.shape == (0,)


def test_what_is_read_can_be_predicted_for() -> None:
    assert MAX_SIZE["forces"] == MAX_FORCE_N


def test_a_known_law_is_learned(tmp_path: Path, arrays: Arrays) -> None:
    """Displacements that are linear in the force are predicted to the ridge's accuracy, on a mesh of free nodes."""
    generator = np.random.default_rng(0)
    forces = np.zeros_like(arrays["forces"])
    forces[:, [4, 9]] = generator.normal(size=(len(forces), 2, 3))
    matrix = generator.normal(size=(6, forces[0].size))
    displacements = (forces[:, [4, 9]].reshape(len(forces), 6) @ matrix).reshape(forces.shape)
    mine = {
        "points": arrays["points"],
        "cells": arrays["cells"],
        "forces": forces,
        "displacements": displacements,
    }
    data = mor_bench.load_dataset(written(tmp_path, mine), split="sample")
    method = mor_bench.load_method("pca-regression-force", degree=1).fit(data.scene, data.train)
    np.testing.assert_allclose(
        method.predict(data.test.forces),
        data.test.displacements,
        atol=1e-4 * np.abs(displacements).max(),
    )


def test_there_is_no_full_order_model_of_it(arrays: Arrays, tmp_path: Path) -> None:
    path = written(tmp_path, arrays)
    scene = mor_bench.load_scene(path)
    for call in (
        lambda: FullOrderModel(scene),
        lambda: scene.patch_weights,
        lambda: load_generated_spec(path),
        lambda: refine(path),
    ):
        with pytest.raises(
            UnsupportedSceneError,
            match="mine: its snapshots were imported, so its equations are not known",
        ):
            call()
    with pytest.raises(
        InvalidInputError, match=r"mine has no test set '2x': its snapshots were imported"
    ):
        mor_bench.load_dataset(path, tests=["2x"])


def test_by_default_the_methods_run_that_can(arrays: Arrays, tmp_path: Path) -> None:
    path = written(tmp_path, arrays)
    assert [method.name for method in checked_specs([path], None, "quick", None)[1]] == list(
        DATA_METHODS
    )
    both = [method.name for method in checked_specs(["beam-tiny", path], None, "quick", None)[1]]
    assert both == [*CORE_METHODS, "pca-regression-force"]


def test_a_run_ends_with_tables_and_a_report(arrays: Arrays, tmp_path: Path) -> None:
    written(tmp_path, arrays)
    methods = ["-m", "fem-jacobi-pcg", "-m", "linear-fem", "-m", "pca-regression-force"]
    done = command("run", "mine.toml", *methods, "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = mor_bench.Comparison.read(tmp_path / "out").rows
    assert [row["status"] for row in rows] == ["skipped", "skipped", "ok"]
    assert rows[0]["reason"].endswith("its snapshots were imported, so its equations are not known")
    assert rows[2]["offline_s"]["data"] is None
    assert rows[2]["discretisation_error_m"] is None
    assert "mine.npz" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    checked = command("check", "mine.toml", cwd=tmp_path)
    assert (
        "dataset of imported snapshots, 24 cells, 63 nodes, 9 of them fixed, 170 samples to train and 40 to test"
        in checked.stdout
    )
    for arguments in (["generate", "mine.toml"], ["refine", "mine.toml"]):
        refused = command(*arguments, cwd=tmp_path)
        assert refused.returncode == 2
        assert (
            refused.stderr
            == "mor-bench: mine: its snapshots were imported, so its equations are not known.\n"
        )


def without(*names: str) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {name: array for name, array in arrays.items() if name not in names}


def with_(**changed: Callable[[NDArray[Any]], Any]) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {
        **arrays,
        **{name: np.asarray(change(arrays[name].copy())) for name, change in changed.items()},
    }


def put(*index: Any, value: float) -> Callable[[NDArray[Any]], NDArray[Any]]:
    def change(array: NDArray[Any]) -> NDArray[Any]:
        array[index] = value
        return array

    return change


def hinged(arrays: Arrays) -> Arrays:
    """On two blocks of a cube that have an edge in common."""
    cube = box_mesh((2.0, 2.0, 1.0), (2, 2, 1))
    cells = cube.cells[[0, 3]]
    used, cells = np.unique(cells, return_inverse=True)
    shared = {name: arrays[name][:, : len(used)] for name in ("forces", "displacements")}
    return {"points": cube.points[used], "cells": cells.reshape(2, 8), **shared}


BAD: list[tuple[Callable[[Arrays], Arrays], str]] = [
    (without("points"), "array `points` is missing"),
    (without("cells"), "array `cells` is missing"),
    (without("forces"), "array `forces` is missing"),
    (without("displacements"), "array `displacements` is missing"),
    (
        lambda a: {**a, "fixed_node": a["fixed_nodes"]},
        "unknown array `fixed_node`; did you mean 'fixed_nodes'",
    ),
    (
        lambda a: {**a, "time": a["cells"]},
        r"unknown array `time`\. Allowed: points, cells, forces, displacements, fixed_nodes, regions, test",
    ),
    (
        with_(forces=lambda f: f[:, :-1]),
        r"`forces` must have shape \(210, 63, 3\); got \(210, 62, 3\)",
    ),
    (
        with_(forces=lambda f: f.reshape(len(f), -1)),
        r"`forces` must have shape \(210, 63, 3\); got \(210, 189\)",
    ),
    (
        with_(displacements=lambda u: u[:-1]),
        r"`displacements` must have shape \(210, 63, 3\); got \(209, 63, 3\)",
    ),
    (with_(points=lambda x: x[:, :2]), r"`points` must have shape \(any, 3\); got \(63, 2\)"),
    (with_(points=lambda x: 1.0), r"`points` must have shape \(any, 3\); got \(\)"),
    (
        with_(cells=lambda c: c[:, :6]),
        r"`cells` must have shape \(any, 8\) or \(any, 4\); got \(24, 6\)",
    ),
    (with_(cells=lambda c: c.astype(float)), "`cells` must hold integers; got dtype float64"),
    (
        with_(forces=lambda f: f.astype(complex)),
        "`forces` must hold real numbers; got dtype complex128",
    ),
    (with_(forces=lambda f: f.astype(str)), "`forces` must hold real numbers; got dtype <U"),
    (with_(points=lambda x: x.astype(object)), "Object arrays cannot be loaded"),
    (
        with_(forces=put(7, 30, 1, value=np.nan)),
        r"`forces` must be finite; entry \[7, 30, 1\] is not",
    ),
    (
        with_(displacements=put(2, 1, 0, value=np.inf)),
        r"`displacements` must be finite; entry \[2, 1, 0\] is not",
    ),
    (with_(points=put(2, 1, value=np.nan)), r"`points` must be finite; entry \[2, 1\] is not"),
    (
        with_(cells=put(0, 0, value=63)),
        r"cells must have nodes in \[0, 62\]; got 1 to 63|cells must have nodes in \[0, 62\]; got 0 to 63",
    ),
    (with_(cells=put(0, 0, value=-1)), r"cells must have nodes in \[0, 62\]; got -1 to 62"),
    (
        with_(cells=lambda c: c[1:]),
        r"every node must belong to a cell; 1 of 63 do not|every node must belong to a cell; \d of 63 do not",
    ),
    (with_(cells=put(3, 0, value=50)), "cell 3 .* is flat or folded"),
    (hinged, "the mesh must be one body; it is 2 parts that no face joins"),
    (with_(cells=lambda c: c[:0]), "there must be points and cells"),
    (with_(fixed_nodes=put(0, value=63)), r"`fixed_nodes` must be in \[0, 62\]; got 1 to 63"),
    (with_(fixed_nodes=lambda n: np.arange(63)), "`fixed_nodes` holds every node"),
    (
        with_(fixed_nodes=lambda n: [*n, 40]),
        r"`displacements` must be zero at `fixed_nodes`; sample \d+ has \S+ m",
    ),
    (with_(regions=lambda r: r - 1), "`regions` must be ids from 0 on"),
    (
        with_(regions=lambda r: r[:-1]),
        r"`regions` must have shape \(210,\) or \(210, any\); got \(209,\)",
    ),
    (
        lambda a: {**a, "test": np.arange(210) % 3},
        "`test` must hold booleans, or 0 and 1 as integers; got 0 to 2",
    ),
    (
        lambda a: {**a, "test": np.zeros(210)},
        "`test` must hold booleans, or 0 and 1 as integers; got dtype float64",
    ),
    (
        with_(forces=put(7, 30, 1, value=-1e31)),
        r"`forces` must be in \[-1e\+30, 1e\+30\] N; entry \[7, 30, 1\] is -1e\+31",
    ),
    (
        with_(displacements=put(2, 30, 0, value=1e200)),
        r"`displacements` must be in \[-1e\+30, 1e\+30\] m; entry \[2, 30, 0\] is 1e\+200",
    ),
    (
        with_(forces=lambda f: 0 * f),
        "`forces` must differ from zero somewhere, and be at most .* N; got zeros only",
    ),
    (
        with_(displacements=lambda u: 0 * u),
        "`displacements` must differ from zero somewhere, and be at most .* m; got zeros only",
    ),
    (
        with_(points=lambda x: np.vstack([x[:1], x[:1], x[2:]])),
        "1 nodes coincide with others",
    ),
    (with_(cells=lambda c: np.vstack([c, c[:1]])), "some cells are there twice"),
    (
        with_(fixed_nodes=lambda n: n.astype(float)),
        "`fixed_nodes` must hold integers; got dtype float64",
    ),
    (
        with_(forces=lambda f: np.concatenate([f[:1], f[:1], f[2:]])),
        "`forces`: 1 samples repeat others",
    ),
    (
        with_(forces=lambda f: f[:0], displacements=lambda u: u[:0], regions=lambda r: r[:0]),
        "there must be samples; got none",
    ),
    (with_(regions=lambda r: r * 0), "210 samples cannot be split by region"),
    (
        with_(forces=lambda f: f[:1], displacements=lambda u: u[:1], regions=lambda r: r[:1]),
        "1 samples cannot be split by region",
    ),
]


@pytest.mark.parametrize(("spoil", "message"), BAD)
def test_bad_arrays_are_one_clear_line(
    spoil: Callable[[Arrays], Arrays], message: str, arrays: Arrays, tmp_path: Path
) -> None:
    path = written(tmp_path, spoil(arrays))
    with pytest.raises((SpecError, InvalidInputError), match=message) as caught:
        check_file(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "bytes_", "message"),
    [
        ("mine.npz", b"", r"mine.npz: not a readable .npz file of arrays"),
        (
            "mine.npz",
            b"\x80\x04cos\nsystem\n.",
            r"mine.npz: not a readable .npz file of arrays: File is not a zip file",
        ),
        ("mine.h5", b"\x89HDF", r"mine.h5: not a readable .h5 file of arrays"),
        ("mine.csv", b"1,2", r"snapshots must be in an .npz, .h5 or .hdf5 file; got '.csv'"),
    ],
)
def test_bad_files_are_one_clear_line(
    file: str, bytes_: bytes, message: str, tmp_path: Path
) -> None:
    (tmp_path / file).write_bytes(bytes_)
    (tmp_path / "mine.toml").write_text(TOML.replace("mine.npz", file))
    with pytest.raises(SpecError, match=message) as caught:
        check_file(tmp_path / "mine.toml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (None, "`forces` must be an array of numbers; got a group"),
        ("hi", "`forces` must be an array of numbers; got text"),
        (3.0, r"`forces` must have shape \(1, 63, 3\); got \(\)"),
        (h5py.ExternalLink("nowhere.h5", "/forces"), "`forces` cannot be read: .*"),
    ],
)
def test_entries_of_hdf5_that_are_no_arrays_are_named(
    entry: Any, message: str, arrays: Arrays, tmp_path: Path
) -> None:
    path = written(tmp_path, without("forces")(arrays), TOML.replace(".npz", ".h5"))
    with h5py.File(tmp_path / "mine.h5", "a") as file:
        if entry is None:
            file.create_group("forces")
        else:
            file["forces"] = entry
    with pytest.raises(SpecError, match=rf"mine.h5: {message}") as caught:
        check_file(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            TOML.replace("mine.npz", "other.npz"),
            r"`snapshots.file`: .*other.npz: no such file; got 'other.npz'",
        ),
        (TOML + "[geometry]\n", "unknown key `geometry`"),
        (TOML.replace("file =", "fiel ="), "unknown key `snapshots.fiel`; did you mean 'file'"),
        (TOML + '[split]\nby = "regoin"\n', "`split.by"),
    ],
)
def test_bad_dataset_files_are_one_clear_line(
    text: str, message: str, arrays: Arrays, tmp_path: Path
) -> None:
    written(tmp_path, arrays)
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(SpecError, match=message):
        check_file(tmp_path / "mine.toml")


def test_two_datasets_are_told_apart_by_their_content(arrays: Arrays, tmp_path: Path) -> None:
    spec = mor_bench.load_scene(written(tmp_path, arrays)).spec
    (tmp_path / "moved").mkdir()
    shutil.copy(tmp_path / "mine.npz", tmp_path / "moved")
    (tmp_path / "moved" / "mine.toml").write_text(TOML)
    assert mor_bench.load_scene(tmp_path / "moved" / "mine.toml").spec.digest() == spec.digest()
    other = with_(forces=lambda f: 2 * f)(arrays)
    assert mor_bench.load_scene(written(tmp_path, other)).spec.digest() != spec.digest()
