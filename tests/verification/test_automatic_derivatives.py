"""Stress and tangent of every law, against automatic differentiation of its published energy.

The energies are written here once more, as functions of F in PyTorch. They share no code with the
kernels. Derivatives of principal stretches are singular where two are equal, so all stretches here
are distinct. `test_law_digits.py` has equal ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mor_bench.hard_cases.setups import dense, free_assembler
from mor_bench.mechanics.discretisation import Discretisation, quadrature_of
from mor_bench.scene.materials import (
    Corotational,
    HolzapfelGasserOgden,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    SaintVenantKirchhoff,
    Yeoh,
)
from mor_bench.scene.mesh import Mesh

from .laws_and_elements import EVERY, LAWS, at_points, quick_first, unit_box

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

Array = NDArray[np.float64]


def trace(tensor: Tensor) -> Tensor:
    return torch.diagonal(tensor, dim1=-2, dim2=-1).sum(-1)


def right_cauchy_green(F: Tensor) -> Tensor:
    return F.mT @ F


def isochoric(F: Tensor) -> Tensor:
    """Return C̄ = J^(-2/3) C."""
    return torch.pow(torch.linalg.det(F), -2 / 3)[..., None, None] * right_cauchy_green(F)


def volumetric(law: MooneyRivlin | Yeoh | Ogden | HolzapfelGasserOgden, F: Tensor) -> Tensor:
    """Return κ/2 (J - 1)²."""
    return law.bulk_pa / 2 * torch.square(torch.linalg.det(F) - 1)


def lame(law: SaintVenantKirchhoff | NeoHookean | Corotational) -> tuple[float, float]:
    """Return λ and μ of Young's modulus and Poisson's ratio."""
    young, nu = law.young_pa, law.poisson
    return young * nu / (1 + nu) / (1 - 2 * nu), young / 2 / (1 + nu)


def saint_venant_kirchhoff(law: SaintVenantKirchhoff, F: Tensor) -> Tensor:
    """Return λ/2 (tr E)² + μ E:E; Bonet, Gil & Wood, Nonlinear Solid Mechanics, 2016."""
    lam, mu = lame(law)
    strain = (right_cauchy_green(F) - torch.eye(3, dtype=F.dtype)) / 2
    return lam / 2 * trace(strain) ** 2 + mu * (strain * strain).sum((-2, -1))


def neo_hookean(law: NeoHookean, F: Tensor) -> Tensor:
    """Return μ/2 (I₁ - 3) - μ ln J + λ/2 (ln J)²; Bonet, Gil & Wood, 2016."""
    lam, mu = lame(law)
    log_j = torch.log(torch.linalg.det(F))
    return mu / 2 * (trace(right_cauchy_green(F)) - 3) - mu * log_j + lam / 2 * log_j**2


def mooney_rivlin(law: MooneyRivlin, F: Tensor) -> Tensor:
    """Return c10 (Ī₁ - 3) + c01 (Ī₂ - 3) + κ/2 (J - 1)².

    Mooney, Journal of Applied Physics 11 (1940), 582-592, with Ī₂ = ((tr C̄)² - tr C̄²) / 2.
    """
    bar = isochoric(F)
    second = (trace(bar) ** 2 - trace(bar @ bar)) / 2
    return law.c10_pa * (trace(bar) - 3) + law.c01_pa * (second - 3) + volumetric(law, F)


def yeoh(law: Yeoh, F: Tensor) -> Tensor:
    """Return Σ c_i0 (Ī₁ - 3)^i + κ/2 (J - 1)².

    Yeoh, Rubber Chemistry and Technology 66 (1993), 754-771.
    """
    coefficients = enumerate((law.c10_pa, law.c20_pa, law.c30_pa), start=1)
    x = trace(isochoric(F)) - 3
    return sum((c * x**i for i, c in coefficients), volumetric(law, F))


def ogden(law: Ogden, F: Tensor) -> Tensor:
    """Return Σ μ_p/α_p (λ̄₁^α_p + λ̄₂^α_p + λ̄₃^α_p - 3) + κ/2 (J - 1)².

    Ogden, Proceedings of the Royal Society A 326 (1972), 565-584, with λ̄ = J^(-1/3) λ.
    """
    stretches = torch.linalg.svdvals(F)
    bar = stretches / stretches.prod(-1, keepdim=True) ** (1 / 3)
    terms = zip(law.mu_pa, law.alpha, strict=True)
    return sum((mu / alpha * ((bar**alpha).sum(-1) - 3) for mu, alpha in terms), volumetric(law, F))


def corotational(law: Corotational, F: Tensor) -> Tensor:
    """Return μ ‖U - I‖² + λ/2 (tr(U - I))², by the principal stretches.

    Sifakis & Barbič, FEM simulation of 3D deformable solids, SIGGRAPH Courses, 2012.
    """
    lam, mu = lame(law)
    strains = torch.linalg.svdvals(F) - 1
    return mu * torch.square(strains).sum(-1) + lam / 2 * torch.square(strains.sum(-1))


def fibre_strains(law: HolzapfelGasserOgden, F: Tensor) -> Tensor:
    """Return Ē = d (Ī₁ - 3) + (1 - 3d) (a·C̄a - 1) of each family along a with dispersion d."""
    bar, d = isochoric(F), law.dispersion
    a = torch.nn.functional.normalize(torch.tensor(law.fibres, dtype=F.dtype), dim=-1)
    squares = torch.einsum("ai,...ij,aj->...a", a, bar, a)
    return d * (trace(bar)[..., None] - 3) + (1 - 3 * d) * (squares - 1)


def holzapfel_gasser_ogden(law: HolzapfelGasserOgden, F: Tensor) -> Tensor:
    """Return c10 (Ī₁ - 3) + k1/(2 k2) Σ (exp(k2 ⟨Ē⟩²) - 1) + κ/2 (J - 1)².

    Gasser, Ogden & Holzapfel, Journal of the Royal Society Interface 3 (2006), 15-35. Fibres carry
    no compression: ⟨Ē⟩ = max(Ē, 0).
    """
    stretched = torch.clamp(fibre_strains(law, F), min=0)
    fibres = torch.exp(law.k2 * stretched**2) - 1
    matrix = law.c10_pa * (trace(isochoric(F)) - 3)
    return matrix + law.k1_pa / (2 * law.k2) * fibres.sum(-1) + volumetric(law, F)


ENERGIES: dict[str, Callable[[Any, Tensor], Tensor]] = {
    "saint-venant-kirchhoff": saint_venant_kirchhoff,
    "neo-hookean": neo_hookean,
    "mooney-rivlin": mooney_rivlin,
    "ogden": ogden,
    "yeoh": yeoh,
    "corotational": corotational,
    "holzapfel-gasser-ogden": holzapfel_gasser_ogden,
}


TOLERANCE = 1e-12
"""Relative; round-off reached 2e-14 here."""

STRETCHES = {
    "moderate": (1.15, 1.02, 0.9),
    "long": (2.4, 1.1, 0.6),
    "compressed": (0.75, 0.6, 0.45),
    "swollen": (1.9, 1.6, 1.4),
}


def deformations(stretches: tuple[float, ...], n: int = 8) -> Array:
    """Return F = Q₁ diag(stretches) Q₂ᵀ (n, 3, 3) with random rotations Q₁ and Q₂."""
    left, right = Rotation.random(2 * n, random_state=1).as_matrix().reshape(2, n, 3, 3)
    return np.asarray(left @ np.diag(stretches) @ np.swapaxes(right, -1, -2))


def first_derivatives(energy: Callable[[Tensor], Tensor], at: Tensor) -> Array:
    return np.asarray(torch.func.grad(energy)(at))


def second_derivatives(energy: Callable[[Tensor], Tensor], at: Tensor) -> Array:
    return np.asarray(torch.func.jacrev(torch.func.grad(energy))(at))


def assert_close(found: Array, expected: Array) -> None:
    """Assert that no error exceeds the tolerance times the largest expected value."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE * np.abs(expected).max())


