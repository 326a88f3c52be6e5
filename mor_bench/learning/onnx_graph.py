"""A network as an ONNX graph, from torch's symbolic trace of it.

torch's own exporter needs another package; the few operations of a U-Net need none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import fx, nn

from mor_bench.errors import UnavailableBackendError

if TYPE_CHECKING:
    import onnx

OPSET = 17
IR_VERSION = 8
"""Of 2022, as the operations: older runtimes read them, too."""

MAX_BYTES = 2**31 - 1
"""Of a file whose weights lie within: Protocol Buffers' limit."""


class GraphBuilder:
    """Nodes and constants of a graph that grows.

    Raises
    ------
    UnavailableBackendError
        If onnx is not installed.
    """

    def __init__(self) -> None:
        try:
            import onnx
        except ImportError as error:
            raise UnavailableBackendError(
                f"ONNX needs pip install 'mor-bench[onnx]' ({error})."
            ) from None
        self._onnx = onnx
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []

    def constant(self, values: NDArray[Any]) -> str:
        """The name of an array, float32, int64 or bool."""
        name = f"constant{len(self._constants)}"
        self._constants.append(
            self._onnx.numpy_helper.from_array(np.ascontiguousarray(values), name)
        )
        return name

    def add(self, operation: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        """The name of an operation's output; made up unless it is given."""
        name = name or f"{operation.lower()}{len(self._nodes)}"
        self._nodes.append(
            self._onnx.helper.make_node(operation, list(inputs), [name], **attributes)
        )
        return name

    def network(self, network: nn.Module, x: str) -> str:
        """The name of a network's output for an input.

        Raises
        ------
        UnavailableBackendError
            If the network does something that has no translation here.
        """
        try:
            traced = fx.symbolic_trace(network)
        except Exception as error:  # whatever a network does with what is no tensor
            raise UnavailableBackendError(
                f"the network cannot be traced: {type(error).__name__}: {error}"
            ) from None
        names: dict[fx.Node, str] = {}
        for node in traced.graph.nodes:
            if node.op == "placeholder":
                names[node] = x
            elif node.op == "call_module":
                names[node] = self._layer(
                    traced.get_submodule(str(node.target)), names[node.args[0]]
                )
            elif node.op == "call_function" and node.target is torch.cat:
                parts, axis = (
                    node.args[0],
                    node.args[1] if len(node.args) > 1 else node.kwargs.get("dim", 0),
                )
                names[node] = self.add("Concat", *(names[part] for part in parts), axis=axis)
            elif node.op == "output":
                return names[node.args[0]]
            else:
                raise UnavailableBackendError(
                    f"{node.op} {node.target} has no translation to ONNX."
                )
        raise AssertionError("a traced network without output")

    def _layer(self, layer: nn.Module, x: str) -> str:
        if isinstance(layer, nn.ReLU):
            return self.add("Relu", x)
        if isinstance(layer, nn.SiLU):
            return self.add("Mul", x, self.add("Sigmoid", x))
        if isinstance(layer, nn.MaxPool3d):
            if layer.padding != 0 or layer.dilation != 1 or layer.ceil_mode:
                raise UnavailableBackendError(f"{layer} has no translation to ONNX.")
            return self.add(
                "MaxPool", x, kernel_shape=_triple(layer.kernel_size), strides=_triple(layer.stride)
            )
        if isinstance(layer, nn.Conv3d | nn.ConvTranspose3d):
            if (
                layer.padding_mode != "zeros"
                or isinstance(layer.padding, str)
                or any(layer.output_padding)
            ):
                raise UnavailableBackendError(f"{layer} has no translation to ONNX.")
            weights = [layer.weight] if layer.bias is None else [layer.weight, layer.bias]
            return self.add(
                "ConvTranspose" if isinstance(layer, nn.ConvTranspose3d) else "Conv",
                x,
                *(self.constant(weight.detach().numpy()) for weight in weights),
                kernel_shape=layer.kernel_size,
                strides=layer.stride,
                dilations=layer.dilation,
                pads=[*layer.padding, *layer.padding],
                group=layer.groups,
            )
        raise UnavailableBackendError(f"{type(layer).__name__} has no translation to ONNX.")

    def model(
        self,
        name: str,
        x: tuple[str, list[Any]],
        y: tuple[str, list[Any]],
        metadata: dict[str, str],
    ) -> onnx.ModelProto:
        """The whole, checked, with input and output given as name and shape (words for sizes that are left open).

        Raises
        ------
        UnavailableBackendError
            If it is larger than a file may be.
        """
        helper, single = self._onnx.helper, self._onnx.TensorProto.FLOAT
        ends = [[helper.make_tensor_value_info(end, single, shape)] for end, shape in (x, y)]
        graph = helper.make_graph(self._nodes, name, *ends, self._constants)
        model: onnx.ModelProto = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="mor-bench",
        )
        helper.set_model_props(model, metadata)
        if model.ByteSize() > MAX_BYTES:
            raise UnavailableBackendError(
                f"the graph has {model.ByteSize():,} bytes; an ONNX file may have {MAX_BYTES:,}."
            )
        self._onnx.checker.check_model(model, full_check=True)
        return model


def network_model(network: nn.Module) -> onnx.ModelProto:
    """A network alone, from `input` to `output`, (n, c, x, y, z) float32 each."""
    graph = GraphBuilder()
    output = graph.add("Identity", graph.network(network, "input"), name="output")
    shapes = [["n", f"c_{end}", "x", "y", "z"] for end in ("in", "out")]
    return graph.model("network", ("input", shapes[0]), (output, shapes[1]), {})


def _triple(value: int | tuple[int, ...]) -> list[int]:
    return [value] * 3 if isinstance(value, int) else list(value)
