"""Snapshots of other programs: supported methods and refused files."""

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
from mor_bench.errors import InvalidInputError, SpecError, StoreError, UnsupportedSceneError
from mor_bench.export.npz_file import snapshot_arrays
from mor_bench.measure.discretisation_error import refine
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.options import RunOptions
from mor_bench.runs.configurations import CORE_METHODS, DATA_METHODS, checked_specs
from mor_bench.runs.durations import Pace
from mor_bench.runs.file_check import check_file
from mor_bench.runs.plan import plan
from mor_bench.scene.snapshot_file import MAX_SIZE
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.given import MAX_FORCE_N
from mor_bench.specs import ImportedDatasetSpec, load_generated_spec
from tests.commands import invoke as command
from tests.small_runs import keep_fit_record, short_timing
from tests.spoiled_arrays import Arrays, doubled, first, hinged, put, with_, without
from tests.suite_methods import SPECS, cheap_method

TOML = """title = "Mine"
source = "SOFA"
[snapshots]
file = "mine.npz"
[needs]
error = 0.01
latency_ms = 3.0
"""
BY_FILE = TOML + '[split]\nby = "file"\n'
IMPORTED = "its snapshots were imported, so its equations are not known"


@pytest.fixture(scope="module")
def arrays(tiny: Dataset) -> Arrays:
    """The samples of beam-tiny in the form that another program would write."""
    found = snapshot_arrays(tiny)
    del found["test"], found["validation"]
    return found


def written(folder: Path, arrays: Arrays, text: str = TOML) -> Path:
    """Write a dataset of these arrays and return its TOML."""
    if 'file = "mine.npz"' in text:
        np.savez(folder / "mine.npz", **arrays)  # type: ignore[arg-type]
    else:
        with h5py.File(folder / "mine.h5", "w") as file:
            for name, array in arrays.items():
                file[name] = array
    (folder / "mine.toml").write_text(text)
    return folder / "mine.toml"


@pytest.mark.parametrize("text", [TOML, TOML.replace(".npz", ".h5")])
def test_the_arrays_are_read_as_they_were_written(
    text: str, arrays: Arrays, tiny: Dataset, tmp_path: Path
) -> None:
    data = mor_bench.load_dataset(written(tmp_path, arrays, text))
    scene, original = data.scene, tiny.scene
    assert isinstance(scene.spec, ImportedDatasetSpec)
    np.testing.assert_array_equal(scene.mesh.points, original.mesh.points)
    np.testing.assert_array_equal(scene.mesh.cells, original.mesh.cells)
    np.testing.assert_array_equal(scene.fixed_nodes, original.fixed_nodes)
    assert scene.material is None
    parts = (data.train, data.validation, data.test)
    assert sum(map(len, parts)) == len(arrays["forces"])
    pairs = zip(arrays["forces"], arrays["displacements"], strict=True)
    answers = {force.tobytes(): u for force, u in pairs}
    for part in parts:
        for force, u in zip(part.forces, part.displacements, strict=True):
            np.testing.assert_array_equal(u, answers[force.tobytes()])
    assert not set(data.train.regions) & set(data.test.regions)
    assert not set(data.train.regions) & set(data.validation.regions)
    with pytest.raises(ValueError, match="read-only"):
        data.train.forces[0] = 0


def test_imported_samples_are_split_by_sample_direction_and_region(
    arrays: Arrays, tmp_path: Path
) -> None:
    path, n = written(tmp_path, arrays), len(arrays["forces"])
    assert len(mor_bench.load_dataset(path, split="sample").test) == round(0.2 * n)
    by_direction = mor_bench.load_dataset(path, split="direction")
    sums = [part.forces.sum(axis=1) for part in (by_direction.train, by_direction.test)]
    train, test = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in sums)
    axis = test.mean(axis=0)
    assert (test @ axis).min() > (train @ axis).max() - 0.2 * np.linalg.norm(axis)
    assert len(mor_bench.load_dataset(path, 50).train) < 50
    expected = mor_bench.load_dataset(path).test.forces
    far = written(tmp_path, {**arrays, "regions": 10**15 * arrays["regions"]})
    np.testing.assert_array_equal(mor_bench.load_dataset(far).test.forces, expected)
    path = written(tmp_path, without("regions")(arrays))
    assert len(mor_bench.load_dataset(path, split="sample").test) == round(0.2 * n)
    message = r"a split by region needs the array `regions` in .*mine.npz; or split by sample"
    with pytest.raises(InvalidInputError, match=message):
        mor_bench.load_dataset(path)


