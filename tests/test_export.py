"""Exported files hold the computed fields, and can be read back."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from PIL import Image

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.export.load_path import export_load_path
from mor_bench.export.npz_file import export_numpy
from mor_bench.export.vtu_files import export_vtu
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.loads import Facets
from mor_bench.snapshots.dataset import Dataset
from tests.commands import invoke as command


@pytest.fixture(scope="module")
def pod(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "pod.safetensors"
    mor_bench.load_method("pod", n_modes=3).fit(tiny.scene, tiny.train).save(path)
    return path


@pytest.mark.parametrize("part", ["train", "test"])
def test_vtu_holds_reference_and_prediction(
    part: str, tiny: Dataset, pod: Path, tmp_path: Path
) -> None:
    samples = {"train": tiny.train, "test": tiny.test}[part]
    paths = export_vtu(tiny, 7, tmp_path / "new" / "folder", part=part, models=[pod])  # type: ignore[arg-type]
    names = [f"beam-tiny-{part}-00007-{name}.vtu" for name in ("reference", "pod")]
    assert [path.name for path in paths] == names
    assert b'format="binary"' in paths[0].read_bytes()
    reference, predicted = (meshio.read(path) for path in paths)
    for read in (reference, predicted):
        np.testing.assert_array_equal(read.points, tiny.scene.mesh.points)
        np.testing.assert_array_equal(read.cells_dict["hexahedron"], tiny.scene.mesh.cells)
        np.testing.assert_array_equal(read.point_data["force"], samples.forces[7])
    np.testing.assert_array_equal(reference.point_data["displacement"], samples.displacements[7])
    assert "error" not in reference.point_data
    expected = mor_bench.load_surrogate(pod).predict(samples.forces[7])
    error = expected - samples.displacements[7]
    np.testing.assert_array_equal(predicted.point_data["displacement"], expected)
    np.testing.assert_array_equal(predicted.point_data["error"], error)
    assert np.abs(error).max() > 0


def test_an_embedded_surface_moves_with_the_body(tiny: Dataset, pod: Path, tmp_path: Path) -> None:
    low, high = tiny.scene.mesh.bounds
    generator = np.random.default_rng(0)
    surface = Facets(low + (high - low) * generator.random((9, 3)), np.arange(9).reshape(3, 3))
    data = replace(tiny, scene=replace(tiny.scene, embedded_surface=surface))
    paths = export_vtu(data, 0, tmp_path, models=[pod])
    stems = ["reference", "reference-surface", "pod", "pod-surface"]
    assert [path.stem.split("-", 4)[-1] for path in paths] == stems
    matrix = interpolation_matrix(tiny.scene.mesh, surface.points)
    for body, skin in (paths[:2], paths[2:]):
        inner, outer = meshio.read(body), meshio.read(skin)
        np.testing.assert_array_equal(outer.points, surface.points)
        np.testing.assert_array_equal(outer.cells_dict["triangle"], surface.facets)
        moved = matrix @ inner.point_data["displacement"]
        found = outer.point_data["displacement"]
        np.testing.assert_allclose(found, moved, rtol=1e-13, atol=1e-16)
        assert outer.point_data.keys() == inner.point_data.keys() - {"force"}


def test_an_impossible_export_is_refused_and_nothing_is_written(
    tiny: Dataset, pod: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    stiffer = tiny.scene.generated.material.model_copy(update={"young_pa": 501.0})
    spec = tiny.scene.generated.model_copy(update={"material": stiffer})
    other = replace(tiny, scene=replace(tiny.scene, spec=spec))
    refused: list[tuple[Dataset, dict[str, Any], str]] = [
        (tiny, {"sample": 40}, r"`sample` must be an integer in \[0, 39\], the samples of part"),
        (tiny, {"part": "2x"}, "`part` must be train, validation, test; got '2x'"),
        (tiny, {"models": [pod, pod]}, "none may be called 'reference'; got pod, pod"),
        (other, {"models": [pod]}, "pod.safetensors: the model was fitted to 'beam-tiny', not to"),
    ]
    for data, options, message in refused:
        with pytest.raises(InvalidInputError, match=message):
            export_vtu(data, **{"sample": 0, "out": out, **options})
    with pytest.raises(InvalidInputError, match=r"`out` must end in .npz; got 'x.npy'"):
        export_numpy(tiny, "x.npy")
    with pytest.raises(InvalidInputError, match="`out` must have a name of lower-case letters"):
        export_numpy(tiny, out / "My samples.npz")
    assert not out.exists()


@pytest.mark.parametrize("by", ["region", "sample"])
def test_exported_arrays_read_back_with_the_same_parts(
    by: str, cache: Path, tmp_path: Path
) -> None:
    split = "region" if by == "region" else "sample"
    data = mor_bench.load_dataset("beam-tiny", split=split, cache=cache)  # type: ignore[arg-type]
    npz, toml = export_numpy(data, tmp_path / "new" / "tiny.npz")
    again = mor_bench.load_dataset(toml)
    for part in ("train", "validation", "test"):
        before, after = getattr(data, part), getattr(again, part)
        for name in ("forces", "displacements", "free_displacements", "regions"):
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_array_equal(again.scene.mesh.cells, data.scene.mesh.cells)
    assert again.scene.mesh.grid_shape == data.scene.mesh.grid_shape == again.scene.spec.grid_nodes
    assert again.scene.spec.needs == data.scene.spec.needs
    assert again.scene.spec.title == data.scene.spec.title
    for first in (20, 60):  # the first samples of the file hold all parts in proportion
        n_test = len(mor_bench.load_dataset(toml, first).test)
        assert abs(n_test - len(data.test) / 210 * first) <= 1
    twice = export_numpy(again, tmp_path / "again.npz")[0]
    with np.load(npz) as one, np.load(twice) as two:
        assert one.files == two.files
        for name in one.files:
            np.testing.assert_array_equal(one[name], two[name])


@pytest.mark.parametrize("name", ["😀", 'a"b\\c', "tab\té"])
def test_files_with_any_title_can_be_read_back(name: str, tiny: Dataset, tmp_path: Path) -> None:
    spec = tiny.scene.spec.model_copy(update={"title": name, "source": name + "\nand more"})
    data = replace(tiny, scene=replace(tiny.scene, spec=spec))
    npz, toml = export_numpy(data, tmp_path / "mine.npz")
    assert tomllib.loads(toml.read_text(encoding="utf-8"))["snapshots"]["file"] == npz.name
    again = mor_bench.load_scene(toml).spec
    assert (again.title, again.source) == (spec.title, spec.source)


def test_snapshots_without_regions_are_exported_without_regions(
    tiny: Dataset, tmp_path: Path
) -> None:
    npz, toml = export_numpy(tiny, tmp_path / "tiny.npz")
    with np.load(npz) as file:
        arrays = {name: file[name] for name in file.files if name != "regions"}
    np.savez(npz, **arrays)
    again = export_numpy(mor_bench.load_dataset(toml), tmp_path / "again.npz")[0]
    with np.load(again) as file:
        assert set(file.files) == set(arrays)


@pytest.mark.slow
def test_the_export_commands_print_the_files_they_write(
    pod: Path, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shared = ["beam-tiny", "--cache", str(cache)]
    done = command("export", "numpy", *shared, "--out", "tiny.npz")
    assert (done.exit_code, done.stdout) == (0, "tiny.npz\ntiny.toml\n"), done.stderr
    sample = [*shared, "--sample", "3", "--out", "vtu"]
    done = command("export", "vtu", *sample, "--part", "train", "--model", str(pod))
    assert done.exit_code == 0, done.stderr
    written = [str(path.relative_to(tmp_path)) for path in tmp_path.glob("vtu/*")]
    assert sorted(done.stdout.split()) == sorted(written)
    assert len(written) == 2
    refused = command("export", "vtu", *sample, "--part", "trian")
    assert refused.exit_code == 2
    assert (
        "`--part` must be train, validation, test, in-range, 2x, 4x, paper-amplitude, unseen-"
        in refused.stderr
    )


@pytest.mark.slow
def test_a_load_path_grows_to_the_whole_load(tiny: Dataset, tmp_path: Path) -> None:
    path = export_load_path(tiny, 3, tmp_path / "load.gif", n_steps=4)
    with Image.open(path) as gif:
        assert gif.n_frames == 5  # type: ignore[attr-defined]
        frames = []
        for i in range(5):
            gif.seek(i)
            frames.append(np.asarray(gif.convert("RGB"), dtype=float))
    changes = [np.abs(frame - frames[0]).sum() for frame in frames]
    assert changes[0] == 0
    assert changes[-1] > changes[2] > changes[1] > 0
    assert path.stat().st_size < 500_000
    with pytest.raises(InvalidInputError, match="not overwritten"):
        export_load_path(tiny, 3, path)
    with pytest.raises(InvalidInputError, match="`sample` must be"):
        export_load_path(tiny, len(tiny.test), tmp_path / "other.gif")


@pytest.mark.parametrize("there", ["body.toml", "body.npz"])
def test_no_existing_file_is_overwritten(there: str, tiny: Dataset, tmp_path: Path) -> None:
    (tmp_path / there).write_text("mine")
    with pytest.raises(InvalidInputError, match=f"{there} exists and is not overwritten"):
        export_numpy(tiny, tmp_path / "body.npz")
    assert [path.name for path in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text() == "mine"
