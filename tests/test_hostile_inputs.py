"""Files that look harmless: hidden references, endless work, foreign samples, forged starts."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from time import perf_counter

import meshio
import numpy as np
import pytest
from safetensors.numpy import save_file

import mor_bench
from mor_bench.analysis.analyse import analyse
from mor_bench.errors import MorBenchError, SpecError, StoreError
from mor_bench.export.vtu_files import export_vtu
from mor_bench.model_file import read_header_and_arrays
from mor_bench.options import InvalidOptionError, RunOptions
from mor_bench.results.comparison import Comparison
from mor_bench.scene.files import read_mesh
from mor_bench.scene.mesh import box_mesh
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import load_dataset_spec, load_method_spec
from mor_bench.surrogates.hybrid import Hybrid
from tests.commands import invoke
from tests.model_files import sealed
from tests.report_runs import add_row
from tests.report_runs import tiny as a_run

BOX = box_mesh((2.0, 1.0, 1.0), (2, 1, 1))
SOON_S = 2.0


def written(path: Path, **options: str) -> str:
    """Write two hexahedra; return the text of the file."""
    meshio.Mesh(BOX.points, [("hexahedron", BOX.cells)]).write(path, **options)
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "start", ["{folder}/evil.toml", "evil.toml", "hybrid[start={folder}/evil.toml]"]
)
def test_a_forged_model_names_no_file_as_its_start(
    start: str, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil.py").write_text("open('ran', 'w').close()\nclass Evil:\n    pass\n")
    (tmp_path / "evil.toml").write_text(
        'title = "x"\nsurrogate = "evil:Evil"\nsource = "x"\ntold = "input"\n'
    )
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "model.safetensors"
    Hybrid("pod-tensor", {"n_modes": 3}, steps=1).fit(tiny.scene, tiny.train).save(path)
    header, arrays = read_header_and_arrays(path)
    knobs = {**json.loads(header["parameters"]), "start": start.format(folder=tmp_path)}
    path.write_bytes(sealed({**header, "parameters": json.dumps(knobs)}, arrays))
    with pytest.raises(MorBenchError, match="`start` must be the name of a method of mor-bench"):
        mor_bench.load_surrogate(path)
    assert not (tmp_path / "ran").exists()


def test_xdmf_cannot_name_a_file_in_an_element_of_another_name(tmp_path: Path) -> None:
    path = tmp_path / "a.xdmf"
    text = written(path, file_format="xdmf", data_format="HDF")
    path.write_text(text.replace("DataItem", "Item"), encoding="utf-8")
    with pytest.raises(SpecError, match="refers to another file"):
        read_mesh(path, 1.0)


@pytest.mark.parametrize("content", ['(0 "commen', "(12 (1 1 2"])
def test_a_cut_file_of_ansys_is_refused_at_once(content: str, tmp_path: Path) -> None:
    (tmp_path / "a.msh").write_text(content, encoding="utf-8")
    begun = perf_counter()
    with pytest.raises(SpecError, match=r"a\.msh"):
        read_mesh(tmp_path / "a.msh", 1.0)
    assert perf_counter() - begun < SOON_S


@pytest.mark.parametrize("line", ["ınclude, input=body.inp", "*ınclude, input=body.inp"])
def test_an_include_of_abaqus_is_found_in_any_letters(line: str, tmp_path: Path) -> None:
    written(tmp_path / "body.inp")
    (tmp_path / "a.inp").write_text(f"*HEADING\n{line}\n", encoding="utf-8")
    with pytest.raises(SpecError, match="refers to another file"):
        read_mesh(tmp_path / "a.inp", 1.0)


def test_endless_ranges_of_abaqus_are_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.inp"
    sets = "".join(f"*ELSET, ELSET=S{i}, GENERATE\n1, 40000000, 1\n" for i in range(20))
    path.write_text(written(path) + sets, encoding="utf-8")
    begun = perf_counter()
    with pytest.raises(SpecError, match=r"GENERATE\) have more than 10,000,000 numbers"):
        read_mesh(path, 1.0)
    assert perf_counter() - begun < SOON_S
    path.write_text(written(path) + "*ELSET, ELSET=S, GENERATE\n1, 2, 1\n", encoding="utf-8")
    assert len(read_mesh(path, 1.0)[0].cells) == 2


@pytest.mark.parametrize("blank", [" ", "\x1c", "\t"])
def test_a_grid_of_vtk_without_cells_is_refused(blank: str, tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    lines = ["# vtk DataFile Version 3.0", "x", "ASCII", f"DATASET{blank}STRUCTURED_POINTS"]
    path.write_text("\n".join([*lines, "DIMENSIONS 101 101 101", ""]), encoding="utf-8")
    with pytest.raises(SpecError, match="a grid of type STRUCTURED_POINTS lists no cells"):
        read_mesh(path, 1.0)


def test_many_mistakes_of_a_file_are_read_quickly(tmp_path: Path) -> None:
    path = tmp_path / "many.toml"
    wrong = "\n".join(f"a{i} = 1" for i in range(20_000))
    path.write_text(
        f'title = "x"\nsurrogate = "a:B"\nsource = "x"\n[sweep]\n{wrong}\n', encoding="utf-8"
    )
    begun = perf_counter()
    with pytest.raises(SpecError, match=r"And [\d]+ more\.") as error:
        load_method_spec(path)
    assert perf_counter() - begun < SOON_S
    assert len(str(error.value)) < 5000


@pytest.mark.parametrize("end", ["raise ValueError('n')", "raise SystemExit(0)"])
@pytest.mark.parametrize("place", ["__init__", "fit"])
def test_a_third_partys_method_decides_no_exit_code(
    place: str, end: str, cache: Path, tmp_path: Path
) -> None:
    body = {"__init__": "pass", "fit": "return self", place: end}
    (tmp_path / "sudden.py").write_text(
        "class Sudden:\n"
        f"    def __init__(self):\n        {body['__init__']}\n"
        f"    def fit(self, forces, displacements):\n        {body['fit']}\n"
        "    def predict(self, forces):\n        return 0 * forces\n",
        encoding="utf-8",
    )
    (tmp_path / "sudden.toml").write_text(
        'title = "x"\nsurrogate = "sudden:Sudden"\nsource = "x"\n', encoding="utf-8"
    )
    out = tmp_path / "model.safetensors"
    command = ["fit", "beam-tiny", "-m", str(tmp_path / "sudden.toml"), "--limit", "40"]
    shown = invoke(*command, "--cache", str(cache), "--out", str(out))
    assert shown.exit_code not in (0, 1), shown.output
    assert "sudden" in shown.output
    assert "Traceback" not in shown.output
    assert not out.exists()


@pytest.fixture
def run(tmp_path: Path) -> Comparison:
    """A stored run of two configurations."""
    made = a_run(tmp_path / "run")
    add_row(made, "pod", {"n_modes": 5}, 0.008, 1.0)
    add_row(made, "pod", {"n_modes": 20}, 0.002, 2.0)
    made.write()
    made.finish({})
    return made


def test_show_has_the_stored_verdict_of_a_run_without_its_samples(run: Comparison) -> None:
    run.finish(analyse(run, n_resamples=50))
    assert " wins: " in invoke("show", str(run.out)).output
    shutil.rmtree(run.out / "samples")
    shown = invoke("show", str(run.out))
    assert shown.exit_code == 0
    for words in (" wins: ", "no raw samples"):
        assert words in " ".join(shown.output.split())
    refused = invoke("report", str(run.out)).output
    assert "no such file" in refused
    assert f"`mor-bench show {run.out}` has its verdict." in refused
    (run.out / "comparison.json").write_text('{"verdicts": [{"dataset": 3}]}')
    shown = invoke("show", str(run.out))
    assert shown.exit_code == 2
    assert "not the conclusions of a run" in shown.output
    (run.out / "comparison.json").unlink()
    shown = invoke("show", str(run.out))
    assert shown.exit_code == 2
    assert "no such file" in shown.output


def test_the_samples_of_another_timing_are_refused(run: Comparison, tmp_path: Path) -> None:
    other = a_run(tmp_path / "other")
    slower = add_row(other, "pod", {"n_modes": 5}, 0.008, 3.0)
    content = other.samples_path(slower).read_bytes()
    write_atomically(run.samples_path(run.rows[0]), content)
    with pytest.raises(StoreError, match=r"median of `latency_ms` is 3, but results.json says 1"):
        run.check_samples()


def test_labels_of_unusual_letters_have_files_of_their_own(run: Comparison) -> None:
    rows = [run.rows[0].with_parts(label=f"kernel [kernel=rbf{sign}linear]") for sign in "+*:'"]
    assert len({run.samples_path(row) for row in rows}) == len(rows)


@pytest.mark.parametrize("option", [{"limit": 20_000_000}, {"test_seed": 2**63}])
def test_a_run_refuses_options_that_its_results_could_not_hold(option: dict[str, int]) -> None:
    with pytest.raises(InvalidOptionError):
        RunOptions(**option)


@pytest.mark.parametrize(
    "gravity",
    [
        {"density_kg_m3": 1e308},
        {"density_kg_m3": 5e-324},
        {"density_kg_m3": 1e3, "acceleration_m_s2": [0.0, 0.0, 1e308]},
    ],
)
def test_a_weight_beyond_double_precision_is_refused(gravity: dict[str, object]) -> None:
    content = load_dataset_spec("beam-tiny").model_dump(mode="json")
    with pytest.raises(SpecError, match="the range in which double precision suffices"):
        load_dataset_spec({**content, "gravity": gravity})


def test_a_million_wrong_rows_are_one_error(tmp_path: Path) -> None:
    out = a_run(tmp_path / "run").out
    made = a_run(out)
    made.write()
    made.finish({})
    content = json.loads((out / "results.json").read_text(encoding="utf-8"))
    content["rows"] = [0] * 1_000_000
    (out / "results.json").write_text(json.dumps(content), encoding="utf-8")
    begun = perf_counter()
    with pytest.raises(StoreError):
        Comparison.read(out)
    assert perf_counter() - begun < SOON_S


def test_arrays_of_no_model_are_refused(tmp_path: Path) -> None:
    save_file({"x": np.zeros(3)}, tmp_path / "x.safetensors")
    with pytest.raises(StoreError):
        mor_bench.load_surrogate(tmp_path / "x.safetensors")


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_an_exported_sample_replaces_a_link_or_pipe_in_its_place(
    kind: str, tiny: Dataset, tmp_path: Path
) -> None:
    place, victim = tmp_path / "out" / "beam-tiny-test-00001-reference.vtu", tmp_path / "kept"
    place.parent.mkdir()
    victim.write_text("mine")
    if kind == "link":
        place.symlink_to(victim)
    else:
        os.mkfifo(place)
    assert export_vtu(tiny, 1, tmp_path / "out") == [place]
    assert victim.read_text() == "mine"
    assert not place.is_symlink()
    assert len(meshio.read(place).points) == tiny.scene.mesh.n_nodes


def test_a_class_without_an_answer_does_not_pass_the_check(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(
        'surrogate = "mor_bench.surrogate:Surrogate"\ntitle = "t"\nsource = "s"\ntold = "input"\n'
    )
    answer = invoke("check", str(path))
    assert answer.exit_code == 2
    assert "has neither `answer` nor `predict`" in answer.output
