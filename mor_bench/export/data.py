"""For other programs: single samples as VTU for ParaView, whole datasets as NumPy arrays, networks as ONNX."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import meshio
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, MorBenchError
from mor_bench.method_loading import load_surrogate, make_surrogate
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.snapshots.store import write_atomically
from mor_bench.snapshots.test_sets import SET_NAMES, SetName
from mor_bench.surrogate import Surrogate

Part = Literal["train", "test"] | SetName

PARTS: tuple[Part, ...] = ("train", "test", *SET_NAMES)


ONNX_AGREES = 1e-5
"""Largest difference between a written network and the method's own predictions, relative to the largest displacement."""


def export_vtu(
    data: Dataset,
    sample: int,
    out: str | Path,
    *,
    part: Part = "test",
    models: Sequence[str | Path] = (),
) -> list[Path]:
    """Write a sample's reference, and the prediction of each model, as VTU.

    Each file holds the mesh at rest and as point data `displacement`, m, and `force`, N; that of a model also `error`, its
    displacement minus the reference's, m. ParaView's filter Warp By Vector shows the body deformed. Of a scene with an
    embedded surface there is for each a second file with the surface.

    Parameters
    ----------
    data : Dataset
    sample : int
        Number of the sample in its part.
    out : path
        Folder; made where there is none.
    part : {"train", "test"} or the name of a test set
        A test set must have been read with the dataset.
    models : sequence of paths
        Fitted models, see `Surrogate.save`; each file is called after its model's.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    InvalidInputError
        If there is no such part or sample, a model is of another dataset, or two have one name.
    StoreError
        If a model is damaged.
    SolverError
        If a model finds no answer.
    """
    samples, out = _part(data, part), Path(out)
    if not 0 <= sample < len(samples):
        raise InvalidInputError(
            f"`sample` must be an integer in [0, {len(samples) - 1}], the samples of part {part!r}; got {sample}."
        )
    names = ["reference", *(Path(model).stem for model in models)]
    if len(set(names)) < len(names):
        raise InvalidInputError(
            f"files would have one name: models must differ in name, and none be called 'reference'; got {', '.join(names[1:])}."
        )
    force, reference = samples.forces[sample], samples.displacements[sample]
    fields = [{"displacement": reference, "force": force}]
    for path in models:
        model = load_surrogate(path)
        if model.scene_.spec.physics() != data.scene.spec.physics() or _observed(
            model.scene_
        ) != _observed(data.scene):
            raise InvalidInputError(
                f"{path}: the model was fitted to {model.scene_.name!r}, not to {data.scene.name!r} as it is."
            )
        predicted = model.predict(samples.inputs[sample])
        fields.append({"displacement": predicted, "force": force, "error": predicted - reference})
    out.mkdir(parents=True, exist_ok=True)
    stems = [f"{data.scene.name}-{part}-{sample:05d}-{name}" for name in names]
    return [
        path
        for stem, found in zip(stems, fields, strict=True)
        for path in _write(data.scene, found, out, stem)
    ]


def _observed(scene: Scene) -> list[int] | None:
    """The nodes whose displacements methods are given; None where they are given forces."""
    nodes = scene.observed_nodes
    return None if nodes is None else [int(node) for node in nodes]


def _part(data: Dataset, part: Part) -> Snapshots:
    parts: dict[str, Snapshots] = {"train": data.train, "test": data.test}
    parts.update({str(name): samples for name, samples in data.tests.items()})
    if part not in parts:
        raise InvalidInputError(f"`part` must be {', '.join(parts)}; got {part!r}.")
    return parts[part]


def _write(
    scene: Scene, fields: Mapping[str, NDArray[np.float64]], out: Path, stem: str
) -> list[Path]:
    kind = "tetra" if scene.mesh.cells.shape[1] == 4 else "hexahedron"
    paths = [out / f"{stem}.vtu"]
    meshio.Mesh(scene.mesh.points, [(kind, scene.mesh.cells)], point_data=dict(fields)).write(
        paths[0], binary=True
    )
    surface = scene.embedded_surface
    if surface is not None:
        # The force stays at the nodes: what is a sum over nodes is not interpolated.
        carried = {
            name: scene.to_surface @ values for name, values in fields.items() if name != "force"
        }
        paths.append(out / f"{stem}-surface.vtu")
        meshio.Mesh(surface.points, [("triangle", surface.facets)], point_data=carried).write(
            paths[1], binary=True
        )
    return paths


