"""The strict base of every specification, and the numbers that they share."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Triple = Annotated[tuple[Finite, Finite, Finite], Field(strict=False)]


class StrictModel(BaseModel):
    """A frozen table without unknown keys. Values are never converted from another type."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
