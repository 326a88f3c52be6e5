"""Hooks of classes that are not written as `learn`, `prepare` and `answer` yet; to be deleted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import MorBenchError, UnsupportedSceneError
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.load_range import LoadRange
from mor_bench.specs import check_parameters


class LegacyHooks:
    def _state(self: Any) -> dict[str, NDArray[Any]]:
        """The arrays that make up a fitted model."""
        if "arrays_" in vars(self):
            return dict(self.arrays_)
        raise MorBenchError(f"{type(self).__name__} cannot be saved: it overrides `fit`.")

    def model_arrays(self) -> dict[str, NDArray[Any]]:
        return self._state()

    def _sized(self: Any, name: str) -> Any:
        return self.value(name)

    @contextmanager
    def _fitting(self: Any, scene: Scene) -> Iterator[None]:
        from mor_bench.surrogate import Surrogate

        check_parameters(type(self), self.parameters)
        reason = self.supports(scene) or Surrogate.supports(self, scene)
        if reason is not None:
            raise UnsupportedSceneError(
                f"{type(self).__name__} cannot handle {scene.name}: {reason}"
            )
        self.forget()
        self._become(scene, {})
        try:
            yield
        except BaseException:
            self.forget()
            raise

    def _checked_snapshots(self: Any, snapshots: Snapshots | None) -> Snapshots:
        from mor_bench.surrogate import checked_samples

        found = checked_samples(type(self).__name__, self.scene_, snapshots)
        if self.scene_.observed_nodes is None:
            self.range_ = LoadRange.of(found)
        return found

    def _checked_forces(self: Any, forces: ArrayLike) -> NDArray[np.float64]:
        return self._checked(forces).values  # type: ignore[no-any-return]
