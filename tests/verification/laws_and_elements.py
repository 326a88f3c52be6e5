"""Laws and elements of the verification tests, and independent solutions."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.hard_cases.setups import of_order
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.banded import BandedCholesky
from mor_bench.mechanics.discretisation import Discretisation
from mor_bench.mechanics.elements import T4, shape_gradients
from mor_bench.mechanics.laws import LANES, point_stresses
from mor_bench.scene.interpolation import quadratic, trilinear
from mor_bench.scene.materials import (
    Corotational,
    HolzapfelGasserOgden,
    Material,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    SaintVenantKirchhoff,
    Yeoh,
)
from mor_bench.scene.mesh import Mesh, box_mesh

if TYPE_CHECKING:
    from _pytest.mark import ParameterSet

Array = NDArray[np.float64]
FIBRES = ((1.0, 1.0, 0.0), (1.0, -1.0, 0.5))
LAWS: dict[str, Material] = {
    "saint-venant-kirchhoff": SaintVenantKirchhoff(500.0, 0.4),
    "neo-hookean": NeoHookean(500.0, 0.4),
    "mooney-rivlin": MooneyRivlin(70.0, 20.0, 800.0),
    "ogden": Ogden((100.0, -20.0), (2.1, -1.7), 800.0),
    "yeoh": Yeoh(90.0, -30.0, 20.0, 800.0),
    "corotational": Corotational(500.0, 0.4),
    "holzapfel-gasser-ogden": HolzapfelGasserOgden(90.0, 60.0, 0.9, 0.1, FIBRES, 800.0),
}
COMPRESSIBLE: dict[str, Material] = {
    "saint-venant-kirchhoff": SaintVenantKirchhoff(1.0, 0.3),
    "neo-hookean": NeoHookean(1.0, 0.3),
    "mooney-rivlin": MooneyRivlin(0.15, 0.04, 0.8),
    "ogden": Ogden((0.3, -0.08), (2.1, -1.7), 0.8),
    "yeoh": Yeoh(0.19, -0.05, 0.03, 0.8),
    "corotational": Corotational(1.0, 0.3),
    "holzapfel-gasser-ogden": HolzapfelGasserOgden(0.19, 0.1, 0.9, 0.1, FIBRES, 0.8),
}
ELEMENTS = [
    ("hexahedron", False),
    ("hexahedron", True),
    ("tetrahedron", False),
    ("quadratic tetrahedron", False),
]
"""Names of elements, and whether they are integrated selectively."""

ISOTROPIC = [name for name in LAWS if name != "holzapfel-gasser-ogden"]
EVERY = list(itertools.product(LAWS, ELEMENTS))


def when(law: str, kind: tuple[str, bool]) -> tuple[pytest.MarkDecorator, ...]:
    """Return the marks of a pair: quick, slow or nightly.

    The kernel of each pair is compiled on its own, which takes seconds. Quick are every element
    with one law and every law on one element. Slow is each other law on one more element.
    """
    number, element = list(LAWS).index(law), ELEMENTS.index(kind)
    if number == 0 or element == 0:
        return ()
    return (pytest.mark.slow if (number + element) % 3 == 0 else pytest.mark.nightly,)


def quick_first(pairs: Iterable[tuple[str, tuple[str, bool]]] = EVERY) -> list[ParameterSet]:
    """Mark the pairs of laws and elements as `when` does."""
    return [pytest.param(law, kind, marks=when(law, kind)) for law, kind in pairs]


def mesh_options(element: str) -> dict[str, Any]:
    """Return the options of a mesh of an element for `mor_bench.hard_cases.setups`."""
    return {"tetrahedra": element != "hexahedron", "order": 2 if "quadratic" in element else 1}


def discretisation(kind: tuple[str, bool]) -> dict[str, Any]:
    """Return the table `[discretisation]` of an element."""
    order: dict[str, Any] = {"order": 2} if "quadratic" in kind[0] else {}
    integration = "selective" if kind[1] else "full"
    return {"element": kind[0].split()[-1], "integration": integration, **order}


def unit_box(n: int, element: str) -> Mesh:
    """Return n x n x n hexahedra in a unit box, or their tetrahedra."""
    options = mesh_options(element)
    mesh = box_mesh((1.0, 1.0, 1.0), (n, n, n), options["tetrahedra"])
    return of_order(mesh, options["order"])


def fine_rule(element: str) -> tuple[Array, Array, Array]:
    """Return shape functions, their derivatives and weights of a rule for loads and errors."""
    if element == "hexahedron":
        places = np.array(list(itertools.product((-1, 1), repeat=3))) / np.sqrt(3.0)
        return *trilinear(places), np.ones(8)
    if element == "tetrahedron":
        a, b = 0.58541020, 0.13819660
        shape = np.full((4, 4), b) + (a - b) * np.eye(4)
        return shape, np.repeat(T4.derivatives, 4, axis=0), np.full(4, 1 / 24)
    # A rule of a cube, folded to the tetrahedron.
    line, w = np.polynomial.legendre.leggauss(4)
    u, v, t = (axis.ravel() for axis in np.meshgrid(*[0.5 + 0.5 * line] * 3, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", w, w, w).ravel() / 8 * (1 - u) ** 2 * (1 - v)
    places = np.stack([u, (1 - u) * v, (1 - u) * (1 - v) * t], axis=1)
    return *quadratic(places), weights


def piola(law: Material, gradient: Array) -> Array:
    """Return a law's first Piola-Kirchhoff stress (..., 3, 3), P = τ F⁻ᵀ with Kirchhoff's τ.

    That of Saint Venant-Kirchhoff is P = F S.
    """
    eye, inverse = np.eye(3), np.swapaxes(np.linalg.inv(gradient), -1, -2)
    left = gradient @ np.swapaxes(gradient, -1, -2)
    j = np.linalg.det(gradient)[..., None, None]

    def deviator(tensor: Array) -> Array:
        return np.asarray(tensor - np.trace(tensor, axis1=-2, axis2=-1)[..., None, None] / 3 * eye)

    if isinstance(law, SaintVenantKirchhoff):
        strain = 0.5 * (np.swapaxes(gradient, -1, -2) @ gradient - eye)
        trace = np.trace(strain, axis1=-2, axis2=-1)[..., None, None]
        return np.asarray(gradient @ (law.lame_lambda * trace * eye + 2 * law.lame_mu * strain))
    if isinstance(law, NeoHookean):
        return np.asarray(
            (law.lame_mu * (left - eye) + law.lame_lambda * np.log(j) * eye) @ inverse
        )
    if isinstance(law, Corotational):  # P = R (2μ (U - I) + λ tr(U - I) I)
        values, vectors = np.linalg.eigh(np.swapaxes(gradient, -1, -2) @ gradient)
        stretch = np.einsum("...ia,...a,...ja->...ij", vectors, np.sqrt(values), vectors)
        trace = np.trace(stretch - eye, axis1=-2, axis2=-1)[..., None, None]
        biot = 2 * law.lame_mu * (stretch - eye) + law.lame_lambda * trace * eye
        return np.asarray(gradient @ np.linalg.inv(stretch) @ biot)
    if isinstance(law, MooneyRivlin):
        bar = j ** (-2 / 3) * left
        first = np.trace(bar, axis1=-2, axis2=-1)[..., None, None]
        tau = deviator(2 * law.c10_pa * bar + 2 * law.c01_pa * (first * bar - bar @ bar))
    elif isinstance(law, Yeoh):
        bar = j ** (-2 / 3) * left
        x = np.trace(bar, axis1=-2, axis2=-1)[..., None, None] - 3
        tau = deviator(2 * (law.c10_pa + 2 * law.c20_pa * x + 3 * law.c30_pa * x**2) * bar)
    elif isinstance(law, HolzapfelGasserOgden):
        bar = j ** (-2 / 3) * left
        tau = deviator(2 * law.c10_pa * bar)
        turned = j ** (-1 / 3) * gradient
        for fibre in np.array(law.fibres):
            along = np.outer(fibre, fibre) / (fibre @ fibre)
            structure = law.dispersion * eye + (1 - 3 * law.dispersion) * along
            tensor = turned @ structure @ np.swapaxes(turned, -1, -2)
            x = np.maximum(np.trace(tensor, axis1=-2, axis2=-1) - 1, 0)[..., None, None]
            tau = tau + deviator(2 * law.k1_pa * x * np.exp(law.k2 * x**2) * tensor)
    else:
        assert isinstance(law, Ogden)
        values, vectors = np.linalg.eigh(left)
        bar = j[..., 0] ** (-1 / 3) * np.sqrt(values)
        powers = sum(mu * bar**alpha for mu, alpha in zip(law.mu_pa, law.alpha, strict=True))
        tau = deviator(np.einsum("...ia,...a,...ja->...ij", vectors, powers, vectors))
    return np.asarray((tau + law.bulk_pa * (j - 1) * j * eye) @ inverse)


def at_points(law: Material, gradients: Array) -> tuple[Array, Array, float, float]:
    """Return P (n, 3, 3), dP/dF (n, 3, 3, 3, 3), energy and least det F; H = du/dX (n, 3, 3)."""
    n = len(gradients)
    padded = np.zeros((LANES, 9))
    padded[:n] = gradients.reshape(n, 9)
    weights = (np.arange(LANES) < n).astype(float)[None]
    parameters = np.repeat(law.parameters, LANES)[None]
    stress, slope = np.empty((1, 9 * LANES)), np.empty((1, 81 * LANES))
    energy, least = point_stresses(law.law)(
        np.ascontiguousarray(padded.T).reshape(1, -1), weights, parameters, stress, slope
    )
    P, A = stress.reshape(9, LANES).T[:n], slope.reshape(81, LANES).T[:n]
    return P.reshape(n, 3, 3), A.reshape(n, 3, 3, 3, 3), energy, least


AMPLITUDE = 0.05 * np.array([1.0, -1.0, 0.5])


def field(x: Array) -> Array:
    """Return u = 0.05 sin(πx) sin(πy) sin(πz) (1, -1, 0.5)."""
    return np.asarray(np.sin(np.pi * x).prod(axis=-1)[..., None] * AMPLITUDE)


def field_gradient(x: Array) -> Array:
    s, c = np.sin(np.pi * x), np.cos(np.pi * x)
    x_slope = c[..., 0] * s[..., 1] * s[..., 2]
    y_slope = s[..., 0] * c[..., 1] * s[..., 2]
    z_slope = s[..., 0] * s[..., 1] * c[..., 2]
    slopes = np.pi * np.stack([x_slope, y_slope, z_slope], axis=-1)
    return np.asarray(AMPLITUDE[:, None] * slopes[..., None, :])


def body_force(x: Array, law: Material) -> Array:
    """Return the force, N/m³, that holds the field, by differences of the stress."""

    def stress(x: Array) -> Array:
        return piola(law, np.eye(3) + field_gradient(x))

    h, total = 1e-3, np.zeros(x.shape)
    for j, e in enumerate(h * np.eye(3)):
        near, far = stress(x + e) - stress(x - e), stress(x + 2 * e) - stress(x - 2 * e)
        total -= ((8 * near - far) / (12 * h))[..., j]
    return total


def manufactured_error(n: int, element: str, selective: bool, law: Material) -> tuple[float, float]:
    """Return the L2 and H1 errors on n³ cells under the field's body force."""
    mesh, (shape, derivatives, weights) = unit_box(n, element), fine_rule(element)
    gradients, det_j = shape_gradients(mesh.points, mesh.cells, derivatives)
    volume = det_j * weights
    x = np.einsum("qa,cai->cqi", shape, mesh.points[mesh.cells])
    outer = np.any((mesh.points < 1e-9) | (mesh.points > 1 - 1e-9), axis=1)
    free = 3 * int((~outer).sum())
    dofs = np.full((mesh.n_nodes, 3), free)
    dofs[~outer] = np.arange(free).reshape(-1, 3)
    load = np.zeros(free + 1)
    forces = np.einsum("qa,cq,cqi->cai", shape, volume, body_force(x, law))
    np.add.at(load, dofs[mesh.cells], forces)
    model = Assembler(Discretisation(mesh.points, mesh.cells, law, selective), dofs, free)
    solver, u = BandedCholesky(model.pattern), np.zeros(free)
    for _ in range(5):
        state, values = model.force_and_tangent(u)
        u += solver.factor(values).solve(load[:-1] - state.force)
    nodal = np.append(u, 0.0)[dofs][mesh.cells]
    difference = np.einsum("qa,cai->cqi", shape, nodal) - field(x)
    slope = np.einsum("cai,cqaj->cqij", nodal, gradients) - field_gradient(x)
    squares = volume * (difference**2).sum(axis=-1), volume * (slope**2).sum(axis=(-2, -1))
    return float(np.sqrt(squares[0].sum())), float(np.sqrt(squares[1].sum()))