@pytest.mark.parametrize("state", list(STRETCHES))
@pytest.mark.parametrize("law", list(LAWS))
def test_stress_and_tangent_are_the_derivatives_of_the_published_energy(
    law: str, state: str
) -> None:
    def energy(F: Tensor) -> Tensor:
        return ENERGIES[law](LAWS[law], F)

    for F in deformations(STRETCHES[state]):
        at = torch.from_numpy(F)
        P, A, stored, _ = at_points(LAWS[law], (F - np.eye(3))[None])
        assert stored == pytest.approx(float(energy(at)), rel=TOLERANCE)
        assert_close(P[0], first_derivatives(energy, at))
        assert_close(A[0], second_derivatives(energy, at))


def test_some_fibres_of_the_deformations_are_stretched_and_others_slack() -> None:
    law = LAWS["holzapfel-gasser-ogden"]
    assert isinstance(law, HolzapfelGasserOgden)
    for stretches in STRETCHES.values():
        strains = fibre_strains(law, torch.from_numpy(deformations(stretches)))
        assert (strains > 0.01).any()
        assert (strains < -0.01).any()


@pytest.mark.parametrize(
    ("law", "kind"), quick_first((law, kind) for law, kind in EVERY if not kind[1])
)
def test_force_and_stiffness_are_the_derivatives_of_the_energy_of_the_cells(
    law: str, kind: tuple[str, bool]
) -> None:
    rng, box = np.random.default_rng(1), unit_box(1, kind[0])
    mesh = Mesh(box.points + 0.03 * rng.normal(size=box.points.shape), box.cells)
    rule = quadrature_of(Discretisation(mesh.points, mesh.cells, LAWS[law]))
    weights, gradients = torch.from_numpy(rule.weights), torch.from_numpy(rule.gradients)
    cells, eye = torch.from_numpy(mesh.cells), torch.eye(3, dtype=torch.float64)

    def energy(u: Tensor) -> Tensor:
        F = eye + torch.einsum("cai,cqaj->cqij", u.reshape(-1, 3)[cells], gradients)
        return (weights * ENERGIES[law](LAWS[law], F)).sum()

    u = 0.1 * rng.normal(size=mesh.n_dofs)
    at = torch.from_numpy(u)
    model = free_assembler(mesh, LAWS[law])
    state, values = model.force_and_tangent(u)
    assert state.min_det_f > 0
    assert state.energy_j == pytest.approx(float(energy(at)), rel=TOLERANCE)
    assert_close(state.force, first_derivatives(energy, at))
    assert_close(dense(model, values), second_derivatives(energy, at))
