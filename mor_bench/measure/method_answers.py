"""Keys and types of the answers of a method's process, which foreign code may have forged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from mor_bench.sandbox.session import Answer


class Fitted(Answer):
    """Cost and results of a fit."""

    fit_s: float
    fit_core_s: float
    fit_memory_bytes: int
    model_bytes: int | None
    needs_snapshots: bool
    parameters: dict[str, Any]
    sizes: dict[str, Any]
    training: dict[str, Any] | None


class Flagged(Answer):
    """Flags of loads out of range; None if the method has none."""

    flagged: list[bool] | None


class Spread(Answer):
    """Uncertainty of each answer; None for methods without a spread."""

    spread: list[Annotated[float, Field(ge=0)]] | None


class Counted(Answer):
    """Counted work of a query; None if nothing is counted."""

    cost: dict[str, float] | None


class Warm(Answer):
    """Peak memory after the warm-up, bytes."""

    memory_bytes: int


class Timed(Answer):
    """Times of single queries."""

    latency_ms: list[float]
    gc_ms: list[float]
    cpu_s: float
    wall_s: float
    cpu_all_s: float
    checked: list[int]


class Throughput(Answer):
    """Queries per second, by size of the batch."""

    throughput: dict[str, float | None]


ANSWERS: Mapping[str, type[Answer]] = {
    "fit": Fitted,
    "flag": Flagged,
    "spread": Spread,
    "cost": Counted,
    "warm": Warm,
    "time": Timed,
    "throughput": Throughput,
}
"""Answers by request, see `mor_bench.measure.method_session.MethodSession`."""
