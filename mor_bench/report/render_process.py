"""The process that renders meshes with PyVista: ``python -m … FOLDER PARENT``.

It reads FOLDER/job.npz, written by `mor_bench.report.rendering`, and writes an image per shot. It
ends with its parent.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mor_bench.parent_death import end_with_parent

BLANK = "#dddddd"
"""Colour of nodes without a value."""

Job = dict[str, NDArray[np.float64]]


def render_job(folder: Path) -> None:
    """Render every shot of a job to FOLDER/0.png, FOLDER/1.png and so on."""
    with np.load(folder / "job.npz", allow_pickle=False) as file:
        job = {name: file[name] for name in file.files}
    for i in range(len(job["points"])):
        _render(job, i, folder / f"{i}.png")


def _render(job: Job, i: int, path: Path) -> None:
    import pyvista

    (left, low), (right, high) = job["frame"]
    width = int(job["width"])
    size = [width, max(1, round(width * (high - low) / (right - left)))]
    facets = job["facets"].astype(np.int64)
    whole = np.column_stack([np.full(len(facets), facets.shape[1]), facets])
    shown = np.isfinite(job["points"][i]).all(axis=1)
    plotter = pyvista.Plotter(off_screen=True, window_size=size)
    plotter.set_background("white")
    plotter.enable_anti_aliasing("ssaa")
    faint = pyvista.PolyData(job["faint"][i], whole)
    plotter.add_mesh(faint, style="wireframe", color=str(job["faint_colour"]), line_width=2.0)
    body = whole[shown[facets].all(axis=1)]
    if len(body):
        surface = pyvista.PolyData(np.where(shown[:, None], job["points"][i], 0.0), body)
        first, last = job["range"]
        plotter.add_mesh(
            surface,
            scalars=np.clip(job["values"][i], first, last),
            clim=[first, last],
            log_scale=True,
            cmap=str(job["colour_map"]),
            nan_color=BLANK,
            show_edges=False,
            show_scalar_bar=False,
            ambient=0.75,  # colours should match the scale
            diffuse=0.3,
        )
    _point_camera(plotter, job)
    plotter.screenshot(str(path))
    plotter.close()


def _point_camera(plotter: object, job: Job) -> None:
    """Look along the view's direction without perspective, at the middle of the frame."""
    middle, (_, height) = job["frame"].mean(axis=0), np.ptp(job["frame"], axis=0)
    nodes = job["faint"].reshape(-1, 3)
    depth = (nodes @ job["towards"]).mean()
    focus = middle[0] * job["right"] + middle[1] * job["up"] + depth * job["towards"]
    distance = 10 * np.ptp(nodes, axis=0).max()
    plotter.enable_parallel_projection()  # type: ignore[attr-defined]
    camera = plotter.camera  # type: ignore[attr-defined]
    camera.focal_point = focus.tolist()
    camera.position = (focus + distance * job["towards"]).tolist()
    camera.up = job["up"].tolist()
    camera.parallel_scale = float(height) / 2
    camera.clipping_range = (0.01 * distance, 3 * distance)


if __name__ == "__main__":
    end_with_parent(int(sys.argv[2]))
    render_job(Path(sys.argv[1]))
