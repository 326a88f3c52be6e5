"""The order in which the network of U-Mesh sees the axes of its grid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.method_loading import load_fitted
from mor_bench.scene.grid import grid_map
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.surrogates.umesh.network import UNet  # noqa: E402 - after the check of torch
from mor_bench.surrogates.umesh.padded_grid import padded_grid  # noqa: E402


@pytest.mark.parametrize("cells", [(2, 6, 3), (6, 2, 2), (2, 2, 6)])
def test_answers_do_not_depend_on_the_axis_along_which_a_mesh_is_long(
    cells: tuple[int, int, int], tmp_path: Path
) -> None:
    """The network sees the longest axis last, and a saved one has the order of the mesh."""
    spec = load_scene("beam-tiny").spec.model_dump(mode="json", exclude_none=True)
    kept = {name: spec[name] for name in ("title", "source", "material", "supports")}
    scene = load_scene({**kept, "geometry": {**spec["geometry"], "cells": cells}})
    forces = np.random.default_rng(0).normal(size=(4, scene.mesh.n_nodes, 3))
    free = forces.reshape(4, -1)[:, scene.free_dofs]
    samples = Snapshots(scene, NodalLoads(forces, np.zeros((4, 1), np.int64)), free, np.ones(4))
    method: Any = mor_bench.load_method("umesh", channels=8, steps=1, iterations=1)
    method.fit(scene, samples)
    assert method.grid_.shape[2] == max(method.grid_.shape)
    method.save(tmp_path / "umesh.safetensors")
    loaded = load_fitted(tmp_path / "umesh.safetensors", type(method), scene)
    np.testing.assert_array_equal(loaded.predict(forces), method.predict(forces))
    network, grid = UNet(8, 1), padded_grid(grid_map(scene.mesh), 1)
    network.load_state_dict(
        {
            name.removeprefix("network."): torch.from_numpy(values)
            for name, values in method.arrays_.items()
            if name.startswith("network.")
        }
    )
    scaled = torch.from_numpy((forces / method.input_scale_).astype(np.float32))
    with torch.inference_mode():
        expected = grid.to_nodes(network(grid.to_grid(scaled))).numpy() * method.output_scale_
    expected[:, scene.fixed_nodes] = 0.0
    largest = np.abs(expected).max()
    np.testing.assert_allclose(method.predict(forces), expected, rtol=0, atol=1e-5 * largest)
