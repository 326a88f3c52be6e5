"""Hyperelastic laws: their parameters, split into a volumetric part and the rest.

Selective integration needs this split: it uses the cell's mean gradient in the volumetric part.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from math import hypot
from typing import ClassVar, Self

from mor_bench.specs import (
    FibreMaterial,
    MooneyRivlinMaterial,
    OgdenMaterial,
    TwoLameMaterial,
    YeohMaterial,
)


class Material(ABC):
    """A hyperelastic law; `law` is its number in `mor_bench.mechanics.laws`."""

    law: ClassVar[int]

    @abstractmethod
    def _scaled(self, volume: float, shape: float) -> tuple[float, ...]:
        """Return the parameters with a factor for the volumetric part and one for the rest."""

    @property
    @abstractmethod
    def poisson_at_rest(self) -> float:
        """Poisson's ratio at small strains."""

    @property
    @abstractmethod
    def shear_at_rest(self) -> float:
        """Shear modulus at small strains, Pa; without fibres."""

    @property
    def young_at_rest(self) -> float:
        """Young's modulus at small strains, Pa; without fibres."""
        return 2.0 * (1.0 + self.poisson_at_rest) * self.shear_at_rest

    @abstractmethod
    def with_poisson(self, poisson: float) -> Self:
        """Return the law with another Poisson's ratio at rest, and the rest of it unchanged."""

    @property
    def parameters(self) -> tuple[float, ...]:
        """Parameters of the law's function."""
        return self._scaled(1.0, 1.0)

    @property
    def shape_parameters(self) -> tuple[float, ...]:
        """The parameters without the volumetric part."""
        return self._scaled(0.0, 1.0)

    @property
    def volume_parameters(self) -> tuple[float, ...]:
        """The parameters of the volumetric part alone."""
        return self._scaled(1.0, 0.0)


def lame_parameters(young_pa: float, poisson: float) -> tuple[float, float]:
    """Return λ = Yν / ((1 + ν)(1 - 2ν)) and μ = Y / (2(1 + ν)), Pa."""
    return young_pa * poisson / ((1 + poisson) * (1 - 2 * poisson)), young_pa / (2 * (1 + poisson))


def poisson_of(bulk_pa: float, shear_pa: float) -> float:
    """Return ν = (3κ - 2μ) / (2 (3κ + μ))."""
    return (3 * bulk_pa - 2 * shear_pa) / (2 * (3 * bulk_pa + shear_pa))


def bulk_of(poisson: float, shear_pa: float) -> float:
    """Return κ = 2μ (1 + ν) / (3 (1 - 2ν)), Pa."""
    return 2 * shear_pa * (1 + poisson) / (3 * (1 - 2 * poisson))


@dataclass(frozen=True)
class _TwoLame(Material):
    young_pa: float
    poisson: float

    @property
    def poisson_at_rest(self) -> float:
        return self.poisson

    @property
    def shear_at_rest(self) -> float:
        return self.lame_mu

    @property
    def lame_lambda(self) -> float:
        """λ, Pa."""
        return lame_parameters(self.young_pa, self.poisson)[0]

    @property
    def lame_mu(self) -> float:
        """μ, Pa."""
        return lame_parameters(self.young_pa, self.poisson)[1]

    def with_poisson(self, poisson: float) -> Self:
        return replace(self, young_pa=2 * self.lame_mu * (1 + poisson), poisson=poisson)

    def _scaled(self, volume: float, shape: float) -> tuple[float, ...]:
        return volume * self.lame_lambda, shape * self.lame_mu


class SaintVenantKirchhoff(_TwoLame):
    """W(E) = λ/2 tr(E)² + μ tr(E²), with the Green-Lagrange strain E.

    The law is exact for large rotations and wrong for large strains: it softens in compression,
    with a limit point at stretch 1/√3. A mirrored element, diag(-1, 1, 1), stores no energy, so
    only det F shows an inversion.
    """

    law = 0


class NeoHookean(_TwoLame):
    """W = μ/2 (tr C - 3) - μ ln J + λ/2 (ln J)²: stiffens without bound towards J = 0."""

    law = 1


class Corotational(_TwoLame):
    """W = μ Σ (λ_a - 1)² + λ/2 (Σ (λ_a - 1))²: Hooke's law of U - I, with F = R U.

    λ_a are the principal stretches. Real-time simulators use it, since it is exact for large
    rotations and linear in the stretches. It does not stiffen towards J = 0.
    """

    law = 5


class _WithBulk(Material):
    """A law whose volumetric part is κ/2 (J - 1)²; a subclass has the field κ."""

    bulk_pa: float

    @property
    def poisson_at_rest(self) -> float:
        """Poisson's ratio at small strains; without fibres."""
        return poisson_of(self.bulk_pa, self.shear_at_rest)

    def with_poisson(self, poisson: float) -> Self:
        bulk = bulk_of(poisson, self.shear_at_rest)
        return type(self)(**{**vars(self), "bulk_pa": bulk})