def test_a_plan_counts_the_training_samples_of_the_file(
    arrays: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Pace, "measured", lambda *_: Pace(1.0, 1.0, 1.0))
    path, method = written(tmp_path, arrays), SPECS["pca-regression"]
    data = mor_bench.load_dataset(path)
    size = data.scene.mesh.n_dofs, len(data.train)
    keep_fit_record(tmp_path, method.name, method.configurations("quick")[0], size, 7.0)
    assert plan([path], [method.name], cache=tmp_path).steps[1].seconds == pytest.approx(7.0)


def test_imported_samples_are_split_as_the_file_specifies(arrays: Arrays, tmp_path: Path) -> None:
    held = np.arange(len(arrays["forces"])) % 3 == 0
    for test in (held, held.astype(np.uint8)):
        path = written(tmp_path, {**arrays, "test": test}, BY_FILE.replace(".npz", ".h5"))
        found = mor_bench.load_dataset(path).test.forces
        np.testing.assert_array_equal(found, arrays["forces"][held])
    message = "`test` must be true for some samples and false for others"
    with pytest.raises(InvalidInputError, match=message):
        mor_bench.load_dataset(written(tmp_path, {**arrays, "test": held | True}, BY_FILE))
    with pytest.raises(InvalidInputError, match="a split by file needs the array `test`"):
        mor_bench.load_dataset(written(tmp_path, arrays, BY_FILE))


QUICK = {"fem", "pod", "gappy-pod", "pca-regression-linear", "pca-regression"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in sorted(SPECS)]
)
def test_every_method_runs_or_gives_its_reason(name: str, arrays: Arrays, tmp_path: Path) -> None:
    data = mor_bench.load_dataset(written(tmp_path, arrays))
    method = cheap_method(name)
    if hasattr(method, "iterations"):
        method.iterations = 5
    reason = method.supports(data.scene)
    if reason is not None:
        assert reason == IMPORTED or (name == "gappy-pod" and "the scene gives forces" in reason)
        with pytest.raises(UnsupportedSceneError, match=f"cannot handle mine: {reason}"):
            method.fit(data.scene, data.train)
        return
    predicted = method.fit(data.scene, data.train).predict(data.test.forces)
    assert predicted.shape == data.test.displacements.shape
    assert not predicted[:, data.scene.fixed_nodes].any()
    path, source = tmp_path / "model.safetensors", tmp_path / "mine.npz"
    method.save(path)
    found = mor_bench.load_surrogate(path).predict(data.test.forces[0])
    np.testing.assert_array_equal(found, method.predict(data.test.forces[0]))
    with source.open("ab") as file:
        file.write(b"x")
    changed = r"model.safetensors: .*mine.npz: the file has changed since the dataset was read"
    with pytest.raises(StoreError, match=changed):
        mor_bench.load_surrogate(path)
    source.unlink()
    with pytest.raises(StoreError, match=changed):
        mor_bench.load_surrogate(path)


@pytest.mark.parametrize(
    "none", [np.zeros(0), np.zeros(0, dtype=int), np.zeros(0, dtype=bool), np.zeros((0, 0))]
)
def test_a_mesh_without_fixed_nodes_is_accepted(
    none: NDArray[Any], arrays: Arrays, tmp_path: Path
) -> None:
    scene = mor_bench.load_scene(written(tmp_path, {**arrays, "fixed_nodes": none}))
    assert scene.fixed_nodes.shape == (0,)


