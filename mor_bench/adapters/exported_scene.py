"""Scenes that fit into files of nodal forces and displacements on one mesh."""

from __future__ import annotations

from mor_bench.scene.scene import Scene


def why_not_written(scene: Scene) -> str | None:
    """Return why forces on one mesh do not describe a scene's samples; None if they do."""
    if scene.parameter_names:
        return "its body varies between samples"
    if scene.motion or scene.contact:
        return "methods are given the displacement of an instrument, not forces"
    if scene.observed_nodes is not None:
        return "methods are given displacements of a part of the surface, not forces"
    return None
