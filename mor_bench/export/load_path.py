"""The load path of a sample as an animated GIF."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from mor_bench.export.growing_load import load_steps
from mor_bench.export.output_path import new_file
from mor_bench.report.canvas import INK, LABEL, length_unit, log_ticks, plain
from mor_bench.report.number_format import number
from mor_bench.report.projection import View
from mor_bench.report.rendering import Look, Shot, show_shots
from mor_bench.scene.mesh import Mesh
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.store import write_atomically

VIEW = View(azimuth=-68.0, elevation=20.0)
COLOUR_MAP = "viridis_r"
SIZE_IN, DPI = (6.4, 3.6), 100

FRAME_MS, LAST_MS = 100, 1200
"""Duration of a frame, and of the last one, which shows the whole load."""

COLOURS = 256
"""Colours of the GIF."""


def export_load_path(data: Dataset, sample: int, out: str | Path, *, n_steps: int = 20) -> Path:
    """Write the deformation under a growing load of the test set as GIF; return the file.

    `load_steps` solves each step. PyVista renders the meshes if it is installed.

    Parameters
    ----------
    data : Dataset
    sample : int
        Number of the sample in the test set, counted from 0.
    out : path
        New file with the ending ``.gif``.
    n_steps : int
        Steps from rest to the whole load.

    Raises
    ------
    InvalidInputError
        If the sample does not exist, `n_steps` is less than 1, or the file exists.
    UnsupportedSceneError
        If the full-order model cannot solve the scene.
    SolverError
        If a step has no solution.
    """
    path, mesh = new_file(out, ".gif"), data.scene.mesh
    parts, steps = load_steps(data, sample, n_steps)
    frames = _frames(mesh, parts, steps, data.scene.name)
    buffer = io.BytesIO()
    durations = [FRAME_MS] * n_steps + [LAST_MS]
    frames[0].save(
        buffer, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0
    )
    write_atomically(path, buffer.getvalue())
    return path


def _frames(
    mesh: Mesh, parts: NDArray[np.float64], steps: NDArray[np.float64], name: str
) -> list[Image.Image]:
    """Draw a frame per step, coloured by the displacement."""
    sizes = np.linalg.norm(steps, axis=2)
    largest = float(sizes.max())
    screen = np.concatenate([VIEW.project(mesh.points + step)[0] for step in steps])
    margin = 0.04 * np.ptp(screen, axis=0).max()
    box = np.array([screen.min(axis=0) - margin, screen.max(axis=0) + margin])
    scale = (largest / 100, largest)
    look = Look(mesh.drawn_facets, VIEW, box, scale, COLOUR_MAP, int(2 * DPI * SIZE_IN[0]))
    shots = [
        Shot(mesh.points + step, size, mesh.points + step, mesh.points)
        for step, size in zip(steps, sizes, strict=True)
    ]
    unit, per_m = length_unit(largest)
    figures = []
    for part, size in zip(parts, sizes, strict=True):
        figure = Figure(figsize=SIZE_IN, dpi=DPI, facecolor="white")
        moved = f"largest displacement {number(per_m * float(size.max()))} {unit}"
        title = plain(f"{name}: {100 * part:.0f} % of the load, {moved}")
        figure.text(0.02, 0.95, title, fontsize=LABEL, color=INK, va="top", weight="bold")
        figure.add_axes((0.02, 0.24, 0.96, 0.62)).set_axis_off()
        bar = figure.add_axes((0.1, 0.17, 0.8, 0.04))
        colours = ScalarMappable(LogNorm(per_m * scale[0], per_m * scale[1]), COLOUR_MAP)
        figure.colorbar(colours, bar, orientation="horizontal", extend="min")
        log_ticks(bar.xaxis, (per_m * scale[0], per_m * scale[1]))
        bar.set_xlabel(f"displacement ({unit})", fontsize=LABEL, color=INK)
        figures.append(figure)
    show_shots([figure.axes[0] for figure in figures], shots, look)
    return [_image(figure) for figure in figures]


def _image(figure: Figure) -> Image.Image:
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    return Image.fromarray(pixels).quantize(COLOURS, dither=Image.Dither.NONE)
