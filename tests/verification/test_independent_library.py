"""The full-order model against felupe, which differentiates the energy automatically."""

from __future__ import annotations

from typing import Any

import felupe
import numpy as np
import pytest
from felupe.constitution import tensortrax
from numpy.typing import NDArray
from tensortrax.math import exp, if_else, log, sqrt, trace
from tensortrax.math.linalg import det, inv

import mor_bench
from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics.model import FullOrderModel, rest_displacement
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.scene.scene import Scene

from .laws_and_elements import ELEMENTS, LAWS, discretisation

Array = NDArray[np.float64]


def root(c: Any) -> Any:
    """Return U with U² = C, by Denman and Beavers' iteration; eigenvalues would lose digits."""
    y, z = c, inv(c) @ c
    for _ in range(6):
        y, z = 0.5 * (y + inv(z)), 0.5 * (z + inv(y))
    return y


def fibres(c: Any, k1: float, k2: float, n: Array) -> Any:
    """Return the energy of a family of fibres with the 6 components n of N."""
    length = n[0] * c[0, 0] + n[1] * c[1, 1] + n[2] * c[2, 2]
    length = length + 2 * (n[3] * c[0, 1] + n[4] * c[0, 2] + n[5] * c[1, 2])
    x = det(c) ** (-1 / 3) * length - 1
    energy = k1 / (2 * k2) * (exp(k2 * x**2) - 1)
    return if_else(x >= 0, energy, 0 * energy)


def felupe_law(scene: Scene) -> Any:
    """Return the scene's law, with its energy as a function of C."""
    assert scene.material is not None
    models, p = tensortrax.models.hyperelastic, scene.material.parameters
    name = scene.generated.material.law
    if name == "saint-venant-kirchhoff":
        return tensortrax.Hyperelastic(models.saint_venant_kirchhoff, mu=p[1], lmbda=p[0])

    def energy(c: Any) -> Any:
        j = sqrt(det(c))
        if name == "neo-hookean":
            return p[1] / 2 * (trace(c) - 3) - p[1] * log(j) + p[0] / 2 * log(j) ** 2
        if name == "mooney-rivlin":
            return models.mooney_rivlin(c, C10=p[0], C01=p[1]) + p[2] / 2 * (j - 1) ** 2
        if name == "corotational":
            stretch = trace(root(c))
            return p[1] * (trace(c) - 2 * stretch + 3) + p[0] / 2 * (stretch - 3) ** 2
        if name == "yeoh":
            return models.yeoh(c, C10=p[0], C20=p[1], C30=p[2]) + p[3] / 2 * (j - 1) ** 2
        if name == "holzapfel-gasser-ogden":
            matrix = models.yeoh(c, C10=p[0], C20=0.0, C30=0.0) + p[1] / 2 * (j - 1) ** 2
            return matrix + sum(fibres(c, p[2], p[3], n) for n in np.reshape(p[4:], (-1, 6)))
        # With exponents 2 and -2 the invariants suffice; automatic eigenvalues lose digits.
        return models.mooney_rivlin(c, C10=p[1] / p[2], C01=p[3] / p[4]) + p[0] / 2 * (j - 1) ** 2

    return tensortrax.Hyperelastic(energy)


REGIONS = {
    4: ("tetra", felupe.RegionTetra),
    8: ("hexahedron", felupe.RegionHexahedron),
    10: ("tetra10", felupe.RegionQuadraticTetra),
}


def felupe_solution(scene: Scene, forces: Array) -> Array:
    """Return displacements, (n_nodes, 3) m."""
    kind, region = REGIONS[scene.mesh.cells.shape[1]]
    mesh = felupe.Mesh(scene.mesh.points, scene.mesh.cells, kind)
    field = felupe.FieldContainer([felupe.Field(region(mesh), dim=3)])
    still = np.isin(np.arange(scene.mesh.n_dofs), scene.fixed_dofs).reshape(-1, 3)
    fixed = {
        f"support {axis}": felupe.Boundary(
            field[0], mask=still[:, axis], skip=tuple(axis != other for other in range(3))
        )
        for axis in range(3)
    }
    dof0, dof1 = felupe.dof.partition(field, fixed)
    load = felupe.PointLoad(field, np.arange(scene.mesh.n_nodes), forces)
    items = [felupe.SolidBody(felupe_law(scene), field), load]
    if gravity := scene.generated.gravity:
        density, acceleration = gravity.density_kg_m3, np.array(gravity.acceleration_m_s2)
        items.append(felupe.SolidBodyForce(field, values=acceleration, scale=density))
    result = felupe.newtonraphson(
        items=items,
        dof0=dof0,
        dof1=dof1,
        tol=1e-11,
        verbose=0,
    )
    return np.asarray(result.x[0].values)


def compare(scene: Scene, n_loads: int) -> None:
    """Compare solutions for random loads on random patches, to 1e-8."""
    model, rng, weights = (
        FullOrderModel(scene),
        np.random.default_rng(7),
        scene.patch_weights.toarray(),
    )
    for _ in range(n_loads):
        direction = rng.normal(size=3)
        vector = direction / np.linalg.norm(direction) * rng.uniform(0.2, 1.0)
        forces = weights[rng.integers(len(weights))][:, None] * vector
        ours = np.zeros(scene.mesh.n_dofs)
        load = forces.ravel()[scene.free_dofs]
        ours[scene.free_dofs] = model.solve(
            load, options=NewtonOptions(tolerance=1e-10)
        ).displacement
        if (rest := rest_displacement(scene)) is not None:
            ours += rest.ravel()
        theirs = felupe_solution(scene, forces).ravel()
        assert np.linalg.norm(ours - theirs) <= 1e-8 * np.linalg.norm(theirs)


@pytest.mark.slow
def test_solutions_agree_with_felupe_on_twenty_random_loads() -> None:
    compare(mor_bench.load_scene("beam-coarse"), 20)


@pytest.mark.parametrize("kind", [kind for kind in ELEMENTS if not kind[1]])
@pytest.mark.parametrize("law", list(LAWS))
def test_solutions_agree_with_felupe_for_every_law_and_element(
    law: str, kind: tuple[str, bool]
) -> None:
    spec = mor_bench.load_scene("beam-tiny").spec.model_dump(mode="json")
    material = material_table(law, 500.0, 0.4)
    if law == "ogden":
        material |= {"alpha": [2.0, -2.0], "mu_pa": [140.0, -35.0]}
    compare(
        mor_bench.load_scene(
            {**spec, "discretisation": discretisation(kind), "material": material}
        ),
        2,
    )
