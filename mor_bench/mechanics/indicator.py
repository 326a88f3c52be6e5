"""Estimate of a prediction's error from its equilibrium residual, without the reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.pressed import full_order_model
from mor_bench.scene.scene import Scene


@dataclass(frozen=True)
class Indication:
    """Estimated errors of n predictions; both are zero at an exact equilibrium.

    Attributes
    ----------
    relative_residual : (n,) float64
        ‖f - f_int(u)‖ / ‖f‖ over the free dofs. Short waves of small displacement dominate it.
    relative_correction : (n,) float64
        ‖R K₀⁻¹ Rᵀ (f - f_int(u))‖ / ‖u‖: the full-order solve's first correction from u. It
        estimates the relative l2 error to some 10 % at moderate Poisson's ratios and usual loads.
        It is at least three times too large near incompressibility (0.499) and at much larger
        loads. Displacements of supports count as errors.
    """

    relative_residual: NDArray[np.float64]
    relative_correction: NDArray[np.float64]


class ErrorIndicator:
    """Estimates the errors of any method's predictions of a scene.

    One estimate costs about one iteration of the full-order solve.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    UnsupportedSceneError
        If the scene's equations are unknown.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._model = full_order_model(scene, "auto")
        self._inverse = self._model.turned_rest

    def __call__(
        self, forces: NDArray[np.float64], displacements: NDArray[np.float64]
    ) -> Indication:
        """Estimate the errors of predictions.

        Parameters
        ----------
        forces : (n, n_nodes, 3) float64
            Nodal forces, N.
        displacements : (n, n_nodes, 3) float64
            Predicted displacements, m. A prediction that is not finite has an infinite error.

        Raises
        ------
        InvalidInputError
            If a shape is wrong.
        """
        shape = (len(forces), self._scene.mesh.n_nodes, 3)
        if forces.shape != shape or displacements.shape != shape:
            raise InvalidInputError(
                f"forces and displacements must have shape (n, {shape[1]}, 3); "
                f"got {forces.shape} and {displacements.shape}."
            )
        n_dofs, scene = self._scene.mesh.n_dofs, self._scene
        loads = scene.at_free_dofs(forces.reshape(-1, n_dofs))
        fields = displacements.reshape(-1, n_dofs)
        if scene.frames is not None:
            fields = scene.frames.to_local(fields)
        moved = np.linalg.norm(np.delete(fields, scene.free_dofs, axis=1), axis=1)
        triples = zip(loads, fields[:, scene.free_dofs], moved, strict=True)
        pairs = np.array([self._indicated(*triple) for triple in triples]).reshape(-1, 2)
        return Indication(pairs[:, 0], pairs[:, 1])

    def correction(self, load: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the full-order solve's first correction (n_free,) from u, m.

        It estimates what u lacks. It is not finite if u or the internal forces at u are not.

        Parameters
        ----------
        load : (n_free,) float64
            Forces, N.
        u : (n_free,) float64
            Predicted displacements of the free dofs, m.
        """
        residual = self._residual(load, u)
        return self._corrected(residual, u) if np.isfinite(residual).all() else residual

    def _indicated(
        self, load: NDArray[np.float64], u: NDArray[np.float64], moved: float
    ) -> tuple[float, float]:
        if not (np.isfinite(u).all() and np.isfinite(moved)):
            return np.inf, np.inf
        residual = self._residual(load, u)
        if not np.isfinite(residual).all():
            return np.inf, np.inf
        if not residual.any() and moved == 0:
            return 0.0, 0.0
        correction = self._corrected(residual, u)
        return _ratio(residual, load), _ratio(np.append(correction, moved), u)

    def _residual(self, load: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(load - self._model.under_load(load).force(u).force)

    def _corrected(
        self, residual: NDArray[np.float64], u: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        found = self._inverse.solve_many([residual], [self._inverse.turned(u)])
        return np.asarray(found[0])


def _ratio(part: NDArray[np.float64], whole: NDArray[np.float64]) -> float:
    size = float(np.linalg.norm(whole))
    return float(np.linalg.norm(part)) / size if size > 0 else np.inf
