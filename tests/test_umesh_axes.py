"""The order in which a training of U-Mesh sees the axes of its grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning.training import Training  # noqa: E402 - after the check of torch
from mor_bench.surrogates.field_surrogate import FieldSurrogate  # noqa: E402
from mor_bench.surrogates.umesh.method import UMesh  # noqa: E402


@pytest.mark.parametrize("cells", [(2, 6, 3), (6, 2, 2), (2, 2, 6)])
def test_training_sees_the_longest_axis_last_and_changes_no_answer(
    cells: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The turned network answers on its turned grid what the kept one answers on the mesh's."""
    spec = load_scene("beam-tiny").spec.model_dump(mode="json", exclude_none=True)
    kept = {name: spec[name] for name in ("title", "source", "material", "supports")}
    scene = load_scene({**kept, "geometry": {**spec["geometry"], "cells": cells}})
    forces = np.random.default_rng(0).normal(size=(4, scene.mesh.n_nodes, 3))
    free = forces.reshape(4, -1)[:, scene.free_dofs]
    samples = Snapshots(scene, NodalLoads(forces, np.zeros((4, 1), np.int64)), free, np.ones(4))
    method: Any = mor_bench.load_method("umesh", channels=8, steps=1, iterations=1)
    during: dict[str, Any] = {}

    train = FieldSurrogate.train_network

    def watched(self: UMesh, network: Any, known: Any, generator: Any) -> Training:
        done = train(self, network, known, generator)
        during["shape"] = self.grid_.shape
        with torch.inference_mode():
            inputs = self.grid_.to_grid(known[0][0])
            during["answers"] = self.grid_.to_nodes(network(inputs)).numpy()
        return done

    monkeypatch.setattr(FieldSurrogate, "train_network", watched)
    method.fit(scene, samples)
    longest = max(method.grid_.shape)
    assert during["shape"][2] == longest
    assert method.grid_.shape.index(longest) == np.argmax(cells)
    expected = during["answers"] * method.output_scale_
    expected[:, scene.fixed_nodes] = 0.0
    np.testing.assert_allclose(
        method.predict(forces), expected, rtol=0, atol=1e-5 * np.abs(expected).max()
    )
