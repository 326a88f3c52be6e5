"""Any regressor of scikit-learn between principal coordinates, named by its import path."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationInfo

from mor_bench.errors import InvalidInputError, MissingDependencyError, text_of
from mor_bench.specs.one_line_errors import nearest_name
from mor_bench.specs.public_class import public_class
from mor_bench.surrogates.coordinate_regression import (
    Array,
    Arrays,
    CoordinateRegression,
    CoordinateSamples,
    Input,
    Output,
)

NOT_IMPORTED = {"conftest", "experimental", "externals", "tests"}
"""Modules of scikit-learn without regressors of their own."""

JOINT = {"MLPRegressor"}
"""Regressors that learn several outputs at once, although their tags deny it."""

N_ANSWERS = 32
"""Number of training inputs with stored answers, by which a repeated fit is recognised."""

TOLERANCE = 1e-6
"""Largest accepted difference from these answers, relative to the largest of them."""

LARGEST = 1e38
"""Largest input; trees compare in single precision."""


def regressor_class(target: str) -> type[Any]:
    """Import a regressor of scikit-learn by ``sklearn.module:Class``.

    No other package is imported, because the text may come from a model file.

    Raises
    ------
    MissingDependencyError
        If scikit-learn is not installed.
    ValueError
        If the text has another form, or names no regressor of scikit-learn.
    """
    form = "it must name a regressor as `sklearn.module:Class`"
    if NOT_IMPORTED & set(target.partition(":")[0].split(".")):
        raise ValueError(form)
    try:
        from sklearn.base import BaseEstimator, RegressorMixin
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"{target} needs scikit-learn: pip install scikit-learn"
        ) from error
    found = public_class(target, "sklearn", form)
    if not issubclass(found, RegressorMixin):
        raise ValueError(f"{form}; {found.__name__!r} is no regressor")
    if not issubclass(found, BaseEstimator) or not found.__module__.startswith("sklearn."):
        raise ValueError(f"{form}; {found.__name__!r} is no estimator of scikit-learn")
    return found


def _checked_estimator(target: str) -> str:
    regressor_class(target)
    return target


def _checked_parameters(parameters: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    """Check names and kinds of values. The estimator itself checks ranges when it is fitted."""
    if "estimator" not in info.data:
        return parameters  # the estimator has an error of its own
    known = inspect.signature(regressor_class(info.data["estimator"])).parameters
    for name, value in parameters.items():
        if name not in known:
            near = nearest_name(name, known).rstrip(".")
            raise ValueError(f"{info.data['estimator']} has no parameter {name!r}{near}")
        if name == "random_state":
            raise ValueError("`seed` sets `random_state`")
        if name == "n_jobs":
            raise ValueError("`n_jobs` cannot be set, because all methods get the same threads")
        if not _is_plain(value):
            raise ValueError(f"{name!r} must be a finite number, text, true, false or a list")
    needed = [n for n, p in known.items() if p.default is p.empty and n not in parameters]
    if needed:
        raise ValueError(f"{info.data['estimator']} also needs {', '.join(map(repr, needed))}")
    return parameters


def _checked_output(output: Output | None, info: ValidationInfo) -> Output | None:
    if output == "remainder" and info.data.get("input") == "force":
        raise ValueError(
            'with `input = "force"` it must be "displacement": a remainder is what linear '
            "elasticity leaves"
        )
    return output


def _is_plain(value: object) -> bool:
    if isinstance(value, list):
        return all(map(_is_plain, value))
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or isinstance(value, int | str)


@dataclass(eq=False)
class PCAEstimator(CoordinateRegression):
    """g(z) = s (r(z) - r(0)), with r a regressor of scikit-learn; see `CoordinateRegression`.

    The targets are divided by s, the root mean square of the largest output, so that tolerances
    of the regressor are relative. A regressor that takes one output only is fitted once per output.

    A fitted estimator can only be stored as a pickle, which may run code. So the model consists of
    the training samples in coordinates, and loading repeats the fit with the stored seed. Some
    stored answers must come out again; otherwise loading is refused. For the same reason,
    `mor_bench.load_surrogate` refuses this class: a file could ask for a fit without end.

    The work of the regressor is not counted, because it is unknown.

    The coordinates of the output are those of POD modes Φ of its training samples.

    `input`, `n_input_modes` and `n_output_modes` are those of `CoordinateRegression`.

    Parameters
    ----------
    estimator : str
        Import path of the regressor, such as "sklearn.neighbors:KNeighborsRegressor".
    estimator_parameters : dict
        Its parameters: numbers, texts, booleans or lists. `n_jobs` cannot be set.
    output : {"remainder", "displacement"}, optional
        Source of the modes Φ and of the targets: the displacement without its linear response, or
        the whole displacement. By default, the remainder with the linear response as input, and
        the displacement with the force as input.
    seed : int
        Its `random_state`, if it has one.

    Examples
    --------
    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> nearest = PCAEstimator("sklearn.neighbors:KNeighborsRegressor", {"n_neighbors": 4})
    >>> nearest.fit(data.scene, data.train).predict(data.test.forces[0]).shape
    (63, 3)
    """

    estimator: Annotated[str, AfterValidator(_checked_estimator)]
    estimator_parameters: Annotated[dict[str, Any], AfterValidator(_checked_parameters)] = field(
        default_factory=dict
    )
    input: Input = "linear-response"
    output: Annotated[Output | None, AfterValidator(_checked_output)] = None
    n_input_modes: Annotated[int, Field(ge=1)] | None = None
    n_output_modes: Annotated[int, Field(ge=1)] = 20
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        self._fit_regressors(samples.z, samples.values)
        answers = self._evaluate(samples.z[:N_ANSWERS])
        return {"inputs": samples.z, "values": samples.values, "answers": answers}

    def shapes(
        self, model: Arrays, n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int | None, ...]]:
        n = len(model["inputs"])
        return {
            "inputs": (n, n_inputs),
            "values": (n, n_outputs),
            "answers": (min(n, N_ANSWERS), n_outputs),
        }

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        if not hasattr(self, "_regressors"):
            self._fit_regressors(model["inputs"], model["values"])
        answers = self._evaluate(model["inputs"][:N_ANSWERS])
        difference = np.abs(answers - model["answers"]).max()
        if not difference <= TOLERANCE * np.abs(model["answers"]).max():
            raise InvalidInputError(
                f"`answers` do not come out again when {self.estimator} is fitted to the stored "
                "samples. The file is forged, or from another version of scikit-learn; fit again."
            )

    def coefficients(self, z: Array) -> Array:
        return self._evaluate(z)

    def _fit_regressors(self, z: Array, values: Array) -> None:
        scale = np.sqrt((values**2).mean(axis=0).max())
        self._scale = float(scale) if scale > 0 else 1.0
        targets = values / self._scale
        try:
            self._regressors = [r.fit(z, y) for r, y in self._with_targets(targets)]
            self._at_rest = self._raw(np.zeros((1, z.shape[1])))
        except MemoryError:
            raise
        except Exception as error:  # foreign code runs here
            raise InvalidInputError(
                f"{self.estimator} cannot be fitted: {type(error).__name__}: {text_of(error)}"
            ) from error

    def _with_targets(self, targets: Array) -> list[tuple[Any, Array]]:
        """Return unfitted regressors, each with its targets, (n, n_outputs) or (n,)."""
        from sklearn.utils import get_tags

        made = regressor_class(self.estimator)
        known = inspect.signature(made).parameters
        seed = {"random_state": self.seed} if "random_state" in known else {}
        whole = made(**self.estimator_parameters, **seed)
        joint = made.__name__ in JOINT or get_tags(whole).target_tags.multi_output
        if joint and targets.shape[1] > 1:
            return [(whole, targets)]
        return [(made(**self.estimator_parameters, **seed), y) for y in targets.T.copy()]

    def _raw(self, z: Array) -> Array:
        found = [r.predict(z).reshape(len(z), -1) for r in self._regressors]
        return found[0] if len(found) == 1 else np.hstack(found)

    def _evaluate(self, z: Array) -> Array:
        if len(z) == 0:  # scikit-learn refuses empty input
            return np.zeros((0, self._at_rest.shape[1]))
        raw = self._raw(np.clip(z, -LARGEST, LARGEST))
        return np.asarray(self._scale * (raw - self._at_rest), dtype=np.float64)
