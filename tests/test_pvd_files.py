"""PVD collections name VTU files that hold the samples, or the steps of a load path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest

from mor_bench.errors import InvalidInputError, SolverError, UnsupportedSceneError
from mor_bench.export.pvd_files import export_load_path_pvd, export_pvd
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.stresses import CellDeformations
from mor_bench.scene.loads import Facets
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.patch_loads import PatchLoads
from tests.commands import invoke as command


def entries(path: Path) -> list[tuple[float, int, Path]]:
    """Return time, part and file of each entry of a collection."""
    root = ElementTree.parse(path).getroot()
    assert (root.tag, root.attrib["type"]) == ("VTKFile", "Collection")
    return [
        (
            float(item.attrib["timestep"]),
            int(item.attrib["part"]),
            path.parent / item.attrib["file"],
        )
        for item in root.iter("DataSet")
    ]


@pytest.mark.parametrize("part", ["test", "train"])
def test_samples_can_be_opened_again(part: str, tiny: Dataset, tmp_path: Path) -> None:
    samples = {"train": tiny.train, "test": tiny.test}[part]
    out = tmp_path / "new" / 'a & "b".pvd'
    paths = export_pvd(tiny, [0, 3, 17], out, part=part)  # type: ignore[arg-type]
    found = entries(paths[0])
    assert [time for time, _, _ in found] == [0.0, 3.0, 17.0]
    assert [file for _, _, file in found] == paths[1:]
    for (_, _, file), row in zip(found, (0, 3, 17), strict=True):
        mesh = meshio.read(file)
        np.testing.assert_array_equal(mesh.points, tiny.scene.mesh.points)
        np.testing.assert_array_equal(mesh.cells_dict["hexahedron"], tiny.scene.mesh.cells)
        np.testing.assert_array_equal(mesh.point_data["displacement"], samples.displacements[row])
        np.testing.assert_array_equal(mesh.point_data["force"], samples.forces[row])
        expected = np.linalg.det(CellDeformations(tiny.scene)(samples.displacements[row]))
        np.testing.assert_array_equal(mesh.cell_data["volume_ratio"][0], expected)


def test_deformations_are_those_of_known_maps(tiny: Dataset) -> None:
    deformations = CellDeformations(tiny.scene)
    matrix = np.array([[0.1, 0.2, 0.0], [0.0, -0.3, 0.1], [0.0, 0.0, 0.5]])
    moved = tiny.scene.mesh.points @ matrix.T
    found = deformations(moved)
    np.testing.assert_allclose(found, np.broadcast_to(np.eye(3) + matrix, found.shape), atol=1e-13)
    # Of u = 0.1 x² along x, the difference quotient over a cell is exact: det F = 1 + 0.2 x.
    mesh, moved = tiny.scene.mesh, np.zeros_like(moved)
    moved[:, 0] = 0.1 * mesh.points[:, 0] ** 2
    centres = mesh.points[mesh.cells].mean(axis=1)
    found = np.linalg.det(deformations(moved))
    np.testing.assert_allclose(found, 1.0 + 0.2 * centres[:, 0], rtol=1e-13)


def test_a_load_path_goes_from_rest_to_the_sample(tiny: Dataset, tmp_path: Path) -> None:
    paths = export_load_path_pvd(tiny, 5, tmp_path / "path.pvd", n_steps=4)
    found = entries(paths[0])
    assert [time for time, _, _ in found] == [0.0, 0.25, 0.5, 0.75, 1.0]
    meshes = [meshio.read(file) for _, _, file in found]
    assert not meshes[0].point_data["displacement"].any()
    last, reference = meshes[-1].point_data["displacement"], tiny.test.displacements[5]
    assert np.abs(last - reference).max() < 1e-6 * np.abs(reference).max()
    half = FullOrderModel(tiny.scene).solve(0.5 * tiny.test.free_forces[5]).displacement
    middle = meshes[2].point_data["displacement"].ravel()[tiny.scene.free_dofs]
    assert np.abs(middle - half).max() < 1e-6 * np.abs(half).max()
    np.testing.assert_array_equal(meshes[2].point_data["force"], 0.5 * tiny.test.forces[5])


def test_an_embedded_surface_is_a_part_of_each_step(tiny: Dataset, tmp_path: Path) -> None:
    surface = Facets(tiny.scene.mesh.points[[20, 30, 40]].copy(), np.array([[0, 1, 2]]))
    data = replace(tiny, scene=replace(tiny.scene, embedded_surface=surface))
    found = entries(export_pvd(data, [1, 2], tmp_path / "two.pvd")[0])
    assert [(time, part) for time, part, _ in found] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    skin = meshio.read(found[1][2])
    expected = tiny.test.displacements[1][[20, 30, 40]]
    np.testing.assert_allclose(skin.point_data["displacement"], expected, rtol=1e-12, atol=1e-15)


def test_paraviews_reader_finds_the_steps(tiny: Dataset, tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista", reason="needs the extra `viz`")
    path = export_pvd(tiny, [2, 9], tmp_path / "two.pvd")[0]
    reader = pyvista.get_reader(str(path))
    assert reader.time_values == [2.0, 9.0]
    reader.set_active_time_value(9.0)
    (block,) = reader.read()
    np.testing.assert_array_equal(block.point_data["displacement"], tiny.test.displacements[9])
    assert block.cell_data["volume_ratio"].shape == (24,)


def test_impossible_collections_are_refused_and_nothing_is_written(
    tiny: Dataset, tmp_path: Path
) -> None:
    out = tmp_path / "out.pvd"
    wrong: Any
    for wrong in ([], [40], [-1, 2], [3, 3], [5, 2], [1.7, 2.2], [False, True], ["1"]):
        with pytest.raises(InvalidInputError, match=r"growing integers in \[0, 39\], the samples"):
            export_pvd(tiny, wrong, out)
    with pytest.raises(InvalidInputError, match=r"`out` must end in .pvd; got 'x.vtu'"):
        export_pvd(tiny, [0], "x.vtu")
    with pytest.raises(InvalidInputError, match="`part` must be train, validation, test; got '2x'"):
        export_pvd(tiny, [0], out, part="2x")
    with pytest.raises(InvalidInputError, match="`n_steps` must be an integer >= 1; got 0"):
        export_load_path_pvd(tiny, 0, out, n_steps=0)
    with pytest.raises(InvalidInputError, match=r"`sample` must be an integer in \[0, 39\]"):
        export_load_path_pvd(tiny, 40, out)
    for wrong in (1.5, True, "1", None):
        with pytest.raises(InvalidInputError, match=rf"integer in \[0, 39\]; got {wrong!r}\."):
            export_load_path_pvd(tiny, wrong, out)
    unknown = replace(tiny, scene=replace(tiny.scene, material=None))
    with pytest.raises(
        UnsupportedSceneError, match="has no load path: its snapshots were imported"
    ):
        export_load_path_pvd(unknown, 0, out)
    loads = tiny.test.loads
    assert isinstance(loads, PatchLoads)
    torn = replace(tiny.test, loads=replace(loads, vectors=1e6 * loads.vectors))
    with pytest.raises(SolverError, match=r"elements invert|equilibrium"):
        export_load_path_pvd(replace(tiny, test=torn), 0, out, n_steps=1)
    assert not list(tmp_path.iterdir())
    (tmp_path / "out").mkdir()
    with pytest.raises(InvalidInputError, match="out exists and is not overwritten"):
        export_pvd(tiny, [0], out)


@pytest.mark.slow
def test_the_command_writes_samples_or_a_load_path(cache: Path, tmp_path: Path) -> None:
    shared = ["export", "pvd", "beam-tiny", "--cache", str(cache), "--sample", "3"]
    done = command(*shared, "--sample", "5", "--out", str(tmp_path / "two.pvd"))
    assert done.exit_code == 0, done.stderr
    assert [time for time, _, _ in entries(tmp_path / "two.pvd")] == [3.0, 5.0]
    assert len(done.stdout.split()) == 3
    done = command(*shared, "--steps", "2", "--out", str(tmp_path / "path.pvd"))
    assert done.exit_code == 0, done.stderr
    assert [time for time, _, _ in entries(tmp_path / "path.pvd")] == [0.0, 0.5, 1.0]
    refused = command(*shared, "--sample", "5", "--steps", "2", "--out", str(tmp_path / "x.pvd"))
    assert refused.exit_code == 2
    assert "`--steps` needs one test sample" in refused.stderr