def snapshot_arrays(data: Dataset) -> dict[str, NDArray[Any]]:
    """A dataset's training and test samples in the schema of `mor_bench.scene.snapshot_file`.

    They take turns, so that every beginning holds both parts in about their proportion.
    """
    parts = (data.train, data.test)
    order = np.argsort(
        np.concatenate([(np.arange(len(part)) + 0.5) / len(part) for part in parts]), kind="stable"
    )
    arrays: dict[str, NDArray[Any]] = {
        "points": data.scene.mesh.points,
        "cells": data.scene.mesh.cells,
        "fixed_nodes": data.scene.fixed_nodes,
    }
    for name in ("forces", "displacements", "regions"):
        arrays[name] = np.concatenate([getattr(part, name) for part in parts])[order]
    if isinstance(data.train.loads, NodalLoads) and not arrays["regions"].any():
        del arrays["regions"]  # it came without
    arrays["test"] = (np.arange(len(order)) >= len(data.train))[order]
    return arrays


def export_numpy(data: Dataset, out: str | Path) -> list[Path]:
    """Write a dataset's samples to an NPZ file, and beside it the TOML that reads them in again with the same split.

    Returns
    -------
    list of Path
        The two files.

    Raises
    ------
    InvalidInputError
        If the file's name does not end in .npz, or one of the two is there already.
    """
    out = Path(out)
    if out.suffix != ".npz":
        raise InvalidInputError(f"`out` must end in .npz; got {str(out)!r}.")
    for path in (out, out.with_suffix(".toml")):
        if path.exists():
            raise InvalidInputError(
                f"`out`: {path} exists and is not overwritten; remove it or choose another name."
            )
    out.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    np.savez(buffer, **snapshot_arrays(data))  # type: ignore[arg-type]
    write_atomically(out, buffer.getvalue())
    write_atomically(out.with_suffix(".toml"), _toml(data.scene, out.name).encode())
    return [out, out.with_suffix(".toml")]


def _quoted(text: str) -> str:
    """A basic string of TOML: one of JSON, with the delete character escaped, and no surrogates."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _toml(scene: Scene, file: str) -> str:
    spec = scene.spec
    grid = spec.grid_nodes or scene.mesh.grid_shape
    return f"""title = {_quoted(spec.title)}
source = {_quoted(spec.source)}
{f"grid_nodes = {list(grid)}" if grid else ""}

[snapshots]
file = {_quoted(file)}

[split]
by = "file"

[needs]
error = {spec.needs.error!r}
latency_ms = {spec.needs.latency_ms!r}
"""


def export_onnx(model: str | Path, out: str | Path) -> tuple[Path, float | None]:
    """Write the network of a fitted model, with its scaling at both ends, as an ONNX file of float32.

    Input `forces`, (n, n_nodes, 3), N, or in a scene with observed nodes displacements of these, m; output `displacements` of the same
    shape, m; any n. Weights lie within the file, and all
    operations are standard ones. Scene and units stand in the metadata. Where ONNX Runtime is installed, its answers to some
    random loads are compared with the method's own in float32 before anything is written.

    Parameters
    ----------
    model : path
        A fitted model, see `Surrogate.save`.
    out : path
        The file; one that is there is not overwritten.

    Returns
    -------
    Path
    float or None
        The largest difference, relative to the largest displacement; None if nothing was compared.

    Raises
    ------
    InvalidInputError
        If the file's name does not end in .onnx, or it is there already.
    StoreError
        If the model is damaged.
    UnavailableBackendError
        If onnx is not installed, or cannot hold the network.
    MorBenchError
        If the method has no network, or the answers differ by more than `ONNX_AGREES`.
    """
    out = Path(out)
    if out.suffix != ".onnx":
        raise InvalidInputError(f"`out` must end in .onnx; got {str(out)!r}.")
    if out.exists():
        raise InvalidInputError(
            f"`out`: {out} exists and is not overwritten; remove it or choose another name."
        )
    surrogate = load_surrogate(model)
    written = surrogate.onnx_model().SerializeToString()
    difference = _onnx_difference(surrogate, written)
    if difference is not None and not difference <= ONNX_AGREES:
        raise MorBenchError(
            f"{model}: ONNX Runtime's answers differ from the method's by {difference:.1e} of the largest; nothing was written."
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(out, written)
    return out, difference


def _onnx_difference(surrogate: Surrogate, written: bytes) -> float | None:
    try:
        import onnxruntime
    except ImportError:
        return None
    if surrogate.parameters.get("inference", "eager") != "eager":
        plain = make_surrogate(type(surrogate), {**surrogate.parameters, "inference": "eager"})
        surrogate = plain.restore(surrogate.scene_, surrogate.model_arrays())
    shape = (3, surrogate.scene_.mesh.n_nodes, 3)
    forces = np.random.default_rng(0).normal(scale=1.0, size=shape).astype(np.float32)
    forces[0] = 0.0
    session = onnxruntime.InferenceSession(written, providers=["CPUExecutionProvider"])
    (found,) = session.run(["displacements"], {"forces": forces})
    expected = surrogate.predict(forces)
    return float(np.abs(found - expected).max() / np.abs(expected).max())
