"""Directions of supports and of instruments: what they mean on meshes, and refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import SpecError, UnconstrainedBodyError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.other_meshes import refined
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.sampling import draw_loads

from .oblique import ROTATION, SPEC, turned
from .pressed_blocks import block, content

SPREAD: dict[str, Any] = {"spread_deg": 40.0, "samples": 60, "sampling": "sobol", "seed": 3}


def test_directions_along_an_axis_are_components() -> None:
    given = [
        {"region": f"{axis}-min", "direction": (-3.0 * np.eye(3)[k]).tolist()}
        for k, axis in enumerate("xyz")
    ]
    scene, other = load_scene({**SPEC, "supports": given}), load_scene(SPEC)
    assert scene.frames is None
    np.testing.assert_array_equal(scene.fixed_dofs, other.fixed_dofs)


def test_directions_of_one_node_add_up() -> None:
    oblique = {"region": "x-min", "direction": [1.0, 1.0, 0.0]}
    both = {"region": "x-min", "direction": [1.0, 2.0, 0.0]}
    along = {"region": "x-min", "components": ["z"]}
    base = {**SPEC, "loads": None}
    same = load_scene({**base, "supports": [oblique, oblique]}).frames
    assert same is not None
    assert (same.n_held == 1).all()
    two = load_scene({**base, "supports": [oblique, both]}).frames
    assert two is not None
    assert (two.n_held == 2).all()
    np.testing.assert_allclose(np.abs(two.axes[:, 2]), [[0.0, 0.0, 1.0]] * len(two.nodes))
    with pytest.raises(UnconstrainedBodyError, match="translation z"):
        FullOrderModel(load_scene({**base, "supports": [oblique, both]}))
    three = load_scene({**base, "supports": [oblique, both, along]})
    assert three.frames is None
    np.testing.assert_array_equal(three.fixed_nodes, np.flatnonzero(three.mesh.points[:, 0] == 0))


def test_finer_meshes_keep_oblique_supports() -> None:
    body = turned(load_scene(SPEC))
    finer = refined(body)
    assert finer.frames is not None
    local = finer.mesh.points @ ROTATION
    held = (np.abs(local) < 1e-9).sum(axis=1)
    np.testing.assert_array_equal(finer.frames.nodes, np.flatnonzero((held > 0) & (held < 3)))
    np.testing.assert_array_equal(finer.frames.n_held, held[finer.frames.nodes])
    for node, axes, n in zip(
        finer.frames.nodes, finer.frames.axes, finer.frames.n_held, strict=True
    ):
        own = ROTATION.T[np.abs(local[node]) < 1e-9]
        np.testing.assert_allclose(axes[:n].T @ axes[:n], own.T @ own, atol=1e-12)


@pytest.mark.parametrize(
    ("support", "message"),
    [
        ({"direction": [0.0, 0.0, 0.0]}, r"`supports\[0\].direction`: the largest component"),
        ({"direction": [1.0, 0.0]}, r"`supports\[0\].direction"),
        ({"direction": [1.0, float("nan"), 0.0]}, r"`supports\[0\].direction\[1\]`"),
        ({"direction": [1.0, 1.0, 0.0], "components": ["x"]}, "exclude each other; remove one"),
    ],
)
def test_wrong_directions_are_refused(support: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        load_scene({**SPEC, "supports": [{"region": "x-min", **support}]})


def test_several_mistakes_are_reported_at_once() -> None:
    wrong = [
        {"region": "x-min", "direction": [0.0, 0.0, 0.0]},
        {"region": {"plane_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]}, "components": ["q"]},
    ]
    with pytest.raises(SpecError) as raised:
        load_scene({**SPEC, "supports": wrong})
    for part in ("supports[0].direction", "supports[1].region", "supports[1].components[0]"):
        assert part in str(raised.value)


def test_other_scenes_keep_their_digest_and_have_no_frames() -> None:
    scene = mor_bench.load_scene("beam-tiny")
    assert scene.frames is None
    assert "direction" not in str(scene.spec.physics())


def test_an_instrument_moves_against_the_nearest_part_of_the_surface_by_default() -> None:
    table = content(loads=SPREAD)
    del table["loads"]["direction"]
    scene, expected = load_scene(table), block(loads=SPREAD)
    np.testing.assert_array_equal(
        draw_loads(scene, 0, 9).vectors, draw_loads(expected, 0, 9).vectors
    )
    assert "direction" not in scene.generated.physics()["loads"]
    beside = {"sphere": {"radius_m": 0.3, "centre_m": [1.35, 0.4, 0.3]}}
    loads = {"region": "surface", "instrument": beside, "magnitude_m": [0.06, 0.1]}
    del (table := content(loads=loads))["loads"]["direction"]
    drawn = draw_loads(load_scene(table), 0, 5).vectors[:, 0]
    assert (drawn[:, 0] < 0).all()
    assert np.abs(drawn[:, 1:]).max() < 1e-12