@dataclass(frozen=True)
class MooneyRivlin(_WithBulk):
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

    def _scaled(self, volume: float, shape: float) -> tuple[float, ...]:
        return shape * self.c10_pa, shape * self.c01_pa, volume * self.bulk_pa

    @property
    def shear_at_rest(self) -> float:
        return 2 * (self.c10_pa + self.c01_pa)


@dataclass(frozen=True)
class Ogden(_WithBulk):
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

    def _scaled(self, volume: float, shape: float) -> tuple[float, ...]:
        terms = zip(self.mu_pa, self.alpha, strict=True)
        pairs = [value for mu, alpha in terms for value in (shape * mu, alpha)]
        return (volume * self.bulk_pa, *pairs)

    @property
    def shear_at_rest(self) -> float:
        return 0.5 * sum(mu * alpha for mu, alpha in zip(self.mu_pa, self.alpha, strict=True))


@dataclass(frozen=True)
class Yeoh(_WithBulk):
    """W = c10 x + c20 x² + c30 x³ + κ/2 (J - 1)², with x = J^(-2/3) I₁ - 3.

    Parameters
    ----------
    c10_pa, c20_pa, c30_pa : float
        Pa; the shear modulus at rest is 2 c10.
    bulk_pa : float
        κ, Pa.
    """

    c10_pa: float
    c20_pa: float
    c30_pa: float
    bulk_pa: float
    law: ClassVar[int] = 4

    def _scaled(self, volume: float, shape: float) -> tuple[float, ...]:
        shear = (shape * c for c in (self.c10_pa, self.c20_pa, self.c30_pa))
        return (*shear, volume * self.bulk_pa)

    @property
    def shear_at_rest(self) -> float:
        return 2 * self.c10_pa


@dataclass(frozen=True)
class HolzapfelGasserOgden(_WithBulk):
    """W = c10 (Ī₁ - 3) + κ/2 (J - 1)² + Σ k1/(2 k2) (exp(k2 ⟨x⟩²) - 1), x = N:C̄ - 1.

    The sum is over families of fibres, C̄ = J^(-2/3) C, and ⟨x⟩ = max(x, 0), because fibres carry
    no compression. Fibres along a with dispersion d have N = d I + (1 - 3d) a ⊗ a. Gasser, Ogden &
    Holzapfel, Journal of the Royal Society Interface 3 (2006), 15-35. Displacements below 1e-10 of
    the body are inexact, because round-off then decides which fibres are slack.

    Parameters
    ----------
    c10_pa, k1_pa, bulk_pa : float
        Pa; the shear modulus of the matrix at rest is 2 c10.
    k2 : float
        How fast the fibres stiffen.
    dispersion : float
        d, from 0 for aligned fibres to 1/3 for fibres in all directions.
    fibres : tuple of tuple of float
        Direction of each family at rest, of any length.
    """

    c10_pa: float
    k1_pa: float
    k2: float
    dispersion: float
    fibres: tuple[tuple[float, float, float], ...]
    bulk_pa: float
    law: ClassVar[int] = 6

    def _scaled(self, volume: float, shape: float) -> tuple[float, ...]:
        stiffnesses = shape * self.c10_pa, volume * self.bulk_pa, shape * self.k1_pa, self.k2
        return (*stiffnesses, *(n for fibre in self.fibres for n in self._structure(fibre)))

    def _structure(self, fibre: tuple[float, float, float]) -> list[float]:
        """Return the 6 components of N, in the order 00 11 22 01 02 12."""
        length, d = hypot(*fibre), self.dispersion
        a = [component / length for component in fibre]
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        return [(1 - 3 * d) * a[i] * a[j] + (d if i == j else 0.0) for i, j in pairs]

    @property
    def shear_at_rest(self) -> float:
        return 2 * self.c10_pa


def make_material(
    spec: TwoLameMaterial | MooneyRivlinMaterial | OgdenMaterial | YeohMaterial | FibreMaterial,
) -> Material:
    """Return the law that a dataset file names."""
    if isinstance(spec, MooneyRivlinMaterial):
        return MooneyRivlin(spec.c10_pa, spec.c01_pa, spec.bulk_pa)
    if isinstance(spec, OgdenMaterial):
        return Ogden(spec.mu_pa, spec.alpha, spec.bulk_pa)
    if isinstance(spec, YeohMaterial):
        return Yeoh(spec.c10_pa, spec.c20_pa, spec.c30_pa, spec.bulk_pa)
    if isinstance(spec, FibreMaterial):
        return HolzapfelGasserOgden(**spec.model_dump(exclude={"law"}))
    return _TWO_LAME[spec.law](spec.young_pa, spec.poisson)


_TWO_LAME: dict[str, type[_TwoLame]] = {
    "saint-venant-kirchhoff": SaintVenantKirchhoff,
    "neo-hookean": NeoHookean,
    "corotational": Corotational,
}
