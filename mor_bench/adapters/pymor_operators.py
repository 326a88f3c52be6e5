"""Operators of pyMOR on the free dofs of a scene; importing this module needs the extra `pymor`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymor.core.exceptions import InversionError
from pymor.models.basic import StationaryModel
from pymor.operators.constructions import VectorOperator
from pymor.operators.interface import Operator
from pymor.operators.numpy import NumpyMatrixOperator
from pymor.parameters.functionals import ProjectionParameterFunctional
from pymor.vectorarrays.numpy import NumpyVectorSpace

from mor_bench.errors import SolverError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions

PARAMETER = "load"
"""Name of the parameter of every model."""


class InternalForce(Operator):  # type: ignore[misc]
    """The internal force f(u), N, of displacements u of the free dofs, m.

    Its inverse is the solver of `FullOrderModel`, not pyMOR's. Give the operator another `solver`,
    such as pyMOR's ``NewtonSolver``, to replace it.

    Parameters
    ----------
    fom : FullOrderModel
    options : NewtonOptions
    solver : pymor.solvers.interface.Solver, optional
    name : str, optional
    """

    linear = False

    def __init__(
        self,
        fom: FullOrderModel,
        options: NewtonOptions,
        solver: Any = None,
        name: str | None = None,
    ) -> None:
        self.fom, self.options, self.solver, self.name = fom, options, solver, name
        self.source = self.range = NumpyVectorSpace(fom.n_unknowns)

    def apply(self, U: Any, mu: Any = None) -> Any:
        """Return f(u) of each vector."""
        forces = [self.fom.force(np.ascontiguousarray(u)).force for u in U.to_numpy().T]
        return self.range.from_numpy(np.reshape(forces, (len(U), self.range.dim)).T)

    def jacobian(self, U: Any, mu: Any = None) -> Any:
        """Return the tangent stiffness at one vector, as a sparse matrix."""
        if len(U) != 1:
            raise ValueError(f"the Jacobian is taken at one vector; got {len(U)}.")
        _, values = self.fom.linearise(np.ascontiguousarray(U.to_numpy()[:, 0]))
        return NumpyMatrixOperator(self.fom.assembler.pattern.symmetric(values))

    def _apply_inverse(self, V: Any, mu: Any, initial_guess: Any) -> tuple[Any, dict[str, Any]]:
        starts = None
        if initial_guess is not None:
            starts = [np.ascontiguousarray(u) for u in initial_guess.to_numpy().T]
        found = self.fom.solve_many(np.ascontiguousarray(V.to_numpy().T), self.options, starts)
        solutions = np.empty((self.source.dim, len(found)))
        for column, solution in zip(solutions.T, found, strict=True):
            if isinstance(solution, SolverError):
                raise InversionError(str(solution)) from solution
            column[:] = solution.displacement
        return self.source.from_numpy(solutions), {}


class NodalForces(Operator):  # type: ignore[misc]
    """The right-hand side whose parameter is the whole vector of forces on the free dofs, N.

    Parameters
    ----------
    n : int
        Number of free dofs.
    name : str, optional
    """

    linear = True

    def __init__(self, n: int, name: str | None = None) -> None:
        self.n, self.name = n, name
        self.source, self.range = NumpyVectorSpace(1), NumpyVectorSpace(n)
        self.parameters_own = {PARAMETER: n}

    def apply(self, U: Any, mu: Any = None) -> Any:
        """Return the force vector times each scalar."""
        return self.range.from_numpy(np.outer(mu[PARAMETER], U.to_numpy()[0]))

    def apply_adjoint(self, V: Any, mu: Any = None) -> Any:
        """Return the work of the force on each vector, J."""
        return self.source.from_numpy(mu[PARAMETER][None] @ V.to_numpy())


def stationary_model(
    fom: FullOrderModel, loads: NDArray[np.float64] | None, options: NewtonOptions
) -> Any:
    """Return the ``StationaryModel`` f(u) = F(μ) with the stiffness at rest as inner product.

    Parameters
    ----------
    fom : FullOrderModel
    loads : (k, n_free) float64, optional
        F(μ) = Σᵢ μᵢ loadsᵢ, N. Without it, μ is F itself.
    options : NewtonOptions
    """
    operator = InternalForce(fom, options, name="internal force")
    rhs: Any = NodalForces(fom.n_unknowns, name="forces")
    if loads is not None:
        terms = [VectorOperator(operator.range.from_numpy(load[:, None])) for load in loads]
        n = len(terms)
        factors = [ProjectionParameterFunctional(PARAMETER, n, i) for i in range(n)]
        rhs = sum(factor * term for factor, term in zip(factors, terms, strict=True))
    stiffness = NumpyMatrixOperator(fom.assembler.pattern.symmetric(fom.rest_tangent))
    return StationaryModel(
        operator, rhs, products={"stiffness": stiffness}, name=fom.scene.name.replace("-", "_")
    )
