"""Methods of third parties with one flaw each, for the tests of the hard cases."""

from __future__ import annotations

import os
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogates.pod import PODGalerkin


class Good(PODGalerkin):
    """Has no flaw."""


class Bad(PODGalerkin):
    """Moves without a force, never repeats a prediction, and accepts NaN."""

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:  # type: ignore[override]
        answer = super().predict(np.nan_to_num(np.asarray(forces)))
        return answer + 0.01 + 1e-5 * np.random.default_rng().normal(size=answer.shape)


class Crashing(PODGalerkin):
    """Divides by zero if there is no force, as in some poor snapshots."""

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:  # type: ignore[override]
        answer = super().predict(forces)
        if answer.size and not np.any(np.asarray(forces)):
            raise ZeroDivisionError("on purpose")
        return answer


class Rounding(PODGalerkin):
    """Loses a fifth of the displacement in single precision."""

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:  # type: ignore[override]
        return super().predict(forces) * (0.8 if np.asarray(forces).dtype == np.float32 else 1.0)


class Unchecked(PODGalerkin):
    """Learns from any samples, and has no load range."""

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        assert snapshots is not None
        known = np.nan_to_num(snapshots.free_displacements)
        modes = np.linalg.svd(known, full_matrices=False)[2][:5].T
        return self.restore(scene, {"modes": np.nan_to_num(modes)})


class Unfit(PODGalerkin):
    """Cannot be fitted."""

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        raise ZeroDivisionError("on purpose")


class Ending(PODGalerkin):
    """Ends Python if there is no force."""

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:  # type: ignore[override]
        if not np.asarray(forces).any():
            os._exit(7)
        return super().predict(forces)


class Alarmed(PODGalerkin):
    """Flags every load as out of range."""

    def out_of_range(self, forces: ArrayLike) -> NDArray[np.bool_]:  # type: ignore[override]
        return np.ones(np.shape(forces)[:-2], dtype=bool)


class Careless(PODGalerkin):
    """Flags no load."""

    def out_of_range(self, forces: ArrayLike) -> NDArray[np.bool_]:  # type: ignore[override]
        return np.zeros(np.shape(forces)[:-2], dtype=bool)


class Elsewhere(PODGalerkin):
    """Supports no scene."""

    def supports(self, scene: Scene) -> str | None:
        return "it is for other scenes"
