"""Checkpoints: a stopped training resumes and ends with bit-identical weights."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from mor_bench.checked_files import check_file, parse_json
from mor_bench.digests import digest_of_arrays
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.learning.training_loop import LOSS_INTERVAL, TrainingLoop
from mor_bench.snapshots.store import write_atomically

FORMAT = "mor-bench checkpoint"
MOMENTS = "exp_avg", "exp_avg_sq"
"""Adam's names of its running means, which have the shapes of the weights."""


class _Numbers(BaseModel):
    """Iteration counts and loss curves of a checkpoint."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    iteration: Annotated[int, Field(ge=1)]
    iterations: Annotated[int, Field(ge=1)]
    n_summed: int
    curve: list[float]
    validated: list[float]


def fingerprint_of(parts: Mapping[str, object], arrays: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of everything that determines a training: JSON values and arrays."""
    plain = {name: tensor.detach().cpu().numpy() for name, tensor in arrays.items()}
    return digest_of_arrays(plain, parts)


def write_checkpoint(loop: TrainingLoop, path: Path, fingerprint: str) -> None:
    """Write the state of a training atomically, unless the training is diverging."""
    from safetensors.torch import save

    tensors = _prefixed("network.", loop.network.state_dict()) | _prefixed("best.", loop.best)
    for number, state in loop.optimiser.state_dict()["state"].items():
        tensors |= _prefixed(f"optimiser.{number}.", state)
    tensors |= {"order": loop.order, "rows": loop.rows, "held": loop.held}
    tensors |= {"generator": loop.generator.get_state(), "total": loop.total}
    if not all(value.isfinite().all() for value in tensors.values()):
        return
    numbers = {name: getattr(loop, name) for name in _Numbers.model_fields}
    header = {"format": FORMAT, "fingerprint": fingerprint, "numbers": json.dumps(numbers)}
    header["sha256"] = fingerprint_of(header, tensors)
    copies = {name: value.cpu().contiguous().clone() for name, value in tensors.items()}
    write_atomically(path, save(copies, header))


def resume(loop: TrainingLoop, path: Path, fingerprint: str) -> bool:
    """Resume from a checkpoint if it exists; return whether it does.

    Raises
    ------
    StoreError
        If the file is damaged.
    InvalidInputError
        If it belongs to another training.
    """
    from safetensors import SafetensorError, safe_open

    try:
        check_file(path)
    except FileNotFoundError:
        return False
    try:
        with safe_open(str(path), framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError) as error:
        raise StoreError(
            f"{path}: not a checkpoint, or damaged: {error}. Without it the training starts over."
        ) from None
    if header.get("format") != FORMAT or header.get("fingerprint") != fingerprint:
        raise InvalidInputError(
            f"{path}: the checkpoint belongs to another training (other parameters, "
            "seconds, samples or version); choose another file, or delete this one."
        )
    try:
        if header.pop("sha256") != fingerprint_of(header, tensors):
            raise ValueError("the checksum does not match")
        _restore(loop, _Numbers.model_validate(parse_json(header["numbers"], "numbers")), tensors)
    except (KeyError, ValueError, TypeError, RuntimeError, StoreError) as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else None
        reason = f"`{'.'.join(map(str, first['loc']))}`: {first['msg']}" if first else error
        raise StoreError(
            f"{path}: a damaged checkpoint: {reason}. Without it the training starts over."
        ) from None
    return True


def _restore(loop: TrainingLoop, numbers: _Numbers, tensors: Mapping[str, Tensor]) -> None:
    """Check a checkpoint's state and load it into a training."""
    for name, value in numbers:
        setattr(loop, name, value)
    _check_numbers(loop)
    _check_tensors(loop, tensors)
    loop.network.load_state_dict(_under("network.", tensors))
    loop.best = _under("best.", tensors)
    whole = loop.optimiser.state_dict()
    n_parameters = len(whole["param_groups"][0]["params"])
    whole["state"] = {
        number: _under(f"optimiser.{number}.", tensors) for number in range(n_parameters)
    }
    loop.optimiser.load_state_dict(whole)
    for parameter, state in loop.optimiser.state.items():  # the optimiser needs equal strides
        for name in MOMENTS:
            state[name] = torch.empty_like(parameter).copy_(state[name])
    loop.generator.set_state(tensors["generator"])
    loop.order, loop.rows, loop.held = (tensors[name] for name in ("order", "rows", "held"))
    loop.total = tensors["total"].to(loop.device)


