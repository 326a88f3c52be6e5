"""Meshes that lie in no regular grid, made from boxes."""

from __future__ import annotations

import numpy as np

from mor_bench.scene.mesh import Mesh, box_mesh


def irregular_box(
    size_m: tuple[float, float, float],
    cells: tuple[int, int, int],
    tetrahedra: bool,
    jitter: float = 0.25,
    seed: int = 0,
) -> Mesh:
    """Return a box with nodes in random order, moved by up to ``jitter`` cells; faces stay flat."""
    generator = np.random.default_rng(seed)
    box = box_mesh(size_m, cells, tetrahedra)
    free = (box.points > box.bounds[0]) & (box.points < box.bounds[1])
    moves = generator.uniform(-jitter, jitter, box.points.shape) * np.divide(size_m, cells) * free
    order = generator.permutation(box.n_nodes)
    return Mesh((box.points + moves)[order], np.argsort(order)[box.cells])
