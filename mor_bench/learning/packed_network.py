"""Networks with oneDNN's convolutions and weights that are packed once, not in every call."""

from __future__ import annotations

from copy import deepcopy
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from mor_bench.errors import UnavailableBackendError

ALLOWED_DIFFERENCE = {torch.float32: 1e-4, torch.bfloat16: 2e-2}
"""Largest relative difference from torch's convolution that is explained by rounding."""

FUSED: dict[type[nn.Module], str] = {nn.ReLU: "relu", nn.SiLU: "swish"}
"""Activations that oneDNN applies within a convolution, and its names for them."""


def packed(network: nn.Module, dtype: torch.dtype = torch.float32) -> nn.Module:
    """Return a copy of a network with packed convolutions, from float32 to float32.

    Raises
    ------
    UnavailableBackendError
        If this torch, this processor or this network does not support it.
    """
    if dtype == torch.bfloat16 and any(weight.is_complex() for weight in network.parameters()):
        raise UnavailableBackendError("bfloat16 does not support complex numbers.")
    reason = reason_against_packing(dtype)
    if reason is not None:
        raise UnavailableBackendError(reason)
    copied = deepcopy(network).eval().requires_grad_(False).to(dtype)
    if _pack_layers(copied) == 0:
        raise UnavailableBackendError("the network has no convolutions that could be packed.")
    return copied if dtype == torch.float32 else _Rounded(copied)


@cache
def reason_against_packing(dtype: torch.dtype) -> str | None:
    """Return why packing is not available in this precision, or None if it is."""
    if not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        return "this torch is built without oneDNN."
    if dtype == torch.bfloat16 and not processor_has_bfloat16():
        return "this processor has no bfloat16 instructions."
    generator = torch.Generator().manual_seed(0)
    # `skip_init`: the default initialisation would draw from torch's global random state.
    layer = nn.utils.skip_init(nn.Conv3d, 2, 3, 3, padding=1)  # type: ignore[no-untyped-call]
    layer.requires_grad_(False)
    x = torch.randn(1, 2, 4, 3, 3, generator=generator).to(dtype)
    for parameter in layer.parameters():
        parameter.copy_(torch.randn(parameter.shape, generator=generator))
    expected = layer(x.float()).relu()
    try:
        found = _PackedConvolution(layer.to(dtype), "relu")(x)
    except (AttributeError, RuntimeError, TypeError) as error:  # torch may change these internals
        return (
            f"torch {torch.__version__} does not offer oneDNN's convolutions as expected: "
            f"{type(error).__name__}."
        )
    difference = float((found.float() - expected).abs().max())
    if not difference <= ALLOWED_DIFFERENCE[dtype] * float(expected.max()):
        return f"oneDNN's convolution in {dtype} differs from torch's."
    return None


def processor_has_bfloat16() -> bool:
    """Return whether the processor multiplies bfloat16; emulation is slower than float32."""
    # torch 2.10 and later
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


class _PackedConvolution(nn.Module):
    """oneDNN's convolution with packed weights, and the activation after it."""

    def __init__(self, layer: nn.Conv2d | nn.Conv3d, activation: str | None) -> None:
        super().__init__()
        padding, stride, dilation = list(layer.padding), list(layer.stride), list(layer.dilation)
        self.geometry = [padding, stride, dilation, layer.groups]
        self.weight = torch.ops.mkldnn._reorder_convolution_weight(
            layer.weight.detach(), *self.geometry, None
        )
        self.bias = None if layer.bias is None else layer.bias.detach()
        self.activation = activation or "none"

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = torch.ops.mkldnn._convolution_pointwise(
            x, self.weight, self.bias, *self.geometry, self.activation, [], ""
        )
        return y


class _Upsampling(nn.Module):
    """A transposed convolution without overlap, as one matrix product and a permutation."""

    def __init__(self, layer: nn.ConvTranspose2d | nn.ConvTranspose3d) -> None:
        super().__init__()
        c_in, self.c_out, *self.kernel = layer.weight.shape
        self.weight = layer.weight.detach().movedim((0, 1), (-1, -2)).reshape(-1, c_in).contiguous()
        bias = layer.bias
        n_repeats = len(self.weight) // self.c_out
        self.bias = None if bias is None else bias.detach().repeat(n_repeats)

    def forward(self, x: Tensor) -> Tensor:
        n, c_in, *shape = x.shape
        d = len(shape)
        y = nn.functional.linear(x.movedim(1, -1).reshape(-1, c_in), self.weight, self.bias)
        y = y.view(n, *shape, *self.kernel, self.c_out)
        interleaved = [axis for i in range(1, d + 1) for axis in (i, i + d)]
        larger = [a * b for a, b in zip(shape, self.kernel, strict=True)]
        y = y.permute(0, *interleaved, 2 * d + 1).reshape(n, *larger, self.c_out)
        return y.movedim(-1, 1)


class _Rounded(nn.Module):
    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.network(x.bfloat16())
        return y.float()


def _pack_layers(module: nn.Module) -> int:
    """Replace the convolutions and the activations after them; return their number."""
    n_packed = 0
    children = list(module.named_children())
    following = [child for _, child in children[1:]] if isinstance(module, nn.Sequential) else []
    for i, (name, child) in enumerate(children):
        if (
            isinstance(child, nn.Conv2d | nn.Conv3d)
            and child.padding_mode == "zeros"
            and not isinstance(child.padding, str)
        ):
            activation = FUSED.get(type(following[i])) if i < len(following) else None
            setattr(module, name, _PackedConvolution(child, activation))
            if activation is not None:
                setattr(module, children[i + 1][0], nn.Identity())
            n_packed += 1
        elif isinstance(child, nn.ConvTranspose2d | nn.ConvTranspose3d) and _is_upsampling(child):
            setattr(module, name, _Upsampling(child))
        else:
            n_packed += _pack_layers(child)
    return n_packed


def _is_upsampling(layer: nn.ConvTranspose2d | nn.ConvTranspose3d) -> bool:
    """Return whether every output point depends on one input point."""
    plain = (
        layer.groups == 1
        and not any(layer.padding)
        and not any(layer.output_padding)
        and set(layer.dilation) == {1}
    )
    return plain and layer.kernel_size == layer.stride
