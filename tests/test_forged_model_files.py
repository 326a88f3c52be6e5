"""A model file can do no harm: any change to it gives one clear error."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import StoreError
from mor_bench.model_file import read_header_and_arrays
from mor_bench.snapshots.dataset import Dataset
from tests.model_files import sealed

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

WEIGHT = "network.encoder.0.2.weight"


@pytest.fixture(scope="module")
def parts(
    tiny: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> tuple[bytes, dict[str, str], dict[str, np.ndarray]]:
    """A model's file, its header and its arrays."""
    path = tmp_path_factory.mktemp("whole") / "model.safetensors"
    method = mor_bench.load_method("umesh", channels=4, steps=1, iterations=1)
    method.fit(tiny.scene, tiny.train).save(path)
    return (path.read_bytes(), *read_header_and_arrays(path))


def refused(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(StoreError, match=r"model\.safetensors") as error:
        mor_bench.load_surrogate(path)
    assert "\n" not in str(error.value)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "model.safetensors"


@pytest.mark.parametrize(
    "knobs",
    [
        {"channels": 10**30},
        {"channels": 512},
        {"steps": 10**9},
        {"steps": 6},
        {"channels": "4"},
        {"steps": True},
        {"unknown": 1},
        {"inference": "os.system"},
        {"inference": ["packed"]},
        {"iterations": float("nan")},
    ],
    ids=str,
)
def test_forged_parameters_are_refused_before_weights_are_allocated(
    parts: Any, path: Path, knobs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def allocated(*_: Any, **__: Any) -> None:
        raise AssertionError("weights were allocated before shapes were compared")

    _, header, arrays = parts
    monkeypatch.setattr(torch.nn.Module, "to_empty", allocated)
    knobs = {**json.loads(header["parameters"]), **knobs}
    refused(path, sealed({**header, "parameters": json.dumps(knobs)}, arrays))


@pytest.mark.parametrize("text", ["[" * 100_000, "{", "null", "[]", '{"channels":' + "9" * 5000])
@pytest.mark.parametrize("key", ["parameters", "scene"])
def test_forged_json_is_refused(parts: Any, path: Path, key: str, text: str) -> None:
    _, header, arrays = parts
    refused(path, sealed({**header, key: text}, arrays))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_an_endless_scene_file_is_refused(parts: Any, path: Path) -> None:
    _, header, arrays = parts
    os.mkfifo(path.parent / "pipe")
    for endless in ("/dev/zero", str(path.parent / "pipe")):
        file = {"shape": "file", "file": {"path": endless, "sha256": "0" * 64}}
        scene = {**json.loads(header["scene"]), "geometry": file}
        refused(path, sealed({**header, "scene": json.dumps(scene)}, arrays))


@pytest.mark.parametrize(
    "name",
    ["../../evil:Evil", "/etc/passwd", "os:system", "mor_bench.surrogates.umesh.method:Image", ""],
)
def test_a_class_that_no_method_names_is_refused(parts: Any, path: Path, name: str) -> None:
    _, header, arrays = parts
    refused(path, sealed({**header, "surrogate": name}, arrays))


@pytest.mark.slow
def test_forged_arrays_are_refused(parts: Any, path: Path) -> None:
    _, header, arrays = parts
    changes: list[dict[str, np.ndarray | None]] = [
        {name: None} for name in arrays if not name.startswith("range.")
    ]
    for name in (WEIGHT, "scales", "loss_curve", "iterations"):
        array = arrays[name]
        other = np.float64 if array.dtype == np.float32 else np.float32
        changes += [{name: array.astype(dtype)} for dtype in (other, np.int32, np.uint8)]
        shorter = array[None] if name == "loss_curve" else array[:0]
        changes += [{name: array.reshape(1, -1)}, {name: shorter}]
        if array.dtype.kind == "f":
            changes += [{name: np.full_like(array, bad)} for bad in (np.nan, -np.inf)]
    evil = ("evil", "network.evil", "size.channels", "size.evil", "range.evil")
    changes += [{name: np.ones(1, np.float32)} for name in evil]
    words = (b"packed", b"\xff\xfe", b"")
    changes += [{"size.inference": np.frombuffer(word, np.uint8)} for word in words]
    changes += [{"scales": np.zeros(2)}, {"scales": -np.ones(2)}, {"iterations": np.array([-1])}]
    changes += [{"timing.eager": np.array([-1.0])}, {"timing.eager": np.ones(3)}]
    for change in changes:
        changed = {**arrays, **change}
        kept = {name: array for name, array in changed.items() if array is not None}
        refused(path, sealed(header, kept))


def test_damaged_bytes_are_refused(parts: Any, path: Path) -> None:
    content, _, _ = parts
    length = int.from_bytes(content[:8], "little")
    for end in (0, 1, 7, 8, length // 2, length + 8, length + 9, len(content) - 1):
        refused(path, content[:end])
    generator = np.random.default_rng(0)
    in_header, in_arrays = (8, 8 + length, 20), (8 + length, len(content), 10)
    for place in [*range(8), *generator.integers(*in_header), *generator.integers(*in_arrays)]:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(generator.integers(8))
        refused(path, bytes(flipped))


def test_a_forged_table_of_arrays_is_refused(parts: Any, path: Path) -> None:
    content, _, _ = parts
    length = int.from_bytes(content[:8], "little")
    table, body = json.loads(content[8 : 8 + length]), content[8 + length :]
    begin, end = table[WEIGHT]["data_offsets"]
    entries: list[dict[str, Any]] = [
        {"dtype": "BF16", "shape": [(end - begin) // 2]},
        {"dtype": "F8_E4M3", "shape": [end - begin]},
        {"shape": [10**9] * 3},
        {"shape": [10**12, 0]},
        {"data_offsets": [0, 10**12]},
        {"dtype": "object"},
    ]
    for entry in entries:
        forgery = json.dumps({**table, WEIGHT: {**table[WEIGHT], **entry}}).encode()
        refused(path, len(forgery).to_bytes(8, "little") + forgery + body)
    refused(path, (2**62).to_bytes(8, "little") + content[8:])
