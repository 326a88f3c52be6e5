"""POD and a reductor of pyMOR, as a method that competes with the others.

Use it with the method file

    title = "pyMOR: POD-Galerkin"
    surrogate = "mor_bench.adapters.pymor_pod:PymorPOD"
    source = "pyMOR's StationaryRBReductor"
    told = "equations"
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from pymor.algorithms.pod import pod
from pymor.core.exceptions import InversionError
from pymor.core.logger import log_levels
from pymor.reductors.basic import StationaryRBReductor
from pymor.solvers.newton import NewtonSolver

from mor_bench.adapters.pymor_model import (
    from_vector_array,
    pymor_model,
    to_vector_array,
    unsupported,
)
from mor_bench.errors import InvalidInputError, SolverError, text_of
from mor_bench.model_arrays import take_array
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs.public_class import public_class
from mor_bench.surrogate import Surrogate

USUAL = "pymor.reductors.basic:StationaryRBReductor"


def reductor_class(target: str) -> type[Any]:
    """Import a reductor of pyMOR by ``pymor.reductors.module:Class``.

    No other package is imported, because the text may come from a model file.

    Raises
    ------
    ValueError
        If the text has another form, or names no ``StationaryRBReductor`` or subclass of it.
    """
    form = "it must name a reductor as `pymor.reductors.module:Class`"
    found = public_class(target, "pymor.reductors", form)
    if not issubclass(found, StationaryRBReductor):
        raise ValueError(
            f"{form}; {found.__name__!r} is no StationaryRBReductor or subclass of it, so it does "
            "not project a static nonlinear model onto one basis"
        )
    return found


def _checked_reductor(target: str) -> str:
    reductor_class(target)
    return target


def quiet() -> AbstractContextManager[None]:
    """Silence pyMOR's log of each step and its warnings, of costly projections among them."""
    silent: AbstractContextManager[None] = log_levels(
        {"pymor": "ERROR", "mor_bench.adapters": "ERROR"}
    )
    return silent


@dataclass(eq=False)
class PymorPOD(Surrogate):
    """Projection by a reductor of pyMOR onto the modes of its ``pod``.

    Without hyper-reduction, each Newton step sums over all cells of the mesh. Answers are not
    checked for stability or inverted cells.

    Parameters
    ----------
    n_modes : int
        Size of the basis. pyMOR drops modes below 1e-7 of the largest singular value.
    tolerance : float
        Norm of the reduced residual relative to that of the reduced load, in (0, 1).
    reductor : str
        Import path ``pymor.reductors.module:Class`` of ``StationaryRBReductor`` or of a subclass
        whose other parameters have defaults.

    Examples
    --------
    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> method = PymorPOD(n_modes=5).fit(data.scene, data.train)
    >>> method.predict(data.test.forces[0]).shape
    (63, 3)
    """

    n_modes: Annotated[int, Field(ge=1)] = 20
    tolerance: Annotated[float, Field(gt=0, lt=1)] = 1e-8
    reductor: Annotated[str, AfterValidator(_checked_reductor)] = USUAL

    def supports(self, scene: Scene) -> str | None:
        return unsupported(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        with quiet():
            modes, _ = pod(to_vector_array(scene, samples.displacements), modes=self.n_modes)
        return {"modes": np.array(modes.to_numpy(), order="C")}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        modes = take_array(model, "modes", (len(scene.free_dofs), None))
        full = pymor_model(scene, tolerance=self.tolerance)
        solver = NewtonSolver(rtol=self.tolerance, error_measure="residual")
        solver.disable_logging()
        made, basis = reductor_class(self.reductor), full.solution_space.from_numpy(modes)
        with quiet():
            try:
                self.reductor_ = made(full, basis)
                reduced = self.reductor_.reduce()
            except MemoryError:
                raise
            except Exception as error:  # a reductor may need another model, by an assertion
                reason = f"{type(error).__name__}: {text_of(error)}".rstrip(": ")
                raise InvalidInputError(
                    f"{self.reductor} cannot reduce {scene.name}: {reason}"
                ) from error
        self.reduced_ = reduced.with_(operator=reduced.operator.with_(solver=solver))
        self.reduced_.disable_logging()

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        loads = self.scene_.at_free_dofs(forces.reshape(len(forces), -1))
        found = self.reduced_.solution_space.empty(reserve=len(loads))
        with quiet():
            for load in loads:
                try:
                    found.append(self.reduced_.solve({"load": load}))
                except InversionError as error:
                    raise SolverError(f"pyMOR's Newton iteration failed: {error}") from error
        return from_vector_array(self.scene_, self.reductor_.reconstruct(found))