def test_every_force_that_can_be_read_has_a_prediction() -> None:
    assert MAX_SIZE["forces"] == MAX_FORCE_N


def test_a_linear_law_is_learned(tmp_path: Path, arrays: Arrays) -> None:
    """On a mesh of free nodes, only the ridge regularisation causes an error."""
    generator = np.random.default_rng(0)
    forces = np.zeros_like(arrays["forces"])
    forces[:, [4, 9]] = generator.normal(size=(len(forces), 2, 3))
    matrix = generator.normal(size=(6, forces[0].size))
    displacements = (forces[:, [4, 9]].reshape(len(forces), 6) @ matrix).reshape(forces.shape)
    mine = {**arrays, "forces": forces, "displacements": displacements}
    path = written(tmp_path, without("fixed_nodes", "regions")(mine))
    data = mor_bench.load_dataset(path, split="sample")
    method = mor_bench.load_method("pca-regression", degree=1).fit(data.scene, data.train)
    found, expected = method.predict(data.test.forces), data.test.displacements
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(displacements).max())


def test_imported_snapshots_have_no_full_order_model(arrays: Arrays, tmp_path: Path) -> None:
    path = written(tmp_path, arrays)
    scene = mor_bench.load_scene(path)
    for call in (
        lambda: FullOrderModel(scene),
        lambda: scene.patch_weights,
        lambda: load_generated_spec(path),
        lambda: refine(path),
    ):
        with pytest.raises(UnsupportedSceneError, match=f"mine: {IMPORTED}"):
            call()
    message = r"mine has no test set '2x': its snapshots were imported"
    with pytest.raises(InvalidInputError, match=message):
        mor_bench.load_dataset(path, tests=["2x"])


@pytest.mark.slow
def test_only_methods_that_learn_from_samples_run_by_default(
    arrays: Arrays, tmp_path: Path
) -> None:
    path = written(tmp_path, arrays)
    alone = checked_specs([path], None, RunOptions()).methods
    assert [spec.name for spec in alone] == list(DATA_METHODS)
    both = checked_specs(["beam-tiny", path], None, RunOptions()).methods
    assert [spec.name for spec in both] == list(dict.fromkeys([*CORE_METHODS, *DATA_METHODS]))


@pytest.mark.slow
def test_a_run_ends_with_tables_and_a_report(
    arrays: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path, arrays)
    monkeypatch.chdir(tmp_path)
    methods = ["-m", "fem-jacobi-pcg", "-m", "linear-fem", "-m", "pca-regression"]
    with short_timing():
        done = command("run", "mine.toml", *methods, "--out", "out", "--cache", "cache")
    assert done.exit_code == 0, done.output
    rows = mor_bench.Comparison.read(tmp_path / "out").rows
    assert [row.status for row in rows] == ["skipped", "skipped", "ok"]
    assert (rows[0].reason or "").endswith(IMPORTED)
    assert rows[2].offline_s is not None
    assert rows[2].offline_s.data is None
    assert rows[2].discretisation_error_m is None
    assert "mine.npz" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    checked = " ".join(command("check", "mine.toml").stdout.split())
    counts = (
        "24 cells, 63 nodes, 9 of them fixed, 140 samples to train, 30 to validate and 40 to test"
    )
    assert f"dataset of imported snapshots, {counts}" in checked
    for verb in ("generate", "refine"):
        refused = command(verb, "mine.toml")
        assert refused.exit_code == 2
        assert refused.stderr.endswith(f"mor-bench: mine: {IMPORTED}.\n")


