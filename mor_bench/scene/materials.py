"""Hyperelastic laws: their parameters, and how each splits into a volumetric part and the rest.

The split serves selective integration: the volumetric part alone is taken from the cell's mean gradient.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from mor_bench.specs import MooneyRivlinMaterial, OgdenMaterial, TwoLameMaterial


class Material(ABC):
    """A hyperelastic law.

    Attributes
    ----------
    law : int
        Number of the law in `mor_bench.mechanics.laws`.
    """

    law: ClassVar[int]

    @property
    @abstractmethod
    def parameters(self) -> tuple[float, ...]:
        """What the law's function takes."""

    @property
    @abstractmethod
    def shape_parameters(self) -> tuple[float, ...]:
        """The parameters without the volumetric part."""

    @property
    @abstractmethod
    def volume_parameters(self) -> tuple[float, ...]:
        """The parameters of the volumetric part alone."""

    @property
    @abstractmethod
    def poisson_at_rest(self) -> float:
        """Poisson's ratio of small strains."""


def lame_parameters(young_pa: float, poisson: float) -> tuple[float, float]:
    """λ = Yν / ((1 + ν)(1 - 2ν)) and μ = Y / (2(1 + ν)), Pa."""
    return young_pa * poisson / ((1 + poisson) * (1 - 2 * poisson)), young_pa / (2 * (1 + poisson))


@dataclass(frozen=True)
class _TwoLame(Material):
    """A law with Lamé's two parameters at rest."""

    young_pa: float
    poisson: float

    @property
    def poisson_at_rest(self) -> float:
        return self.poisson

    @property
    def lame_lambda(self) -> float:
        """λ, Pa."""
        return lame_parameters(self.young_pa, self.poisson)[0]

    @property
    def lame_mu(self) -> float:
        """μ, Pa."""
        return lame_parameters(self.young_pa, self.poisson)[1]

    @property
    def parameters(self) -> tuple[float, ...]:
        return (self.lame_lambda, self.lame_mu)

    @property
    def shape_parameters(self) -> tuple[float, ...]:
        return (0.0, self.lame_mu)

    @property
    def volume_parameters(self) -> tuple[float, ...]:
        return (self.lame_lambda, 0.0)


class SaintVenantKirchhoff(_TwoLame):
    """W(E) = λ/2 tr(E)² + μ tr(E²), with E the Green-Lagrange strain.

    Exact in large rotations, wrong in large strains: it softens in compression (limit point at stretch 1/√3), and a
    mirrored element, diag(-1, 1, 1), stores no energy, so that only det F shows an inversion.
    """

    law = 0


class NeoHookean(_TwoLame):
    """W = μ/2 (tr C - 3) - μ ln J + λ/2 (ln J)²: stiffens without bound towards J = 0."""

    law = 1


@dataclass(frozen=True)
class MooneyRivlin(Material):
    """W = c10 (J^(-2/3) I₁ - 3) + c01 (J^(-4/3) I₂ - 3) + κ/2 (J - 1)².

    Parameters
    ----------
    c10_pa, c01_pa : float
        Pa; the shear modulus at rest is 2 (c10 + c01).
    bulk_pa : float
        κ, Pa.
    """

    c10_pa: float
    c01_pa: float
    bulk_pa: float
    law: ClassVar[int] = 2

    @property
    def parameters(self) -> tuple[float, ...]:
        return (self.c10_pa, self.c01_pa, self.bulk_pa)

    @property
    def shape_parameters(self) -> tuple[float, ...]:
        return (self.c10_pa, self.c01_pa, 0.0)

    @property
    def volume_parameters(self) -> tuple[float, ...]:
        return (0.0, 0.0, self.bulk_pa)

    @property
    def poisson_at_rest(self) -> float:
        return poisson_of(self.bulk_pa, 2 * (self.c10_pa + self.c01_pa))


@dataclass(frozen=True)
class Ogden(Material):
    """W = Σ μ_p/α_p (λ̄₁^α_p + λ̄₂^α_p + λ̄₃^α_p - 3) + κ/2 (J - 1)², with λ̄ = J^(-1/3) λ.

    Parameters
    ----------
    mu_pa : tuple of float
        μ_p, Pa.
    alpha : tuple of float
        α_p; the shear modulus at rest is Σ μ_p α_p / 2.
    bulk_pa : float
        κ, Pa.
    """

    mu_pa: tuple[float, ...]
    alpha: tuple[float, ...]
    bulk_pa: float
    law: ClassVar[int] = 3

    def _with(self, bulk: float, factor: float) -> tuple[float, ...]:
        pairs = [
            value
            for mu, alpha in zip(self.mu_pa, self.alpha, strict=True)
            for value in (factor * mu, alpha)
        ]
        return (bulk, *pairs)

    @property
    def parameters(self) -> tuple[float, ...]:
        return self._with(self.bulk_pa, 1.0)

    @property
    def shape_parameters(self) -> tuple[float, ...]:
        return self._with(0.0, 1.0)

    @property
    def volume_parameters(self) -> tuple[float, ...]:
        return self._with(self.bulk_pa, 0.0)

    @property
    def poisson_at_rest(self) -> float:
        return poisson_of(
            self.bulk_pa,
            0.5 * sum(mu * alpha for mu, alpha in zip(self.mu_pa, self.alpha, strict=True)),
        )


def poisson_of(bulk_pa: float, shear_pa: float) -> float:
    """ν = (3κ - 2μ) / (2 (3κ + μ))."""
    return (3 * bulk_pa - 2 * shear_pa) / (2 * (3 * bulk_pa + shear_pa))


def make_material(spec: TwoLameMaterial | MooneyRivlinMaterial | OgdenMaterial) -> Material:
    """The law that a dataset file asks for."""
    if isinstance(spec, MooneyRivlinMaterial):
        return MooneyRivlin(spec.c10_pa, spec.c01_pa, spec.bulk_pa)
    if isinstance(spec, OgdenMaterial):
        return Ogden(spec.mu_pa, spec.alpha, spec.bulk_pa)
    law = SaintVenantKirchhoff if spec.law == "saint-venant-kirchhoff" else NeoHookean
    return law(spec.young_pa, spec.poisson)
