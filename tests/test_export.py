"""What is written for other programs is what was computed, and can be read in again."""

from __future__ import annotations

import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.export.data import export_numpy, export_vtu
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.loads import Facets
from mor_bench.snapshots.dataset import Dataset
from tests.test_cli import mor_bench as command


@pytest.fixture(scope="module")
def pod(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "pod.safetensors"
    mor_bench.load_method("pod", n_modes=10).fit(tiny.scene, tiny.train).save(path)
    return path


@pytest.mark.parametrize("part", ["train", "test"])
def test_vtu_holds_reference_and_prediction(
    part: str, tiny: Dataset, pod: Path, tmp_path: Path
) -> None:
    samples = {"train": tiny.train, "test": tiny.test}[part]
    paths = export_vtu(
        tiny,
        7,
        tmp_path / "new" / "folder",
        part="train" if part == "train" else "test",
        models=[pod],
    )
    assert [path.name for path in paths] == [
        f"beam-tiny-{part}-00007-reference.vtu",
        f"beam-tiny-{part}-00007-pod.vtu",
    ]
    assert b'format="binary"' in paths[0].read_bytes()
    reference, predicted = (meshio.read(path) for path in paths)
    for read in (reference, predicted):
        np.testing.assert_array_equal(read.points, tiny.scene.mesh.points)
        assert [block.type for block in read.cells] == ["hexahedron"]
        np.testing.assert_array_equal(read.cells[0].data, tiny.scene.mesh.cells)
        assert (
            shape_gradients(
                read.points, read.cells[0].data, element_of(read.cells[0].data).derivatives
            )[1]
            > 0
        ).all()
        np.testing.assert_array_equal(read.point_data["force"], samples.forces[7])
    np.testing.assert_array_equal(reference.point_data["displacement"], samples.displacements[7])
    assert "error" not in reference.point_data
    expected = mor_bench.load_surrogate(pod).predict(samples.forces[7])
    np.testing.assert_array_equal(predicted.point_data["displacement"], expected)
    np.testing.assert_array_equal(
        predicted.point_data["error"], expected - samples.displacements[7]
    )
    assert np.abs(predicted.point_data["error"]).max() > 0


def test_an_embedded_surface_moves_with_the_body(tiny: Dataset, pod: Path, tmp_path: Path) -> None:
    low, high = tiny.scene.mesh.bounds
    generator = np.random.default_rng(0)
    surface = Facets(low + (high - low) * generator.random((9, 3)), np.arange(9).reshape(3, 3))
    data = replace(tiny, scene=replace(tiny.scene, embedded_surface=surface))
    paths = export_vtu(data, 0, tmp_path, models=[pod])
    assert [path.stem.split("-", 4)[-1] for path in paths] == [
        "reference",
        "reference-surface",
        "pod",
        "pod-surface",
    ]
    for body, skin in (paths[:2], paths[2:]):
        inner, outer = meshio.read(body), meshio.read(skin)
        np.testing.assert_array_equal(outer.points, surface.points)
        np.testing.assert_array_equal(outer.cells_dict["triangle"], surface.facets)
        matrix = interpolation_matrix(tiny.scene.mesh, surface.points)
        np.testing.assert_allclose(
            outer.point_data["displacement"],
            matrix @ inner.point_data["displacement"],
            rtol=1e-13,
            atol=1e-16,
        )
        assert outer.point_data.keys() == inner.point_data.keys() - {"force"}


def test_what_cannot_be_exported_is_named_and_nothing_is_written(
    tiny: Dataset, pod: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with pytest.raises(
        InvalidInputError,
        match=r"`sample` must be an integer in \[0, 39\], the samples of part 'test'; got 40",
    ):
        export_vtu(tiny, 40, out)
    with pytest.raises(InvalidInputError, match=r"`part` must be train, test; got '2x'"):
        export_vtu(tiny, 0, out, part="2x")
    with pytest.raises(
        InvalidInputError,
        match=r"models must differ in name, and none be called 'reference'; got pod, pod",
    ):
        export_vtu(tiny, 0, out, models=[pod, pod])
    stiffer = tiny.scene.generated.material.model_copy(update={"young_pa": 501.0})
    other = replace(
        tiny,
        scene=replace(
            tiny.scene, spec=tiny.scene.generated.model_copy(update={"material": stiffer})
        ),
    )
    with pytest.raises(
        InvalidInputError,
        match=r"pod.safetensors: the model was fitted to 'beam-tiny', not to 'beam-tiny' as it is",
    ):
        export_vtu(other, 0, out, models=[pod])
    with pytest.raises(InvalidInputError, match=r"`out` must end in .npz; got 'x.npy'"):
        export_numpy(tiny, "x.npy")
    assert not out.exists()


@pytest.mark.parametrize("by", ["region", "sample"])
def test_numpy_is_read_in_again_with_the_same_parts(by: str, cache: Path, tmp_path: Path) -> None:
    data = mor_bench.load_dataset(
        "beam-tiny", split="region" if by == "region" else "sample", cache=cache
    )
    npz, toml = export_numpy(data, tmp_path / "new" / "tiny.npz")
    again = mor_bench.load_dataset(toml)
    for before, after in ((data.train, again.train), (data.test, again.test)):
        for name in ("forces", "displacements", "free_displacements", "regions"):
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_array_equal(again.scene.mesh.cells, data.scene.mesh.cells)
    assert again.scene.mesh.grid_shape == data.scene.mesh.grid_shape == again.scene.spec.grid_nodes
    assert again.scene.spec.needs == data.scene.spec.needs
    assert again.scene.spec.title == data.scene.spec.title
    for first in (20, 60):  # a beginning of the file holds both parts
        assert (
            abs(len(mor_bench.load_dataset(toml, first).test) - len(data.test) / 210 * first) <= 1
        )
    twice = export_numpy(again, tmp_path / "again.npz")[0]
    with np.load(npz) as one, np.load(twice) as two:
        assert one.files == two.files
        for name in one.files:
            np.testing.assert_array_equal(one[name], two[name])


@pytest.mark.skipif(sys.platform == "win32", reason="no such names of files")
@pytest.mark.parametrize("name", ["😀", 'a"b\\c', "tab\tdel\x7fesc\x1bé"])
def test_any_file_name_and_title_is_read_in_again(name: str, tiny: Dataset, tmp_path: Path) -> None:
    spec = tiny.scene.spec.model_copy(update={"title": name, "source": name + "\n\x00"})
    npz, toml = export_numpy(
        replace(tiny, scene=replace(tiny.scene, spec=spec)), tmp_path / f"{name}.npz"
    )
    assert tomllib.loads(toml.read_text(encoding="utf-8"))["snapshots"]["file"] == npz.name
    again = mor_bench.load_scene(toml).spec
    assert (again.title, again.source) == (spec.title, spec.source)


def test_snapshots_without_regions_stay_without(tiny: Dataset, tmp_path: Path) -> None:
    npz, toml = export_numpy(tiny, tmp_path / "tiny.npz")
    with np.load(npz) as file:
        arrays = {name: file[name] for name in file.files if name != "regions"}
    np.savez(npz, **arrays)
    again = export_numpy(mor_bench.load_dataset(toml), tmp_path / "again.npz")[0]
    with np.load(again) as file:
        assert set(file.files) == set(arrays)


def test_the_commands(pod: Path, cache: Path, tmp_path: Path) -> None:
    shared = ["beam-tiny", "--cache", str(cache)]
    done = command("export", "numpy", *shared, "--out", "tiny.npz", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "tiny.npz\ntiny.toml\n"), done.stderr
    done = command(
        "export",
        "vtu",
        *shared,
        "--sample",
        "3",
        "--part",
        "train",
        "--model",
        str(pod),
        "--out",
        "vtu",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert sorted(done.stdout.split()) == sorted(
        str(path.relative_to(tmp_path)) for path in tmp_path.glob("vtu/*")
    )
    assert len(done.stdout.split()) == 2
    refused = command(
        "export", "vtu", *shared, "--sample", "3", "--part", "trian", "--out", "vtu", cwd=tmp_path
    )
    assert refused.returncode == 2
    assert refused.stderr.strip() == (
        "mor-bench: `--part` must be train, test, in-range, 2x, 4x, unseen-regions, unseen-directions, several-forces; got 'trian'."
    )


@pytest.mark.parametrize("there", ["body.toml", "body.npz"])
def test_no_file_of_the_users_is_overwritten(there: str, tiny: Dataset, tmp_path: Path) -> None:
    (tmp_path / there).write_text("mine")
    with pytest.raises(InvalidInputError, match=f"{there} exists and is not overwritten"):
        export_numpy(tiny, tmp_path / "body.npz")
    assert [path.name for path in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text() == "mine"