def _check_numbers(loop: TrainingLoop) -> None:
    iteration, iterations = loop.iteration, loop.iterations
    ended = iteration == iterations

    def points(interval: int) -> int:
        return -(-iteration // interval) if ended else iteration // interval

    planned = iterations if loop.options.fit_seconds is not None else loop.plan.iterations
    n_validations = points(loop.validation_interval) if loop.n_held else 0
    counts = {
        "iterations": (iterations, planned),
        "iteration": (iteration, min(iteration, iterations)),
        "n_summed": (loop.n_summed, 0 if ended else iteration % LOSS_INTERVAL),
        "curve": (len(loop.curve), points(LOSS_INTERVAL)),
        "validated": (len(loop.validated), n_validations),
    }
    for name, (found, due) in counts.items():
        if found != due:
            raise ValueError(
                f"`{name}` must be {due} at iteration {iteration} of {iterations}; got {found}"
            )


def _check_tensors(loop: TrainingLoop, tensors: Mapping[str, Tensor]) -> None:
    expected = _expected_tensors(loop)
    if tensors.keys() != expected.keys():
        unlike = ", ".join(sorted(tensors.keys() ^ expected.keys()))
        raise ValueError(f"its tensors do not match the training: {unlike}")
    for name, like in expected.items():
        found = tensors[name]
        if (found.dtype, found.shape) != (like.dtype, like.shape) or not found.isfinite().all():
            raise ValueError(
                f"`{name}` must be finite numbers, {like.dtype} of shape {tuple(like.shape)}; "
                f"got {found.dtype} of shape {tuple(found.shape)}"
            )
        if name.startswith("optimiser."):
            if name.endswith(".step") and not 1 <= found <= loop.iteration:
                raise ValueError(f"`{name}` must be in [1, {loop.iteration}]; got {found}")
            if name.endswith(".exp_avg_sq") and (found < 0).any():
                raise ValueError(f"`{name}` must not be negative")
    rows, held, order = (tensors[name] for name in ("rows", "held", "order"))
    every = torch.cat([rows, held]).sort().values
    if (
        not torch.equal(every, torch.arange(loop.n_rows + loop.n_held))
        or not torch.isin(order, rows).all()
        or len(set(order.tolist())) < len(order)
    ):
        raise ValueError("its samples do not match the training")


def _expected_tensors(loop: TrainingLoop) -> dict[str, Tensor]:
    """Return tensors with the required names, types and shapes of a checkpoint."""
    weights, n_rows = loop.network.state_dict(), loop.n_rows
    batch_size = min(loop.plan.batch_size, n_rows)
    n_drawn = batch_size * ((loop.iteration - 1) % (n_rows // batch_size) + 1)
    expected = _prefixed("network.", weights)
    if loop.validated:
        expected |= _prefixed("best.", weights)
    for number, parameter in enumerate(loop.optimiser.param_groups[0]["params"]):
        state = {"step": loop.total, **dict.fromkeys(MOMENTS, parameter)}
        expected |= _prefixed(f"optimiser.{number}.", state)
    lengths = {"rows": n_rows, "held": loop.n_held, "order": n_rows - n_drawn}
    expected |= {name: loop.rows.new_empty(n) for name, n in lengths.items()}
    return expected | {"generator": loop.generator.get_state(), "total": loop.total}


def _prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {prefix + name: value for name, value in tensors.items()}


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin with the prefix, without it."""
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }
