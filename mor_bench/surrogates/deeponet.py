"""DeepONet: coefficients from a branch network, times functions of the position from a trunk network or from POD."""

from __future__ import annotations

from typing import Annotated, Literal, final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from mor_bench.errors import InvalidInputError
from mor_bench.reduction.basis import pod
from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.field_network import Arrays, FieldNetwork, FieldSurrogate, Input, n_products, perceptron


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

    def __init__(self, axes: Tensor, positions: Tensor, modes: Tensor | None, n_functions: int, width: int, depth: int) -> None:
        super().__init__()
        self.register_buffer("axes", axes, persistent=False)
        self.register_buffer("positions", positions, persistent=False)
        self.register_buffer("functions", None if modes is None else modes.T.contiguous(), persistent=False)
        self.branch = perceptron(axes.shape[1], *[width] * depth, n_functions)
        self.trunk = perceptron(3, *[width] * depth, 3 * n_functions) if modes is None else None
        self.n_functions = n_functions

    def basis(self) -> Tensor:
        """(n_functions, n_dofs) values of the functions at the nodes."""
        if self.functions is not None:
            return self.functions
        assert self.trunk is not None
        values: Tensor = self.trunk(self.positions)  # (n_nodes, 3 n_functions)
        return values.view(-1, self.n_functions).T * self.n_functions**-0.5

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
        seed: Annotated[int, Field(ge=0, lt=2**63)] = 0,
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

    def _constants(self, inputs: NDArray[np.float64], targets: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        constants = {"axes": principal_axes(inputs.reshape(len(inputs), -1), self.n_input_modes)}
        if self.trunk == "pod":
            flat = targets.reshape(len(targets), -1)
            modes = pod(flat).modes[:, : self.n_functions]
            constants["modes"] = modes * np.sqrt(((flat @ modes) ** 2).mean(axis=0))  # coefficients of unit size
        return constants

    def _network(self, constants: Arrays) -> DeepONetNetwork:
        n_dofs = self.scene_.mesh.n_dofs
        names = {"axes": self.n_input_modes, "modes": self.n_functions} if self.trunk == "pod" else {"axes": self.n_input_modes}
        for name, most in names.items():
            if constants[name].shape[:1] != (n_dofs,) or not 1 <= constants[name].shape[1] <= most:
                raise InvalidInputError(f"`{name}` must have shape ({n_dofs}, at most {most}); got {constants[name].shape}.")
        single = {name: torch.from_numpy(constants[name].astype(np.float32)) for name in names}
        n_functions = constants["modes"].shape[1] if "modes" in names else self.n_functions
        return DeepONetNetwork(single["axes"], scaled_positions(self.scene_.mesh), single.get("modes"), n_functions, self.width, self.depth)


def principal_axes(inputs: NDArray[np.float64], n_modes: int) -> NDArray[np.float64]:
    """(n_dofs, at most n_modes) principal directions of inputs (n, n_dofs), scaled.

    Coordinates along them have sizes half way between their own and equal ones, on a logarithmic scale, with unit mean square.
    """
    used = np.flatnonzero(inputs.any(axis=0))  # of forces only a few columns
    modes = pod(inputs[:, used]).modes[:, :n_modes]
    sizes = np.sqrt(((inputs[:, used] @ modes) ** 2).mean(axis=0))
    axes = np.zeros((inputs.shape[1], modes.shape[1]))
    axes[used] = modes / np.sqrt(sizes * np.sqrt((sizes**2).mean()))
    return axes


def scaled_positions(mesh: Mesh) -> Tensor:
    """(n_nodes, 3) positions from the middle of the bounding box, in halves of its longest edge."""
    low, high = mesh.bounds
    return torch.from_numpy((2.0 * (mesh.points - (low + high) / 2) / (high - low).max()).astype(np.float32))