BOTH = "`test` and `validation` must exclude each other; 210 samples are both"
TEST = "`test` must hold booleans, or 0 and 1 as integers; "
RANGE = r"must be in \[-1e\+30, 1e\+30\] "
ZERO = "must differ from zero somewhere, and be at most .* {}; got zeros only"
BAD: list[tuple[Callable[[Arrays], Arrays], str]] = [
    (without("points"), "array `points` is missing"),
    (without("cells"), "array `cells` is missing"),
    (without("forces"), "array `forces` is missing"),
    (without("displacements"), "array `displacements` is missing"),
    (lambda a: {**a, "fixed_node": a["cells"]}, "`fixed_node`; did you mean 'fixed_nodes'"),
    (lambda a: {**a, "time": a["cells"]}, r"unknown array `time`\. Allowed: points, .*, test"),
    (with_(forces=lambda f: f[:, :-1]), r"`forces` must have .* got \(210, 62, 3\)"),
    (with_(forces=lambda f: f.reshape(210, -1)), r"shape \(210, 63, 3\); got \(210, 189\)"),
    (with_(displacements=lambda u: u[:-1]), r"`displacements` must have .* got \(209, 63, 3\)"),
    (with_(points=lambda x: x[:, :2]), r"`points` must have shape \(any, 3\); got \(63, 2\)"),
    (with_(points=lambda x: 1.0), r"`points` must have shape \(any, 3\); got \(\)"),
    (
        with_(cells=lambda c: c[:, :6]),
        r"shape \(any, 8\) or \(any, 4\) or \(any, 10\); got \(24, 6\)",
    ),
    (with_(cells=lambda c: c.astype(float)), "`cells` must hold integers; got dtype float64"),
    (with_(forces=lambda f: f.astype(complex)), "must hold real numbers; got dtype complex128"),
    (with_(forces=lambda f: f.astype(str)), "`forces` must hold real numbers; got dtype <U"),
    (with_(points=lambda x: x.astype(object)), "it holds Python objects, which are not loaded"),
    (with_(forces=put(7, 30, 1, value=np.nan)), r"`forces` .* finite; entry \[7, 30, 1\] is not"),
    (with_(displacements=put(2, 1, 0, value=np.inf)), r"must be finite; entry \[2, 1, 0\] is not"),
    (with_(points=put(2, 1, value=np.nan)), r"`points` must be finite; entry \[2, 1\] is not"),
    (with_(cells=put(0, 0, value=63)), r"cells must have nodes in \[0, 62\]; got [01] to 63"),
    (with_(cells=put(0, 0, value=-1)), r"cells must have nodes in \[0, 62\]; got -1 to 62"),
    (with_(cells=lambda c: c[1:]), r"every node must belong to a cell; \d of 63 do not"),
    (with_(cells=put(3, 0, value=50)), "cell 3 .* is flat or folded"),
    (hinged, "the mesh must be one body; it has 2 parts that share no face"),
    (with_(cells=lambda c: c[:0]), "there must be points and cells"),
    (with_(fixed_nodes=put(0, value=63)), r"`fixed_nodes` must be in \[0, 62\]; got 1 to 63"),
    (with_(fixed_nodes=lambda n: np.arange(63)), "`fixed_nodes` holds every node"),
    (with_(fixed_nodes=lambda n: [*n, 40]), r"must be zero at `fixed_nodes`; sample \d+ has \S+ m"),
    (with_(fixed_nodes=lambda n: n.astype(float)), "must hold integers; got dtype float64"),
    (with_(regions=lambda r: r - 1), "`regions` must be ids from 0 on"),
    (with_(regions=lambda r: r[:-1]), r"shape \(210,\) or \(210, any\); got \(209,\)"),
    (with_(regions=lambda r: r * 0), "210 samples cannot be split by region"),
    (lambda a: {**a, "test": np.arange(210) % 3}, TEST + "got 0 to 2"),
    (lambda a: {**a, "test": np.zeros(210)}, TEST + "got dtype float64"),
    (lambda a: {**a, **dict.fromkeys(("test", "validation"), np.ones(210, dtype=bool))}, BOTH),
    (with_(forces=put(7, 30, 1, value=-1e31)), RANGE + r"N; entry \[7, 30, 1\] is -1e\+31"),
    (with_(displacements=put(2, 30, 0, value=1e99)), RANGE + r"m; entry \[2, 30, 0\] is 1e\+99"),
    (with_(forces=lambda f: 0 * f), "`forces` " + ZERO.format("N")),
    (with_(displacements=lambda u: 0 * u), "`displacements` " + ZERO.format("m")),
    (with_(points=doubled), "1 nodes coincide with others"),
    (with_(cells=lambda c: np.vstack([c, c[:1]])), "some cells occur twice"),
    (with_(forces=doubled), "`forces`: 1 samples have the same forces as others"),
    (first(0), "there must be samples; got none"),
    (first(1), "1 samples cannot be split by region"),
]


