"""Table `[parameters]` of a dataset file: properties of the body that vary between samples."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationError, model_validator

from mor_bench.specs.base import Finite, StrictModel
from mor_bench.specs.material_spec import MaterialSpec
from mor_bench.specs.split_spec import MAX_OUTSIDE
from mor_bench.specs.support_spec import AXES

LIMITS: dict[str, tuple[float, float]] = {
    "young_pa": (1e-6, 1e15),
    "poisson": (-0.999999, 0.499999),
    "c10_pa": (1e-6, 1e15),
    "c01_pa": (0.0, 1e15),
    "c20_pa": (-1e15, 1e15),
    "c30_pa": (0.0, 1e15),
    "k1_pa": (1e-6, 1e15),
    "k2": (1e-6, 1e3),
    "dispersion": (0.0, 1.0 / 3.0),
    "bulk_pa": (1e-6, 1e15),
    "scale_x": (0.01, 100.0),
    "scale_y": (0.01, 100.0),
    "scale_z": (0.01, 100.0),
}
"""Valid values of each parameter that may be sampled, in the order of a sample's parameters."""


def _rising(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError("the lower end of the range must be less than the upper one")
    return value


Range = Annotated[tuple[Finite, Finite], Field(strict=False), AfterValidator(_rising)]
"""Lower and upper end of a range, from which values are drawn uniformly."""

Optional = Field(default=None, exclude_if=lambda value: value is None)


class Scale(StrictModel):
    """Factors by which the mesh is scaled along the axes, about the origin."""

    x: Range | None = Optional
    y: Range | None = Optional
    z: Range | None = Optional


class SampledParameters(StrictModel):
    """Ranges of the parameters that each sample draws beside its loads.

    Attributes
    ----------
    young_pa, poisson, c10_pa, c01_pa, c20_pa, c30_pa, k1_pa, k2, dispersion, bulk_pa : two floats
        Ranges of parameters of the material's law.
    scale : Scale
        Ranges of the mesh's scale per axis. Nodes of supports and of patches stay the same.
    outside : float, optional
        If given, values are drawn outside the ranges instead: from their ends up to this multiple
        of the half-width, measured from the middle.
    """

    young_pa: Range | None = Optional
    poisson: Range | None = Optional
    c10_pa: Range | None = Optional
    c01_pa: Range | None = Optional
    c20_pa: Range | None = Optional
    c30_pa: Range | None = Optional
    k1_pa: Range | None = Optional
    k2: Range | None = Optional
    dispersion: Range | None = Optional
    bulk_pa: Range | None = Optional
    scale: Scale | None = Optional
    outside: Annotated[float, Field(gt=1, le=MAX_OUTSIDE)] | None = Optional

    @model_validator(mode="after")
    def _has_ranges(self) -> SampledParameters:
        if not self.ranges:
            raise ValueError("`parameters` must hold at least one range")
        return self

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The range of each sampled parameter, by name, in the order of `LIMITS`."""
        given = {name: getattr(self, name, None) for name in LIMITS}
        given |= {f"scale_{axis}": getattr(self.scale, axis, None) for axis in AXES}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the sampled parameters; those of a scale are `scale_x` and so on."""
        return tuple(self.ranges)

    def values(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return parameters for coordinates in the unit interval, (n, n_parameters) both.

        Outside the ranges, the lower half of the interval gives values below, the upper half above.
        """
        low, high = np.array(list(self.ranges.values())).T
        if self.outside is None:
            return np.asarray(low + (high - low) * unit)
        signed, half = 2 * unit - 1, 0.5 * (high - low)
        size = half * (1 + (self.outside - 1) * np.abs(signed))
        return np.asarray(0.5 * (low + high) + np.where(signed < 0, -size, size))

    def ends(self) -> dict[str, tuple[float, float]]:
        """Return the lowest and the highest value of each parameter that may be drawn."""
        n = len(self.names)
        if self.outside is None:
            return self.ranges
        lowest, highest = self.values(np.array([np.zeros(n), np.ones(n)])).tolist()
        return dict(zip(self.names, zip(lowest, highest, strict=True), strict=True))


def wrong_parameters(parameters: SampledParameters, material: MaterialSpec) -> Iterator[str]:
    """Yield why the law of a material cannot take each of the wrong sampled parameters."""
    own = [name for name in LIMITS if name in type(material).model_fields]
    each = [_wrong(name, ends, material, own) for name, ends in parameters.ends().items()]
    if any(each):
        yield from filter(None, each)
        return
    for corner in _corners(parameters, own):
        try:
            material_with(material, corner)
        except ValidationError as error:
            reason = error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
            yield f"`parameters` must stay in the range of the law {material.law}: {reason}"
            return


def _wrong(
    name: str, ends: tuple[float, float], material: MaterialSpec, own: list[str]
) -> str | None:
    """Return why a parameter cannot be drawn between two values; None if it can."""
    if not name.startswith("scale_") and name not in own:
        return (
            f"`parameters.{name}` cannot be sampled: the law {material.law} has no such "
            f"parameter; allowed: {', '.join([*own, 'scale'])}"
        )
    least, most = LIMITS[name]
    low, high = ends
    if least <= low <= high <= most:
        return None
    return (
        f"`parameters.{name.replace('scale_', 'scale.')}` must stay in [{least:.9g}, {most:.9g}]; "
        f"values from {low:.9g} to {high:.9g} would be drawn"
    )


def _corners(parameters: SampledParameters, own: list[str]) -> Iterator[dict[str, float]]:
    """Yield all combinations of the lowest and the highest values of the law's parameters."""
    ends = {name: pair for name, pair in parameters.ends().items() if name in own}
    for values in product(*ends.values()):
        yield dict(zip(ends, values, strict=True))


def material_with(material: MaterialSpec, changed: dict[str, float]) -> Any:
    """Return a material with other values; raise pydantic's `ValidationError` if not valid."""
    return type(material).model_validate({**material.model_dump(), **changed})
