"""Wrong replacements for functions of the package, which the hard cases must notice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.hard_cases.setups import LAW
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import Discretisation
from mor_bench.mechanics.newton import Solution
from mor_bench.mechanics.stability import LimitPoint, limit_load
from mor_bench.reduction.basis import Basis, pod
from mor_bench.reduction.cubature import SparseWeights
from mor_bench.surrogates.fem import FullFEM

PREDICT = FullFEM.predict


def solved(*_: Any, **__: Any) -> Solution:
    return Solution(np.array([-0.5]), 0.5, 1, 0)


def too_high_a_limit(*arguments: Any) -> LimitPoint:
    limit = limit_load(*arguments)
    assert limit is not None
    return replace(limit, factor=0.2)


def pod_without_warning(
    snapshots: NDArray[np.float64], n_modes: int | None = None, **_: Any
) -> Basis:
    basis = pod(snapshots)
    return Basis(basis.modes[:, :n_modes], basis.singular_values)


def unevenly_weighted(mesh: Any, law: Any = LAW, selective: bool = False) -> Assembler:
    dofs = np.arange(mesh.n_dofs).reshape(-1, 3)
    weights = 1 + 0.1 * np.arange(mesh.n_cells)
    body = Discretisation(mesh.points, mesh.cells, law, selective)
    return Assembler(body, dofs, mesh.n_dofs, weights)


def all_weights_one(matrix: NDArray[np.float64], *_: Any, **__: Any) -> SparseWeights:
    return SparseWeights(np.ones(matrix.shape[1]), 0.0, 0.0, 0.0, 1)


def shifted(self: FullFEM, forces: ArrayLike) -> NDArray[np.float64]:
    answer = PREDICT(self, forces)
    answer[..., -1, 1] += 1e-9
    return answer
