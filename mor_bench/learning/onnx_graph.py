"""A network as an ONNX graph, from torch's symbolic trace of it.

torch's own exporter needs another package; the few operations of a U-Net do not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, fx, nn

from mor_bench.errors import UnavailableBackendError

if TYPE_CHECKING:
    import onnx

OPSET = 17
IR_VERSION = 8
"""Both of 2022, so that older runtimes can read the file."""

MAX_BYTES = 2**31 - 1
"""Largest file that holds its weights: Protocol Buffers' limit."""


class GraphBuilder:
    """A graph to which nodes and constants are added.

    Raises
    ------
    UnavailableBackendError
        If onnx is not installed.
    """

    def __init__(self) -> None:
        try:
            import onnx
        except ImportError as error:
            raise _not_installed(error) from None
        self._onnx = onnx
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []

    def constant(self, values: NDArray[Any]) -> str:
        """Add an array, float32, int64 or bool, and return its name."""
        name = f"constant{len(self._constants)}"
        array = self._onnx.numpy_helper.from_array(np.ascontiguousarray(values), name)
        self._constants.append(array)
        return name

    def add(self, operation: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        """Add an operation and return the name of its output, which is generated unless given."""
        name = name or f"{operation.lower()}{len(self._nodes)}"
        node = self._onnx.helper.make_node(operation, list(inputs), [name], **attributes)
        self._nodes.append(node)
        return name

    def network(self, network: nn.Module, x: str) -> str:
        """Add a network and return the name of its output for an input.

        Raises
        ------
        UnavailableBackendError
            If the network has an operation without translation.
        """
        try:
            traced = fx.symbolic_trace(network)
        except Exception as error:  # a network may do anything with what is no tensor
            raise UnavailableBackendError(
                f"the network cannot be traced: {type(error).__name__}: {error}"
            ) from None
        names: dict[fx.Node, str] = {}
        for node in traced.graph.nodes:
            if node.op == "placeholder":
                names[node] = x
            elif node.op == "call_module":
                layer = traced.get_submodule(str(node.target))
                names[node] = self._layer(layer, names[node.args[0]])
            elif node.op == "call_function" and node.target is torch.cat:
                axis = node.args[1] if len(node.args) > 1 else node.kwargs.get("dim", 0)
                parts = (names[part] for part in node.args[0])
                names[node] = self.add("Concat", *parts, axis=axis)
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
        if isinstance(layer, nn.MaxPool3d) and not (
            layer.padding or layer.dilation != 1 or layer.ceil_mode
        ):
            kernel, stride = _triple(layer.kernel_size), _triple(layer.stride)
            return self.add("MaxPool", x, kernel_shape=kernel, strides=stride)
        if isinstance(layer, nn.Conv3d | nn.ConvTranspose3d) and not (
            layer.padding_mode != "zeros"
            or isinstance(layer.padding, str)
            or any(layer.output_padding)
        ):
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
        raise UnavailableBackendError(f"{layer} has no translation to ONNX.")

    def model(
        self,
        name: str,
        x: tuple[str, list[Any]],
        y: tuple[str, list[Any]],
        metadata: dict[str, str],
    ) -> onnx.ModelProto:
        """Return the whole graph, checked.

        Parameters
        ----------
        name : str
        x, y : tuple of str and list
            Name and shape of the input and the output; a word stands for a size that is left open.
        metadata : dict

        Raises
        ------
        UnavailableBackendError
            If it is larger than `MAX_BYTES`.
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
    """Return a network alone, from `input` to `output`, (n, c, x, y, z) float32 each."""
    graph = GraphBuilder()
    output = graph.add("Identity", graph.network(network, "input"), name="output")
    shapes = [["n", f"c_{end}", "x", "y", "z"] for end in ("in", "out")]
    return graph.model("network", ("input", shapes[0]), (output, shapes[1]), {})


class OnnxSession:
    """A network in ONNX Runtime, with as many threads as torch has at the time of the call.

    Raises
    ------
    UnavailableBackendError
        If onnx or onnxruntime is not installed, or the network has an operation without
        translation.
    """

    def __init__(self, network: nn.Module) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise _not_installed(error) from None
        self._runtime = onnxruntime
        self._model = network_model(network).SerializeToString()
        self._sessions: dict[int, Any] = {}
        self._session()

    def _session(self) -> Any:
        threads = torch.get_num_threads()
        if threads not in self._sessions:
            options = self._runtime.SessionOptions()
            options.intra_op_num_threads = threads
            # Spinning idle threads would slow what comes next.
            options.add_session_config_entry("session.intra_op.allow_spinning", "0")
            self._sessions[threads] = self._runtime.InferenceSession(
                self._model, options, providers=["CPUExecutionProvider"]
            )
        return self._sessions[threads]

    def __call__(self, inputs: Tensor) -> Tensor:
        (output,) = self._session().run(None, {"input": np.ascontiguousarray(inputs.numpy())})
        return torch.from_numpy(output)


def _not_installed(error: ImportError) -> UnavailableBackendError:
    return UnavailableBackendError(f"ONNX needs pip install 'mor-bench[onnx]' ({error}).")


def _triple(value: int | tuple[int, ...]) -> list[int]:
    return [value] * 3 if isinstance(value, int) else list(value)
