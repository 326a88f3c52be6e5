"""DeepONet: coefficients from a branch network, times functions of the position from a trunk network or from POD."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from mor_bench.errors import InvalidInputError
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import change_of_basis, input_axes
from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.field_network import (
    Arrays,
    FieldNetwork,
    FieldSurrogate,
    Input,
    n_products,
    perceptron,
)

EVENNESS = 0.0
"""Coordinates of the input keep their sizes, see `input_axes`.

Half way to equal sizes, 200 coordinates of the linear response were learned by heart: on the coarse beam, split by region (1,280
samples, POD trunk, 1,000 iterations), the error was 5.8e-4 m, more than that of the linear response alone, against 8.2e-5 m. With 20
coordinates either scaling does.
"""


class DeepONetNetwork(FieldNetwork):
    """G(x)(p) = Σₖ bₖ(Aᵀx) tₖ(p), with vector-valued functions tₖ of the position p.

    Parameters
    ----------
    axes : (n_dofs, n_inputs) float32
        A, principal directions of the input.
    positions : (n_nodes, 3) float32
        Of the nodes, scaled to the unit of the body's size.
    modes : (n_dofs, n_functions) float32 or None
        tₖ at the nodes; None for a trunk network.
    n_functions, width, depth : int
        Functions, and units and number of the hidden layers of branch and trunk.
    """

    axes: Tensor
    positions: Tensor
    functions: Tensor | None

    def __init__(
        self,
        axes: Tensor,
        positions: Tensor,
        modes: Tensor | None,
        n_functions: int,
        width: int,
        depth: int,
    ) -> None:
        super().__init__()
        self.register_buffer("axes", axes, persistent=False)
        self.register_buffer("positions", positions, persistent=False)
        self.register_buffer(
            "functions", None if modes is None else modes.T.contiguous(), persistent=False
        )
        self.branch = perceptron(axes.shape[1], *[width] * depth, n_functions)
        self.trunk = perceptron(3, *[width] * depth, 3 * n_functions) if modes is None else None
        self.n_functions = n_functions

    def basis(self) -> Tensor:
        """(n_functions, n_dofs) values of the functions at the nodes."""
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
        answer: Tensor = self.branch(features) @ self.basis()
        return answer.view(len(features), -1, 3)

    def prepare(self) -> None:
        self.functions = self.basis().contiguous()

    @property
    def multiply_adds(self) -> int:
        return self.axes.numel() + n_products(self.branch) + self.basis().numel()


@final
class DeepONet(FieldSurrogate):
    """A branch network for the load, and functions of the position from a trunk network or from POD.

    Lu, Jin, Pang, Zhang, Karniadakis, "Learning nonlinear operators via DeepONet", and for the POD trunk Lu et al., "A
    comprehensive and fair comparison of two neural operators". Here the branch is given principal coordinates of the input
    in the place of its values at sensors, and the trunk's functions are vector-valued, so that the three components share
    the branch. The POD trunk is without the mean, which G(0) would take off. Once trained, the trunk is a matrix: what is
    left for a query is that of a regression between principal coordinates by a network.

    Parameters
    ----------
    input : {"force", "linear-response"}
        What the network is given; see `FieldSurrogate`.
    trunk : {"network", "pod"}
        Where the functions tₖ come from. POD modes are those of the displacement, or of its nonlinear rest.
    n_input_modes : int
        Principal coordinates of the input, at most its rank. Those of forces are all of about one size: none can be left out.
    n_functions : int
        At most the rank with POD.
    width, depth : int
        Units and number of hidden layers in branch and trunk.
    iterations : int
        Adam steps; a number, not a time, so that the result does not depend on the load of the machine.
    batch_size, learning_rate, seed
        Samples per step, peak of the one-cycle schedule, and seed of the initial weights and of the order of the samples.
    """

    architecture: ClassVar[tuple[str, ...]] = (
        "input",
        "trunk",
        "n_input_modes",
        "n_functions",
        "width",
        "depth",
    )

    def __init__(
        self,
        input: Input = "force",
        trunk: Literal["network", "pod"] = "network",
        n_input_modes: Annotated[int, Field(ge=1)] = 200,
        n_functions: Annotated[int, Field(ge=1)] = 64,
        width: Annotated[int, Field(ge=1)] = 128,
        depth: Annotated[int, Field(ge=1)] = 3,
        iterations: Annotated[int, Field(ge=1)] = 20_000,
        batch_size: Annotated[int, Field(ge=1)] = 64,
        learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 2e-3,
        seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
    ) -> None:
        self.input = input
        self.trunk = trunk
        self.n_input_modes = n_input_modes
        self.n_functions = n_functions
        self.width = width
        self.depth = depth
        self.iterations = iterations
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.seed = seed

    def _constants(
        self, inputs: NDArray[np.float64], targets: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float64]]:
        constants = {
            "axes": input_axes(inputs.reshape(len(inputs), -1), self.n_input_modes, EVENNESS)
        }
        if self.trunk == "pod":
            flat = targets.reshape(len(targets), -1)
            modes = pod(flat).modes[:, : self.n_functions]
            constants["modes"] = modes * np.sqrt(
                ((flat @ modes) ** 2).mean(axis=0)
            )  # coefficients of unit size
        return constants

    def _network(self, constants: Arrays) -> DeepONetNetwork:
        n_dofs = self.scene_.mesh.n_dofs
        names = (
            {"axes": self.n_input_modes, "modes": self.n_functions}
            if self.trunk == "pod"
            else {"axes": self.n_input_modes}
        )
        for name, most in names.items():
            if constants[name].shape[:1] != (n_dofs,) or not 1 <= constants[name].shape[1] <= most:
                raise InvalidInputError(
                    f"`{name}` must have shape ({n_dofs}, at most {most}); got {constants[name].shape}."
                )
        single = {name: torch.from_numpy(constants[name].astype(np.float32)) for name in names}
        n_functions = constants["modes"].shape[1] if "modes" in names else self.n_functions
        return DeepONetNetwork(
            single["axes"],
            scaled_positions(self.scene_.mesh),
            single.get("modes"),
            n_functions,
            self.width,
            self.depth,
        )

    def _turned(
        self, weights: dict[str, Tensor], constants: Arrays, scales: NDArray[np.float64]
    ) -> dict[str, Tensor]:
        """The branch from coordinates of a load, and to coefficients of a displacement, in their own units."""
        inward = change_of_basis(
            constants["axes"] / scales[0], self.constants_["axes"] / self.input_scale_
        )
        outward = np.eye(self.n_functions)
        if self.trunk == "pod":
            outward = change_of_basis(constants["modes"], self.constants_["modes"])
        outward *= scales[1] / self.output_scale_
        first, last = "branch.0.weight", f"branch.{2 * self.depth}"
        turned = {first: weights[first].double() @ torch.from_numpy(inward.T)}
        turned |= {
            name: torch.from_numpy(outward) @ weights[name].double()
            for name in (f"{last}.weight", f"{last}.bias")
        }
        return weights | {name: value.float() for name, value in turned.items()}


def scaled_positions(mesh: Mesh) -> Tensor:
    """(n_nodes, 3) positions from the middle of the bounding box, in halves of its longest edge."""
    low, high = mesh.bounds
    return torch.from_numpy(
        (2.0 * (mesh.points - (low + high) / 2) / (high - low).max()).astype(np.float32)
    )
