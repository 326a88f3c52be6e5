"""PCA regression: a polynomial ridge regression between principal coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.coordinate_regression import (
    Array,
    Arrays,
    CoordinateRegression,
    CoordinateSamples,
    Input,
)
from mor_bench.surrogates.monomials import Monomials, monomial_indices, n_monomials

LEAST_SCALE = 1e-2
"""Least divisor of a monomial in the fit, over the largest one.

A monomial that is nearly zero under all training loads is not under others. Divided by its own
root mean square, it would get a large weight for a small penalty.
"""

MAX_FEATURE_BYTES = 2 * 2**30
"""Largest size of the monomials of all training samples, bytes; a fit holds several copies."""


@dataclass(eq=False)
class PCARegression(CoordinateRegression):
    """g(z) = W p(z), with p the monomials of z, by ridge regression; see `CoordinateRegression`.

    The fit minimises errors relative to the displacement of each sample. `input`, `n_input_modes`
    and `n_output_modes` are those of `CoordinateRegression`.

    Parameters
    ----------
    degree : int
        Highest degree of the monomials, 1 to 4; 1 is plain ridge regression. A fit is refused if
        they need more than `MAX_FEATURE_BYTES`.
    ridge : float
        Tikhonov weight relative to the mean squared feature, with features scaled to unit root mean
        square; small ones less, see `LEAST_SCALE`.
    """

    input: Input = "linear-response"
    n_input_modes: Annotated[int, Field(ge=1)] = 20
    n_output_modes: Annotated[int, Field(ge=1)] = 40
    degree: Annotated[int, Field(ge=1, le=4)] = 3
    ridge: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1e-6

    takes_parameters: ClassVar = True

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        from sklearn.linear_model import Ridge

        n_variables, n_samples = samples.z.shape[1], len(samples.z)
        n = n_monomials(n_variables, self.degree)
        if 8 * n * n_samples > MAX_FEATURE_BYTES:
            raise InvalidInputError(
                f"`degree` {self.degree} of {n_variables} input modes gives {n:,} "
                f"monomials, too many for {n_samples:,} samples: "
                f"{8e-09 * n * n_samples:.1f} GB; lower `degree` or `n_input_modes`."
            )
        features = Monomials(n_variables, monomial_indices(n_variables, self.degree))(samples.z)
        used = self._vanishing(n_variables)
        features = features if used.all() else features[:, used]
        scale = np.sqrt((features**2).mean(axis=0))
        scale = np.maximum(scale, LEAST_SCALE * scale.max())
        squared = samples.weights[:, 0] ** 2
        regression = Ridge(alpha=self.ridge * len(features), fit_intercept=False, solver="cholesky")
        regression.fit(features / scale, samples.values, sample_weight=squared / squared.mean())
        weights = np.zeros((samples.values.shape[1], n))
        weights[:, used] = np.atleast_2d(regression.coef_) / scale
        return {"weights": weights}

    def _vanishing(self, n_variables: int) -> NDArray[np.bool_]:
        """Return which monomials vanish without load: all but those of parameters alone."""
        at_rest = np.ones((1, n_variables))
        at_rest[:, : self.axes_.shape[1]] = 0.0
        values = Monomials(n_variables, monomial_indices(n_variables, self.degree))(at_rest)[0]
        return np.asarray(values == 0.0)

    def shapes(
        self, model: Arrays, n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int | None, ...]]:
        return {"weights": (n_outputs, n_monomials(n_inputs, self.degree))}

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        self.weights_ = model["weights"]
        n_variables = self.axes_.shape[1] + self.ends_.shape[1]
        self._monomials = Monomials(n_variables, monomial_indices(n_variables, self.degree))

    def coefficients(self, z: Array) -> Array:
        count(multiply_adds=len(z) * (self._monomials.n_products + self.weights_.size))
        return np.asarray(self._monomials(z) @ self.weights_.T)
