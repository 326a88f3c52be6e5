"""Damaged and forged results, models and checkpoints give their readers one clear line."""

from __future__ import annotations

import io
import json
import shutil
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load as load_arrays

import mor_bench
from mor_bench.analysis.analyse import analyse
from mor_bench.errors import MorBenchError, StoreError
from mor_bench.method_loading import load_fitted
from mor_bench.report.console_tables import print_tables
from mor_bench.report.page import render
from mor_bench.results.arrays import write_arrays
from mor_bench.results.comparison import Comparison
from mor_bench.runs.pick import pick
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.pod import PODGalerkin
from tests.commands import invoke
from tests.damaged_runs import DATASET, a_run, sound_run
from tests.model_files import sealed
from tests.mutations import (
    JSON,
    QUICK,
    SLOW,
    Reader,
    attacked,
    documented,
    mutated_bytes,
    mutated_json,
)

DRAWING_S, DRAWN = 60.0, 40
"""Processor time for all figures of a report, and number of reports that are drawn."""

DRAWINGS = [
    pytest.param(DRAWN // 10, marks=pytest.mark.slow),
    pytest.param(DRAWN, marks=pytest.mark.nightly),
]


def concluded(path: Path) -> None:
    """Read a run, draw its conclusions, print its tables and pick from it."""
    comparison = Comparison.read(path.parent)
    print_tables(comparison, Console(file=io.StringIO(), width=120), analyse(comparison))
    if DATASET in comparison.datasets:
        pick(DATASET, comparison=comparison).text()


def drawn(path: Path) -> None:
    concluded(path)
    render(Comparison.read(path.parent))


def a_sample(path: Path) -> None:
    comparison = Comparison.read(sound_run())
    shutil.copyfile(comparison.samples_path(comparison.rows[0]), path)


def samples_of(path: Path) -> object:
    """Read a file of raw samples in the place of a row's own."""
    comparison = Comparison.read(sound_run())
    own = Comparison(path.parent, {}, comparison.rows)
    own.samples_path(own.rows[0]).parent.mkdir(exist_ok=True)
    own.samples_path(own.rows[0]).write_bytes(path.read_bytes())
    return own.samples(own.rows[0])


def forged_arrays(content: bytes, generator: np.random.Generator) -> bytes:
    """Change an array of a file of raw samples: its type, shape or values."""
    buffer = io.BytesIO(content)
    with h5py.File(buffer, "r+") as file:
        name = list(file)[generator.integers(len(file))]
        array = np.asarray(file[name])
        values = (np.nan, np.inf, -1.0, 1e300, 0.0, 2.0**40)
        changes: list[Callable[[], Any]] = [
            lambda: np.array(b"word"),
            lambda: np.array([b"words"] * 3),
            lambda: values[generator.integers(len(values))],
            lambda: array.ravel()[: generator.integers(0, 4)],
            lambda: array[: len(array) // 2] if array.ndim else array[None],
            lambda: array[None],
            lambda: np.full(array.shape, values[generator.integers(len(values))]),
            lambda: array.astype(("f4", "c16", "i1", "?")[generator.integers(4)]),
            lambda: np.concatenate([array, array]) if array.ndim else array,
        ]
        del file[name]
        if forged := generator.integers(len(changes) + 1):
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                file[name] = changes[forged - 1]()
    return buffer.getvalue()


def in_a_run(use: Callable[[Path], None], of_dataset: bool) -> Callable[[Path], None]:
    """Return a reader of raw samples that uses them in a run, in the place of sound ones."""

    def read(path: Path) -> None:
        folder = path.parent / "run"
        if not folder.exists():
            folder.mkdir()
            a_run(folder / "results.json")
        row = Comparison.read(folder).rows[0]
        place = Comparison.read(folder).samples_path(row)
        place = place.with_name(f"{DATASET}.h5") if of_dataset else place
        kept = place.read_bytes()
        place.write_bytes(path.read_bytes())
        try:
            use(folder / "results.json")
        finally:
            place.write_bytes(kept)

    return read


def a_dataset(path: Path) -> None:
    comparison = Comparison.read(sound_run())
    shutil.copyfile(comparison.out / "samples" / f"{DATASET}.h5", path)


def forged_model(content: bytes, generator: np.random.Generator) -> bytes:
    """Mutate the header or an array of a model, with a checksum that fits."""
    length = int.from_bytes(content[:8], "little")
    header: dict[str, str] = json.loads(content[8 : 8 + length])["__metadata__"]
    arrays: dict[str, Any] = load_arrays(content)
    name = list(arrays)[generator.integers(len(arrays))]
    match generator.integers(5):
        case 0:
            header["scene"] = mutated_json(header["scene"].encode(), generator).decode()
        case 1:
            header["parameters"] = mutated_json(header["parameters"].encode(), generator).decode()
        case 2:
            key = ("scene", "parameters", "surrogate")[generator.integers(3)]
            header[key] = mutated_bytes(header[key].encode(), generator).decode("latin1")
        case 3:
            del arrays[name]
        case _:
            kinds = ("f4", "f8", "i1", "i8", "u8", "?")
            arrays[name] = np.resize(arrays[name], generator.integers(0, 9)).astype(
                kinds[generator.integers(len(kinds))]
            )
    return sealed(header, arrays)


READERS = [
    Reader("results.json", a_run, lambda path: Comparison.read(path.parent), JSON),
    Reader("samples.h5", a_sample, samples_of, [mutated_bytes]),
]


CONCLUDED = 200
"""Runs of which tables and a choice are made. It takes tens of milliseconds each."""


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_mutated_results_are_read_or_refused(reader: Reader, tmp_path: Path) -> None:
    attacked(reader, tmp_path, QUICK)


@pytest.mark.nightly
@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_many_mutated_results_are_read_or_refused(reader: Reader, tmp_path: Path) -> None:
    attacked(reader, tmp_path, SLOW)


@pytest.mark.parametrize("n", [CONCLUDED // 25, pytest.param(CONCLUDED, marks=pytest.mark.nightly)])
def test_mutated_results_are_concluded_on_or_refused(n: int, tmp_path: Path) -> None:
    attacked(Reader("results.json", a_run, concluded, JSON), tmp_path, n)


@pytest.mark.parametrize("n", [CONCLUDED // 25, pytest.param(CONCLUDED, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("of_dataset", [False, True], ids=["row", "dataset"])
def test_forged_arrays_are_concluded_on_or_refused(
    of_dataset: bool, n: int, tmp_path: Path
) -> None:
    write, read = a_dataset if of_dataset else a_sample, in_a_run(concluded, of_dataset)
    attacked(Reader("samples.h5", write, read, [forged_arrays]), tmp_path, n)


@pytest.mark.parametrize("n", DRAWINGS)
@pytest.mark.parametrize("of_dataset", [False, True], ids=["row", "dataset"])
def test_forged_arrays_are_drawn_or_refused(of_dataset: bool, n: int, tmp_path: Path) -> None:
    write, read = a_dataset if of_dataset else a_sample, in_a_run(drawn, of_dataset)
    attacked(Reader("samples.h5", write, read, [forged_arrays], DRAWING_S), tmp_path, n)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("learning", [{}] * 20_000, "20,000 entries; at most 10,000"),
        ("learning", [{}] * 2_500_000, "more than 2,000,000 values"),
        ("machine", {str(i): 0 for i in range(20_000)}, "20,000 entries; at most 10,000"),
    ],
)
def test_results_that_would_fill_the_memory_are_refused(
    key: str, value: Any, said: str, tmp_path: Path
) -> None:
    a_run(tmp_path / "results.json")
    content = json.loads((tmp_path / "results.json").read_text())
    text = json.dumps({**content, key: value}, separators=(",", ":"))
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(StoreError, match=said):
        Comparison.read(tmp_path)


@pytest.mark.parametrize("n", DRAWINGS)
def test_mutated_results_are_drawn_or_refused(n: int, tmp_path: Path) -> None:
    attacked(Reader("results.json", a_run, drawn, JSON, DRAWING_S), tmp_path, n)


def test_without_raw_samples_nothing_is_picked_or_reported(tmp_path: Path) -> None:
    a_run(tmp_path / "results.json")
    chosen = pick(DATASET, comparison=tmp_path).text()
    comparison = Comparison.read(tmp_path)
    lost = comparison.samples_path(comparison.rows[1])
    kept = lost.rename(tmp_path / "kept.h5")
    message = "raw samples of 1 of 4 configurations are missing"
    with pytest.raises(StoreError, match=message) as caught:
        pick(DATASET, comparison=tmp_path)
    assert str(lost) in str(caught.value)
    answer = invoke("report", str(tmp_path))
    assert answer.exit_code == 2
    assert message in answer.output
    kept.rename(lost)
    assert pick(DATASET, comparison=tmp_path).text() == chosen


def test_raw_samples_of_another_configuration_are_noticed(tmp_path: Path) -> None:
    a_run(tmp_path / "results.json")
    comparison = Comparison.read(tmp_path)
    first, second = (comparison.samples_path(row) for row in comparison.rows[:2])
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    with pytest.raises(StoreError, match="belongs to another configuration or run") as caught:
        pick(DATASET, comparison=tmp_path)
    assert str(first) in str(caught.value)
    answer = invoke("report", str(tmp_path))
    assert answer.exit_code == 2
    assert "belongs to another configuration" in answer.output
    first.write_bytes(kept)
    write_arrays(first, {"relative_l2": np.ones(1)})
    with pytest.raises(StoreError, match="`relative_l2` must have the length"):
        pick(DATASET, comparison=tmp_path)


@pytest.fixture(scope="module")
def model(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "model.safetensors"
    mor_bench.load_method("pod", n_modes=3).fit(tiny.scene, tiny.train).save(path)
    return path


@pytest.mark.parametrize("path", [".", "", "..", "no/such/model.safetensors"])
def test_a_model_is_not_saved_where_no_file_can_be(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fitted = mor_bench.load_method("linear-fem").fit(mor_bench.load_scene("beam-tiny"), None)
    with pytest.raises((MorBenchError, OSError)) as caught:
        fitted.save(path)
    assert str(Path(path)) in str(caught.value)
    assert ".tmp" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def model_reader(model: Path, read: Callable[[Path], object]) -> Reader:
    def write(path: Path) -> None:
        shutil.copyfile(model, path)

    return Reader("model.safetensors", write, read, [mutated_bytes, forged_model])


@pytest.mark.parametrize("n", [QUICK, pytest.param(SLOW, marks=pytest.mark.nightly)])
def test_mutated_models_are_read_or_refused(
    model: Path, tiny_scene: Scene, tmp_path: Path, n: int
) -> None:
    read = partial(load_fitted, surrogate=PODGalerkin, scene=tiny_scene)
    attacked(model_reader(model, read), tmp_path, n)


@pytest.mark.parametrize(
    "n",
    [
        pytest.param(QUICK, marks=pytest.mark.slow),
        pytest.param(SLOW, marks=pytest.mark.nightly),
    ],
)
def test_mutated_models_with_their_scenes_are_read_or_refused(
    model: Path, tmp_path: Path, n: int
) -> None:
    attacked(model_reader(model, mor_bench.load_surrogate), tmp_path, n)


def test_the_documented_counts_are_those_of_these_tests() -> None:
    counts = documented()
    assert counts["results.json and raw samples of a run"] == len(READERS) * SLOW
    assert counts["models, with and without the scene in the file"] == 2 * SLOW
    assert counts["runs, with all tables and a choice"] == CONCLUDED
    assert counts["runs, with all figures and the page"] == DRAWN
    assert counts["runs with forged arrays, with all tables and a choice"] == 2 * CONCLUDED
    assert counts["runs with forged arrays, with all figures and the page"] == 2 * DRAWN
