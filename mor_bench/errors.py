"""Every error that this package raises on purpose, under one base class, and its warning."""

from __future__ import annotations


class MorBenchError(Exception):
    """Base class of the errors of mor-bench."""


class SpecError(MorBenchError, ValueError):
    """A dataset, a method or a parameter is not valid; the message names the file, the key and what is allowed."""


class InvalidInputError(MorBenchError, ValueError):
    """An array has a wrong shape, a wrong dtype, or holds NaN or infinity."""


class OutsideMeshError(MorBenchError, ValueError):
    """A point lies in no cell of a mesh; the message names the point and the mesh's bounds."""


class NotFittedError(MorBenchError, RuntimeError):
    """`predict` or `save` was called before `fit`."""


class UnsupportedSceneError(MorBenchError):
    """A method cannot handle a scene; the message says why."""


class SolverError(MorBenchError, RuntimeError):
    """The nonlinear solve did not end in a valid equilibrium."""


class NoEquilibriumError(SolverError):
    """No convergence, even after the load increments were cut back."""


class InvertedElementError(SolverError):
    """The solve ended at, or could not avoid, a state with det F <= 0 at some Gauss point."""


class UnconstrainedBodyError(MorBenchError, ValueError):
    """The supports leave rigid motions free."""


class StoreError(MorBenchError):
    """A stored file is damaged, foreign or of a newer schema."""


class MissingDependencyError(MorBenchError, ImportError):
    """A method needs an extra that is not installed; the message names it."""


class IllConditionedWarning(UserWarning):
    """The stiffness at rest has so large a condition number that answers lose most of their digits."""


class LockingWarning(UserWarning):
    """A discretisation is too stiff for a nearly incompressible material: its displacements are too small."""
