"""Tables `[material]` and `[discretisation]` of a dataset file, and the names of the solvers."""

from __future__ import annotations

from math import hypot
from typing import Annotated, Literal

from pydantic import Field, model_validator

from mor_bench.specs.base import Finite, Modulus, StrictModel, in_range

SolverName = Literal["auto", "rotated-pcg", "jacobi-pcg", "cholesky", "superlu", "pardiso"]
"""Methods of solving equilibria; see `mor_bench.mechanics.model`."""


class Discretisation(StrictModel):
    """The elements and their quadrature.

    Selective integration takes the volumetric energy from the mean gradient of each hexahedron.

    Attributes
    ----------
    order : 1 or 2
        Degree of the shape functions. Order 2 gives tetrahedra ten nodes: nodes in the middles of
        edges are added to a mesh without them.
    """

    element: Literal["hexahedron", "tetrahedron"] = "hexahedron"
    integration: Literal["full", "selective"] = "full"
    order: Literal[1, 2] = Field(default=1, exclude_if=lambda value: value == 1)

    @model_validator(mode="after")
    def _has_points_to_spare(self) -> Discretisation:
        if self.element == "tetrahedron" and self.integration == "selective":
            raise ValueError(
                "`integration` of tetrahedra must be 'full'; got 'selective'. Where they lock, set "
                "`order = 2`"
            )
        if self.element == "hexahedron" and self.order == 2:
            raise ValueError("`order` of hexahedra must be 1; got 2")
        return self


class TwoLameMaterial(StrictModel):
    """A law of Young's modulus and Poisson's ratio."""

    law: Literal["saint-venant-kirchhoff", "neo-hookean", "corotational"]
    young_pa: Modulus
    poisson: Annotated[float, Field(gt=-1, lt=0.5), in_range(-0.999999, 0.499999, "")]


class MooneyRivlinMaterial(StrictModel):
    """Mooney-Rivlin with a quadratic volumetric energy."""

    law: Literal["mooney-rivlin"]
    c10_pa: Modulus
    c01_pa: Annotated[float, Field(ge=0, le=1e15)]
    bulk_pa: Modulus


_Shear = Annotated[Finite, in_range(-1e15, 1e15, "Pa")]
_Exponent = Annotated[Finite, in_range(-100, 100, "")]


class OgdenMaterial(StrictModel):
    """Ogden with a quadratic volumetric energy; every term needs mu_p alpha_p > 0."""

    law: Literal["ogden"]
    mu_pa: Annotated[tuple[_Shear, ...], Field(strict=False, min_length=1, max_length=20)]
    alpha: Annotated[tuple[_Exponent, ...], Field(strict=False, min_length=1, max_length=20)]
    bulk_pa: Modulus

    @model_validator(mode="after")
    def _stable_terms(self) -> OgdenMaterial:
        if len(self.mu_pa) != len(self.alpha):
            raise ValueError(
                "`mu_pa` and `alpha` must have equal lengths; "
                f"got {len(self.mu_pa)} and {len(self.alpha)}"
            )
        if not all(mu * alpha > 0 for mu, alpha in zip(self.mu_pa, self.alpha, strict=True)):
            raise ValueError(
                "every product of `mu_pa` and `alpha` must be > 0; "
                f"got {self.mu_pa} and {self.alpha}"
            )
        return self


class YeohMaterial(StrictModel):
    """Yeoh with a quadratic volumetric energy; shear must always raise the energy."""

    law: Literal["yeoh"]
    c10_pa: Modulus
    c20_pa: _Shear
    c30_pa: Annotated[float, Field(ge=0, le=1e15)]
    bulk_pa: Modulus

    @model_validator(mode="after")
    def _grows(self) -> YeohMaterial:
        # c10 + 2 c20 x + 3 c30 x² > 0 for all x >= 0.
        if self.c20_pa < 0 and self.c20_pa**2 >= 3 * self.c10_pa * self.c30_pa:
            raise ValueError(
                "a negative `c20_pa` needs c20² < 3 c10 c30, so that the energy grows with the "
                f"strain; got {self.c10_pa}, {self.c20_pa} and {self.c30_pa}"
            )
        return self


_Component = Annotated[float, Field(ge=-1e6, le=1e6)]
_Direction = Annotated[tuple[_Component, _Component, _Component], Field(strict=False)]


class FibreMaterial(StrictModel):
    """Holzapfel-Gasser-Ogden: a neo-Hookean matrix with families of fibres that carry tension."""

    law: Literal["holzapfel-gasser-ogden"]
    c10_pa: Modulus
    k1_pa: Modulus
    k2: Annotated[float, Field(ge=1e-6, le=1e3)]
    dispersion: Annotated[float, Field(ge=0, le=1 / 3)] = 0.0
    fibres: Annotated[tuple[_Direction, ...], Field(strict=False, min_length=1, max_length=8)]
    bulk_pa: Modulus

    @model_validator(mode="after")
    def _has_directions(self) -> FibreMaterial:
        short = [fibre for fibre in self.fibres if hypot(*fibre) < 1e-6]
        if short:
            raise ValueError(
                f"every direction in `fibres` must be at least 1e-06 long; got {short[0]}"
            )
        return self


MaterialSpec = Annotated[
    TwoLameMaterial | MooneyRivlinMaterial | OgdenMaterial | YeohMaterial | FibreMaterial,
    Field(discriminator="law"),
]
