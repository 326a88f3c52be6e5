"""The directive `plot-orders`: orders of convergence, computed when the site is built."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import Discretisation
from mor_bench.scene.mesh import box_mesh
from tests.verification.laws_and_elements import (
    COMPRESSIBLE,
    ELEMENTS,
    LAWS,
    manufactured_error,
)

SIZES = {"quadratic tetrahedron": (2, 3, 4), "tetrahedron": (4, 6, 8, 12, 16)}
USUAL_SIZES = (4, 6, 8)


def draw(path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.8), layout="constrained")
    law = COMPRESSIBLE["neo-hookean"]
    for element, selective in ELEMENTS:
        sizes = SIZES.get(element, USUAL_SIZES)
        errors = [manufactured_error(n, element, selective, law)[0] for n in sizes]
        h = 1.0 / np.array(sizes)
        order = np.log(errors[-2] / errors[-1]) / np.log(h[-2] / h[-1])
        name = f"{element}{', selective' if selective else ''}: order {order:.2f}"
        left.loglog(h, errors, "o-", label=name)
    left.set(xlabel="size of a cell", ylabel="L2 error of a manufactured solution")
    left.set_ylim(top=5.0 * left.get_ylim()[1])
    left.xaxis.set_minor_formatter(plt.NullFormatter())
    left.set_xticks([0.0625, 0.125, 0.25, 0.5], ["1/16", "1/8", "1/4", "1/2"])
    _taylor(right)
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=8)
        axes.grid(color="#e8e8e8")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _taylor(axes: plt.Axes) -> None:
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 2, 2))
    dofs = np.arange(mesh.n_dofs).reshape(-1, 3)
    generator = np.random.default_rng(0)
    u = 0.05 * generator.normal(size=mesh.n_dofs)
    du = 0.05 * generator.normal(size=mesh.n_dofs)
    steps = np.geomspace(1e-3, 1e-1, 7)
    for name, law in LAWS.items():
        body = Assembler(Discretisation(mesh.points, mesh.cells, law), dofs, mesh.n_dofs)
        start = body.force(u)
        rest = [
            abs(body.force(u + t * du).energy_j - start.energy_j - t * float(start.force @ du))
            for t in steps
        ]
        axes.loglog(steps, rest, "o-", ms=3, label=name)
    axes.loglog(steps, 2 * rest[-1] * (steps / steps[-1]) ** 2, "k--", lw=1, label="order 2")
    axes.set(xlabel="step", ylabel="Taylor remainder of the energy (J)")


class PlotOrders(SphinxDirective):
    """Draw the picture and insert it."""

    def run(self) -> list[nodes.Node]:
        path = Path(self.env.srcdir) / "methods" / "orders-of-convergence.png"
        draw(path)
        return [nodes.image(uri="methods/orders-of-convergence.png", alt="Orders of convergence")]


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("plot-orders", PlotOrders)
    return {"parallel_read_safe": True}
