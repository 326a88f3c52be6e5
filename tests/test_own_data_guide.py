"""The examples of docs/own-data.md work as they stand there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import meshio
import numpy as np
import pytest

import mor_bench
from mor_bench.analysis.selection import asked_of
from mor_bench.analysis.selection_text import run_command
from mor_bench.runs.file_check import check_file
from mor_bench.scene.mesh import FACES, box_mesh
from mor_bench.scene.snapshot_file import OPTIONAL, REQUIRED
from tests.small_runs import PLAIN, short_timing

GUIDE = (Path(__file__).parent.parent / "docs" / "own-data.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The working folder after the scripts and files of the guide."""
    scripts = re.findall(r"<!-- python -->\n```python\n(.*?)```", GUIDE, re.DOTALL)
    files = re.findall(r"<!-- toml: (\S+) -->\n```toml\n(.*?)```", GUIDE, re.DOTALL)
    assert len(scripts) == len(files) == 2
    with chdir(tmp_path_factory.mktemp("guide")):
        for script in scripts:
            exec(compile(script, "own-data.md", "exec"), {})
        for name, text in files:
            Path(name).write_text(text, encoding="utf-8")
        yield Path.cwd()


def test_the_datasets_of_the_guide_are_valid(folder: Path) -> None:
    counts = "96 cells, 195 nodes"
    body = f"dataset, {counts}, 65 load patches, 650 samples"
    assert check_file(folder / "body.toml") == body
    mine = f"dataset of imported snapshots, {counts}, 15 of them fixed, "
    assert check_file(folder / "mine.toml").startswith(mine)


def test_the_surface_of_the_guide_becomes_voxels(tmp_path: Path) -> None:
    (geometry,) = re.findall(r"```toml\n(\[geometry\]\nshape = \"voxels\".*?)```", GUIDE, re.DOTALL)
    (body,) = re.findall(r"<!-- toml: body.toml -->\n```toml\n(.*?)```", GUIDE, re.DOTALL)
    _, rest = body.split("[discretisation]")
    rest = rest.replace('{ point_set = "held" }', '"x-min"').partition("[loads]")[0]
    (tmp_path / "organ.toml").write_text(f"{geometry}\n[discretisation]{rest}", encoding="utf-8")
    box = box_mesh((12.0, 4.0, 2.0), (1, 1, 1))
    quads = box.cells[0][FACES[8]]
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    meshio.Mesh(box.points, [("triangle", triangles)]).write(tmp_path / "organ.stl")
    scene = mor_bench.load_scene(tmp_path / "organ.toml")
    assert len(scene.mesh.cells) == 16 * 12 * 12
    np.testing.assert_allclose(np.ptp(scene.mesh.points, axis=0), [0.12, 0.04, 0.02], rtol=1e-6)


@pytest.mark.slow
def test_the_imported_dataset_of_the_guide_can_be_compared(folder: Path) -> None:
    with short_timing():
        comparison = mor_bench.run(["mine.toml"], PLAIN, out="out", cache="cache")
    assert {row.status for row in comparison.rows} == {"skipped", "ok"}
    command = run_command(asked_of(comparison, "mine"))
    assert command.startswith("mor-bench run mine.toml -m linear-fem -m pca-regression ")


def test_the_guide_names_every_array_of_the_schema() -> None:
    assert re.findall(r"^\| `(\w+)` \| \(", GUIDE, re.MULTILINE) == [*REQUIRED, *OPTIONAL]
