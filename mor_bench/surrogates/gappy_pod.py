"""Gappy POD: coordinates of POD modes by regularised least squares from observed displacements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import pod
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.surrogate import Surrogate


@dataclass(eq=False)
class GappyPOD(Surrogate):
    """u = Φa, with the coordinates a that fit the observed displacements u_o best.

    Everson and Sirovich: Karhunen-Loève procedure for gappy data, J. Opt. Soc. Am. A 12 (1995),
    equations 8 to 10, with Tikhonov's regularisation: a minimises
    ‖Φ_o a - u_o‖² + λ² m² Σ (a_i / s_i)². Φ_o are the observed rows of the modes. s_i and m are
    the root mean squares of a_i and ‖u_o‖ over the training samples. The method uses no
    equations and no forces. At observed nodes, it also returns the fit, which may differ from the
    observed values.

    Parameters
    ----------
    n_modes : int
        Size of the basis; capped at the snapshots' rank with a warning.
    regularisation : float
        λ >= 0: about the relative error of the observation and of the projection on the modes. Use
        a positive value: with 0, modes that are hardly visible at the observed nodes fit noise.
    """

    n_modes: Annotated[int, Field(ge=1)] = 40
    regularisation: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1e-4

    def supports(self, scene: Scene) -> str | None:
        if scene.contact:
            return (
                "it completes displacements of a part of the surface, and the scene gives the "
                "motion of an instrument"
            )
        return (
            "it completes displacements of a part of the surface, and the scene gives forces"
            if scene.observed_nodes is None
            else None
        )

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        displacements, seen = samples.free_displacements, _observed_places(scene)
        modes = pod(displacements, self.n_modes).modes
        sizes = np.sqrt(((displacements @ modes) ** 2).mean(axis=0))
        typical = float(np.sqrt((displacements[:, seen] ** 2).sum(axis=1).mean()))
        scaled = modes[seen] * sizes
        system = np.concatenate([scaled, self.regularisation * typical * np.eye(len(sizes))])
        fitting = sizes[:, None] * np.linalg.pinv(system)[:, : len(seen)]
        return {"modes": modes, "fitting": fitting}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        if reason := self.supports(scene):
            raise InvalidInputError(reason)
        self.places_ = _observed_places(scene)
        self.modes_ = take_array(model, "modes", (len(scene.free_dofs), None))
        shape = self.modes_.shape[1], len(self.places_)
        self.fitting_ = take_array(model, "fitting", shape)

    def answer_observed(self, observed: ObservedDisplacements) -> NDArray[np.float64]:
        batch = observed.values.reshape(-1, self.scene_.mesh.n_dofs)
        scene = self.scene_
        count(multiply_adds=len(batch) * (self.fitting_.size + self.modes_.size))
        seen = scene.at_free_dofs(batch)[:, self.places_]
        out = scene.at_all_dofs((seen @ self.fitting_.T) @ self.modes_.T)
        return out.reshape(observed.values.shape)


def _observed_places(scene: Scene) -> NDArray[np.int64]:
    nodes = scene.observed_nodes
    assert nodes is not None
    return np.flatnonzero(np.isin(scene.free_dofs, dofs_of_nodes(nodes)))
