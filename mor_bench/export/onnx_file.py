"""Networks of fitted models as ONNX files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mor_bench.errors import MorBenchError
from mor_bench.export.output_path import new_file
from mor_bench.method_loading import load_surrogate, make_surrogate
from mor_bench.snapshots.given import given_of
from mor_bench.snapshots.store import write_atomically
from mor_bench.surrogate import Surrogate

ONNX_AGREES = 1e-5
"""Largest allowed difference between ONNX Runtime and the method, over the largest displacement."""


def export_onnx(model: str | Path, out: str | Path) -> tuple[Path, float | None]:
    """Write the network of a fitted model, with its scaling, as an ONNX file of float32.

    The input is `forces` (n, n_nodes, 3), N, for any n. In a scene with observed nodes, it is their
    displacements, m. The output is `displacements` of the same shape, m. The file contains the
    weights and uses standard operations only. Its metadata describe the scene and the units. If
    ONNX Runtime is installed, its answers to random loads are compared with the method's first.

    Parameters
    ----------
    model : path
        A fitted model, see `Surrogate.save`.
    out : path
        The new file; an existing one is not overwritten.

    Returns
    -------
    Path
    float or None
        Largest difference, relative to the largest displacement; None if nothing was compared.

    Raises
    ------
    InvalidInputError
        If the file's name does not end in .onnx, or the file exists.
    StoreError
        If the model is damaged.
    UnavailableBackendError
        If onnx is not installed, or ONNX cannot represent the network.
    MorBenchError
        If the method has no network, or the answers differ by more than `ONNX_AGREES`.
    """
    out = new_file(out, ".onnx")
    surrogate = load_surrogate(model)
    written = surrogate.onnx_model().SerializeToString()
    difference = _difference(surrogate, written)
    if difference is not None and not difference <= ONNX_AGREES:
        raise MorBenchError(
            f"{model}: ONNX Runtime's answers differ from the method's by {difference:.1e} "
            "of the largest displacement; nothing was written."
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(out, written)
    return out, difference


def _difference(surrogate: Surrogate, written: bytes) -> float | None:
    """Largest difference between ONNX Runtime and the method; None if it is not installed."""
    try:
        import onnxruntime
    except ImportError:
        return None
    scene = surrogate.scene_
    if surrogate.parameters.get("inference", "eager") != "eager":
        eager = make_surrogate(type(surrogate), {**surrogate.parameters, "inference": "eager"})
        surrogate = eager.restore(scene, surrogate.arrays_)
    forces = np.random.default_rng(0).normal(size=(3, scene.mesh.n_nodes, 3)).astype(np.float32)
    forces[0] = 0.0
    session = onnxruntime.InferenceSession(written, providers=["CPUExecutionProvider"])
    (found,) = session.run(["displacements"], {"forces": forces})
    expected = surrogate.predict(given_of(scene, forces.astype(np.float64)).query)
    return float(np.abs(found - expected).max() / np.abs(expected).max())
