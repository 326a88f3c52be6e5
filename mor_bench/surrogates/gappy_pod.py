"""Gappy POD: the coordinates of POD modes by regularised least squares from displacements of a part of the surface."""

from __future__ import annotations

from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.reduction.basis import pod
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


class GappyPOD(Surrogate):
    """u = Φa, with the coordinates a that fit the observed displacements u_o best.

    Everson and Sirovich: Karhunen-Loève procedure for gappy data, J. Opt. Soc. Am. A 12 (1995), equations 8 to 10, with Tikhonov's
    regularisation: a minimises ‖Φ_o a - u_o‖² + λ² m² Σ (a_i / s_i)², with Φ_o the observed rows of the modes, s_i the root mean square
    of a_i over the training samples and m that of ‖u_o‖. It knows no equations and no forces, and answers at observed nodes with the
    fit, too, which need not be what was given.

    Parameters
    ----------
    n_modes : int
        Size of the basis; capped at the snapshots' rank with a warning.
    regularisation : float
        λ: about the error of the observation, and of what the modes leave of it, relative to its size. Without it many modes that
        are hardly seen at the observed nodes fit whatever the others leave.
    """

    takes_observations = True

    def __init__(
        self,
        n_modes: Annotated[int, Field(ge=1)] = 40,
        regularisation: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1e-4,
    ) -> None:
        self.n_modes = n_modes
        self.regularisation = regularisation

    def supports(self, scene: Scene) -> str | None:
        return (
            "it is given forces, and no displacements of a part of the surface to be completed"
            if scene.observed_nodes is None
            else None
        )

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            known = self._checked_snapshots(snapshots)
            modes = pod(known.free_displacements, self.n_modes).modes
            sizes = np.sqrt(((known.free_displacements @ modes) ** 2).mean(axis=0))
            seen = self._seen
            typical = float(np.sqrt((known.free_displacements[:, seen] ** 2).sum(axis=1).mean()))
            scaled = modes[seen] * sizes
            system = np.concatenate([scaled, self.regularisation * typical * np.eye(len(sizes))])
            fitting = sizes[:, None] * np.linalg.pinv(system)[:, : len(seen)]
            self._restore({"modes": modes, "fitting": fitting})
        return self

    @property
    def _seen(self) -> NDArray[np.int64]:
        """Places of the observed dofs among the free ones."""
        nodes = self.scene_.observed_nodes
        assert nodes is not None
        return np.searchsorted(self.scene_.free_dofs, dofs_of_nodes(nodes))

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces).reshape(-1, self.scene_.mesh.n_dofs)
        free = self.scene_.free_dofs
        count(multiply_adds=len(batch) * (self.fitting_.size + self.modes_.size))
        out = np.zeros_like(batch)
        out[:, free] = (batch[:, free[self._places]] @ self.fitting_.T) @ self.modes_.T
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"modes": self.modes_, "fitting": self.fitting_}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        state = {name: np.ascontiguousarray(array) for name, array in state.items()}
        if reason := self.supports(self.scene_):
            raise InvalidInputError(reason)
        self._places = self._seen
        n_modes = state["modes"].shape[1]
        for name, shape in {
            "modes": (len(self.scene_.free_dofs), n_modes),
            "fitting": (n_modes, len(self._places)),
        }.items():
            if state[name].shape != shape or not np.isfinite(state[name]).all():
                raise InvalidInputError(
                    f"`{name}` must be a finite array of shape {shape}; got shape {state[name].shape}."
                )
        self.modes_, self.fitting_ = state["modes"], state["fitting"]
