"""Rendered meshes: PyVista draws them off-screen, in a process of its own.

A fault of the graphics driver ends that process only. Without PyVista, or after a fault, the caller
gets a reason and draws with matplotlib instead.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.image import imread
from numpy.typing import NDArray

from mor_bench.report.projection import View
from mor_bench.sandbox.fork_server import environment
from mor_bench.scratch import scratch_folder

TIME_LIMIT_S = 60.0
"""Longest time of rendering all panels of a figure."""

PROCESS = "mor_bench.report.render_process"

JOB = "job.npz"

FAINT, WIRE = "#b5b5b5", "#222222"
"""Colours of the faint and of the dark wire frame."""


@dataclass(frozen=True)
class Shot:
    """A coloured surface inside the wire frame of a second one, and a faint third one.

    Attributes
    ----------
    points : (n_nodes, 3) float64
        Nodes of the surface, m.
    values : (n_nodes,) float64
        Values that colour it; NaN leaves it blank.
    wires, faint : (n_nodes, 3) float64
        Nodes of the wire frame and of the faint one, m.
    """

    points: NDArray[np.float64]
    values: NDArray[np.float64]
    wires: NDArray[np.float64]
    faint: NDArray[np.float64]


@dataclass(frozen=True)
class Look:
    """What all shots of a figure share.

    Attributes
    ----------
    facets : (n_facets, 3 or 4) int64
        Node numbers of the surface's facets.
    view : View
    frame : (2, 2) float64
        Shown box in screen coordinates, m.
    values : (float, float)
        Ends of the logarithmic colour scale.
    colour_map : str
    width : int
        Width of an image in pixels.
    """

    facets: NDArray[np.int64]
    view: View
    frame: NDArray[np.float64]
    values: tuple[float, float]
    colour_map: str
    width: int


def show_shots(panels: Sequence[Axes], shots: Sequence[Shot], look: Look) -> str:
    """Show a shot in each panel; return how the meshes were drawn, in a sentence.

    The wire frames are drawn over the rendered surfaces, so that no surface hides them.
    """
    images, reason = render_shots(shots, look)
    (left, low), (right, high) = look.frame
    for i, (axes, shot) in enumerate(zip(panels, shots, strict=True)):
        axes.set_aspect("equal")
        if images:
            box = (left, right, low, high)
            axes.imshow(images[i], extent=box, interpolation="antialiased", zorder=2)
        else:
            _draw(axes, shot, look)
        wires = {"colors": WIRE, "linewidths": 0.5, "zorder": 4}
        seen = look.facets[look.view.facing(shot.wires, look.facets)]
        look.view.draw_edges(axes, shot.wires, seen, wires)
        axes.set_xlim(left, right)
        axes.set_ylim(low, high)
    return "Rendered with PyVista." if images else f"Drawn with matplotlib: {reason}."


def render_shots(
    shots: Sequence[Shot], look: Look, time_limit_s: float = TIME_LIMIT_S
) -> tuple[list[NDArray[np.float32]], str]:
    """Render meshes to images (height, width, 3 or 4); return also the reason if there are none.

    The process ends with this one, and at the time limit.
    """
    if find_spec("pyvista") is None:
        return [], "the extra `viz` is not installed"
    with scratch_folder() as folder:
        _write(folder, shots, look)
        command = [sys.executable, "-m", PROCESS, str(folder), str(os.getpid())]
        calm = {k: v for k, v in environment().items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
        try:
            done = subprocess.run(
                command, env=calm, capture_output=True, timeout=time_limit_s, text=True
            )
        except subprocess.TimeoutExpired:
            return [], f"PyVista took more than {time_limit_s:g} s"
        except OSError as error:
            return [], f"PyVista's process did not start: {error}"
        files = [folder / f"{i}.png" for i in range(len(shots))]
        if done.returncode or not all(map(Path.exists, files)):
            said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            return [], f"PyVista failed: {said[-1][:200]}"
        return [np.asarray(imread(path)) for path in files], ""


def _write(folder: Path, shots: Sequence[Shot], look: Look) -> None:
    towards, right, up = look.view.axes()
    stacked = {
        name: np.stack([getattr(shot, name) for shot in shots])
        for name in ("points", "values", "faint")
    }
    np.savez(
        folder / JOB,
        facets=look.facets,
        towards=towards,
        right=right,
        up=up,
        frame=look.frame,
        range=np.array(look.values),
        colour_map=np.array(look.colour_map),
        width=np.array(look.width),
        faint_colour=np.array(FAINT),
        points=stacked["points"],
        values=stacked["values"],
        faint=stacked["faint"],
    )


def _draw(axes: Axes, shot: Shot, look: Look) -> None:
    """Draw with matplotlib what `render_shots` renders."""
    faint = {"colors": FAINT, "linewidths": 0.5, "zorder": 1}
    look.view.draw_edges(axes, shot.faint, look.facets, faint)
    predicted = np.asarray(np.isfinite(shot.points).all(axis=1))
    whole = look.facets[predicted[look.facets].all(axis=1)]
    if len(whole):
        scale = LogNorm(*look.values, clip=True)
        means = np.maximum(shot.values[whole].mean(axis=1), look.values[0])
        colours = np.asarray(matplotlib.colormaps[look.colour_map](scale(means)))[:, :3]
        look.view.draw_surface(axes, shot.points, whole, (colours, "face"))
