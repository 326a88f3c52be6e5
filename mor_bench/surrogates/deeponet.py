"""DeepONet: coefficients from a branch network, times functions of the position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import change_of_basis, input_axes
from mor_bench.reduction.subspace import wanted_dofs
from mor_bench.surrogates.field_network import (
    FieldNetwork,
    OperatorSurrogate,
    SampleLoss,
    add_constants,
    n_products,
    perceptron,
    scaled_positions,
)
from mor_bench.surrogates.field_surrogate import Array, Arrays, Input

EVENNESS = 0.0
"""Coordinates of the input keep their sizes, see `input_axes`. More even sizes overfit."""


class DeepONetNetwork(FieldNetwork):
    """G(x)(p) = Σₖ bₖ(Aᵀx) tₖ(p), with vector-valued functions tₖ of the position p.

    Parameters
    ----------
    axes : (n_dofs, n_inputs) float32
        A, principal directions of the input.
    positions : (n_nodes, 3) float32
        Node positions relative to the size of the body.
    modes : (n_dofs, n_functions) float32 or None
        Values of tₖ at the nodes; None for a trunk network.
    wanted : (n_wanted,) int64 or None
        Dofs that are answered after `precompute`, the others with NaN; None for all.
    n_functions : int
        Number of functions.
    hidden : list of int
        Units of the hidden layers of branch and trunk.
    """

    axes: Tensor
    positions: Tensor
    functions: Tensor | None
    wanted: Tensor | None

    def __init__(
        self,
        axes: Tensor,
        positions: Tensor,
        modes: Tensor | None,
        wanted: Tensor | None,
        n_functions: int,
        hidden: list[int],
    ) -> None:
        super().__init__()
        functions = None if modes is None else modes.T.contiguous()
        constants = {"axes": axes, "positions": positions, "functions": functions}
        add_constants(self, **constants, wanted=wanted)
        self.branch = perceptron(axes.shape[1], *hidden, n_functions)
        self.trunk = perceptron(3, *hidden, 3 * n_functions) if modes is None else None
        self.n_functions = n_functions

    def basis(self) -> Tensor:
        """Return the functions at the nodes, (n_functions, n_dofs), or at the wanted dofs."""
        if self.functions is not None:
            functions: Tensor = self.functions
            return functions
        assert self.trunk is not None
        values: Tensor = self.trunk(self.positions)  # (n_nodes, 3 n_functions)
        scaled: Tensor = values.view(-1, self.n_functions).T * self.n_functions**-0.5
        return scaled

    def encode(self, fields: Tensor) -> Tensor:
        return fields.flatten(1) @ self.axes

    def forward(self, features: Tensor) -> Tensor:
        basis, n_dofs = self.basis(), len(self.axes)
        answer: Tensor = self.branch(features) @ basis
        if basis.shape[1] < n_dofs:
            wanted, answer = answer, answer.new_full((len(features), n_dofs), torch.nan)
            answer[:, self.wanted] = wanted
        return answer.view(len(features), -1, 3)

    def precompute(self) -> None:
        functions = self.basis()
        self.functions = (
            functions if self.wanted is None else functions[:, self.wanted]
        ).contiguous()

    @property
    def multiply_adds(self) -> int:
        return self.axes.numel() + n_products(self.branch) + self.basis().numel()


@final
@dataclass(eq=False)
class DeepONet(OperatorSurrogate):
    """A branch network for the load, and functions of the position from a trunk network or POD.

    Lu, Jin, Pang, Zhang, Karniadakis, "Learning nonlinear operators via DeepONet"; for the POD
    trunk Lu et al., "A comprehensive and fair comparison of two neural operators". Here the input
    of the branch is principal coordinates instead of values at sensors. The trunk's functions are
    vector-valued, so the three components share the branch. The POD trunk has no mean. After
    training, the trunk is a matrix. The other parameters are those of `FieldSurrogate`.

    Parameters
    ----------
    trunk : {"network", "pod"}
        Source of the functions tₖ. POD modes are computed from the displacement, or from its
        nonlinear remainder.
    n_input_modes : int
        Principal coordinates of the input; capped at its rank. Keep many for forces, because the
        coordinates of forces have similar sizes.
    n_functions : int
        Number of functions; with POD, capped at the rank.
    width, depth : int
        Units and number of the hidden layers in branch and trunk.
    loss : {"relative", "absolute"}
        Mean relative L2 error of the samples, or mean squared error.
    """

    input: Input = "force"
    trunk: Literal["network", "pod"] = "network"
    n_input_modes: Annotated[int, Field(ge=1)] = 200
    n_functions: Annotated[int, Field(ge=1)] = 64
    width: Annotated[int, Field(ge=1)] = 128
    depth: Annotated[int, Field(ge=1)] = 3
    loss: SampleLoss = "relative"
    iterations: Annotated[int, Field(ge=1)] = 20_000
    batch_size: Annotated[int, Field(ge=1)] = 64
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 2e-3
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    architecture: ClassVar = ("input", "trunk", "n_input_modes", "n_functions", "width", "depth")

    def constants(self, inputs: Array, targets: Array) -> dict[str, Array]:
        flat_inputs, flat = inputs.reshape(len(inputs), -1), targets.reshape(len(targets), -1)
        constants = {"axes": input_axes(flat_inputs, self.n_input_modes, EVENNESS)}
        if self.trunk == "pod":
            modes = pod(flat).modes[:, : self.n_functions]
            sizes = np.sqrt(((flat @ modes) ** 2).mean(axis=0))
            constants["modes"] = modes * sizes  # so that coefficients are of unit size
        return constants

    def build_network(self, constants: Arrays) -> DeepONetNetwork:
        shape = (self.scene_.mesh.n_dofs, None)
        axes = _single(take_array(constants, "axes", shape))
        modes, n_functions = None, self.n_functions
        if self.trunk == "pod":
            modes = _single(take_array(constants, "modes", shape))
            n_functions = modes.shape[1]
        positions, dofs = scaled_positions(self.scene_.mesh), wanted_dofs(self.scene_)
        wanted = None if dofs is None else torch.from_numpy(dofs)
        hidden = [self.width] * self.depth
        return DeepONetNetwork(axes, positions, modes, wanted, n_functions, hidden)

    def turned(self, weights: dict[str, Tensor], source: Arrays, target: Arrays) -> Any:
        """Convert the branch's first layer to the new axes, and its last one to the new modes."""
        inward = change_of_basis(
            source["constant.axes"] / source["scales"][0],
            target["constant.axes"] / target["scales"][0],
        )
        outward = np.eye(self.n_functions)
        if self.trunk == "pod":
            outward = change_of_basis(source["constant.modes"], target["constant.modes"])
        outward *= source["scales"][1] / target["scales"][1]
        first, last = "branch.0.weight", f"branch.{2 * self.depth}"
        turned = {first: weights[first].double() @ torch.from_numpy(inward.T)}
        turned |= {
            name: torch.from_numpy(outward) @ weights[name].double()
            for name in (f"{last}.weight", f"{last}.bias")
        }
        return weights | {name: value.float() for name, value in turned.items()}


def _single(array: Array) -> Tensor:
    return torch.from_numpy(array.astype(np.float32))