def check_refused(path: Path, message: str) -> None:
    with pytest.raises((SpecError, InvalidInputError), match=message) as caught:
        check_file(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("spoil", "message"), BAD)
def test_bad_arrays_are_refused_in_one_line(
    spoil: Callable[[Arrays], Arrays], message: str, arrays: Arrays, tmp_path: Path
) -> None:
    check_refused(written(tmp_path, spoil(arrays)), message)


NOT_NPZ = "mine.npz: not a readable .npz file of arrays"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("mine.npz", b"", NOT_NPZ),
        ("mine.npz", b"\x80\x04cos\nsystem\n.", NOT_NPZ + ": File is not a zip file"),
        ("mine.h5", b"\x89HDF", "mine.h5: not a readable HDF5 file of arrays"),
        ("mine.csv", b"1,2", "snapshots must be in an .npz, .h5 or .hdf5 file; got '.csv'"),
    ],
)
def test_bad_files_are_refused_in_one_line(
    file: str, content: bytes, message: str, tmp_path: Path
) -> None:
    (tmp_path / file).write_bytes(content)
    (tmp_path / "mine.toml").write_text(TOML.replace("mine.npz", file))
    check_refused(tmp_path / "mine.toml", message)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (None, "`forces` must be an array of numbers; got a group"),
        ("hi", "`forces` must be an array of numbers; got text"),
        (3.0, r"`forces` must have shape \(1, 63, 3\); got \(\)"),
        (h5py.ExternalLink("nowhere.h5", "/forces"), "`forces` is a link to another place or file"),
    ],
)
def test_entries_of_hdf5_that_are_no_arrays_give_an_error_that_names_them(
    entry: Any, message: str, arrays: Arrays, tmp_path: Path
) -> None:
    path = written(tmp_path, without("forces")(arrays), TOML.replace(".npz", ".h5"))
    with h5py.File(tmp_path / "mine.h5", "a") as file:
        if entry is None:
            file.create_group("forces")
        else:
            file["forces"] = entry
    check_refused(path, f"mine.h5: {message}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TOML.replace("mine.npz", "other.npz"), r"other.npz: no such file; got 'other.npz'"),
        (TOML + "[geometry]\n", "unknown key `geometry`"),
        (TOML.replace("file =", "fiel ="), "unknown key `snapshots.fiel`; did you mean 'file'"),
        (TOML + '[split]\nby = "regoin"\n', "`split.by"),
    ],
)
def test_bad_dataset_files_are_refused_in_one_line(
    text: str, message: str, arrays: Arrays, tmp_path: Path
) -> None:
    written(tmp_path, arrays)
    (tmp_path / "mine.toml").write_text(text)
    check_refused(tmp_path / "mine.toml", message)


def test_a_dataset_is_identified_by_its_content(arrays: Arrays, tmp_path: Path) -> None:
    spec = mor_bench.load_scene(written(tmp_path, arrays)).spec
    moved = tmp_path / "moved"
    moved.mkdir()
    shutil.copy(tmp_path / "mine.npz", moved)
    (moved / "mine.toml").write_text(TOML)
    assert mor_bench.load_scene(moved / "mine.toml").spec.digest() == spec.digest()
    other = with_(forces=lambda f: 2 * f)(arrays)
    assert mor_bench.load_scene(written(tmp_path, other)).spec.digest() != spec.digest()
