"""Checks of the tables of results.json whose content is not a part of `Row`.

They are copies of dataset and method files and of the run's settings, also from earlier versions.
So only the keys that other code reads are checked; all others are kept as they are.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from mor_bench.specs import MAX_COUNT

_Number = Annotated[float, Field(ge=0)] | Literal["nan", "inf"]
_Count = Annotated[int, Field(ge=0, le=MAX_COUNT)]


class _Table(BaseModel):
    """A table with further keys."""

    model_config = ConfigDict(extra="allow", strict=True)


class _Needs(_Table):
    error: _Number = 0.0
    latency_ms: _Number = 0.0


class _Dataset(_Table):
    title: str | None = None
    source: str | None = None
    needs: _Needs | None = None


class _Regime(_Table):
    says: str | None = None
    min_dofs: _Count | None = None
    min_train: _Count | None = None
    min_iterations: _Count | None = None
    split: str | None = None
    gpu: bool | None = None


class _Method(_Table):
    asked: str | None = None
    regime: _Regime | None = None


class _Budget(_Table):
    configurations: _Count | None = None
    seconds: _Number | None = None


class _Settings(_Table):
    profile: str | None = None
    split: str | None = None
    device: str | None = None
    limit: _Count | None = None
    budget: _Budget | None = None


def _checked_by(model: type[_Table]) -> AfterValidator:
    """Return a check that leaves the table as it is."""

    def check(table: dict[str, Any]) -> dict[str, Any]:
        try:
            model.model_validate(table)
        except ValidationError as error:
            first = error.errors()[0]
            raise ValueError(f"`{'.'.join(map(str, first['loc']))}`: {first['msg']}") from None
        return table

    return AfterValidator(check)


RecordedDataset = Annotated[dict[str, Any], _checked_by(_Dataset)]
RecordedMethod = Annotated[dict[str, Any], _checked_by(_Method)]
RecordedSettings = Annotated[dict[str, Any], _checked_by(_Settings)]
