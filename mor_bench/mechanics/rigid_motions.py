"""Rigid motions that the supports and springs of a scene leave free."""

from __future__ import annotations

import numpy as np

from mor_bench.errors import UnconstrainedBodyError
from mor_bench.scene.scene import Scene

RIGID_MODES = (
    "translation x",
    "translation y",
    "translation z",
    "rotation about x",
    "rotation about y",
    "rotation about z",
)


def free_rigid_modes(scene: Scene) -> list[str]:
    """Return the rigid motions that the supports leave free, named by their largest component."""
    x = scene.mesh.points - scene.mesh.points.mean(axis=0)
    x = x / np.abs(x).max()
    modes = np.zeros((len(x), 3, 6))
    modes[:, :, :3] = np.eye(3)
    for axis in range(3):
        modes[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x)
    held = modes.reshape(-1, 6)[scene.fixed_dofs]
    if (frames := scene.frames) is not None:
        turned = frames.to_local(modes.reshape(-1, 6).T)[:, frames.held_dofs]
        held = np.concatenate([held, turned.T])
    if (springs := scene.spring_matrix) is not None:
        held = np.concatenate([held, springs @ modes.reshape(-1, 6) / springs.max()])
    if len(held) == 0:
        return list(RIGID_MODES)
    _, s, vt = np.linalg.svd(np.linalg.qr(held, mode="r"), full_matrices=True)
    free = vt[np.append(s, np.zeros(6 - len(s))) <= 1e-9 * s[0]]
    return [RIGID_MODES[int(np.abs(mode).argmax())] for mode in free]


def check_supports(scene: Scene) -> None:
    """Raise `UnconstrainedBodyError`, naming the rigid modes that the supports leave free."""
    free = free_rigid_modes(scene)
    if free:
        raise UnconstrainedBodyError(
            f"the supports of {scene.name} leave rigid motions free: {', '.join(free)}; "
            "fix at least three nodes not in line, or as many components elsewhere.",
            free_motions=tuple(free),
        )
