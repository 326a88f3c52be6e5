"""Hyperelastic laws. A law is its parameters and what the mechanics needs of them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SaintVenantKirchhoff:
    """W(E) = λ/2 tr(E)² + μ tr(E²), with E the Green-Lagrange strain.

    Exact in large rotations, wrong in large strains: it softens in compression (limit point at stretch 1/√3), and a
    mirrored element, diag(-1, 1, 1), stores no energy, so that only det F shows an inversion.

    Parameters
    ----------
    young_pa : float
        Young's modulus, Pa.
    poisson : float
        Poisson's ratio, in (-1, 0.5).
    """

    young_pa: float
    poisson: float

    @property
    def lame_lambda(self) -> float:
        """λ = Yν / ((1 + ν)(1 - 2ν)), Pa."""
        return self.young_pa * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))

    @property
    def lame_mu(self) -> float:
        """μ = Y / (2(1 + ν)), Pa."""
        return self.young_pa / (2 * (1 + self.poisson))
