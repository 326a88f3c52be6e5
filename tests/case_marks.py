"""Marks that leave most cases of a long test to the nightly tests."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from _pytest.mark import ParameterSet


def nightly_but(every: int, cases: Iterable[Any]) -> list[ParameterSet]:
    """Mark all cases of one parameter as nightly, except the first of each `every` cases."""
    return [
        pytest.param(case, marks=(pytest.mark.nightly,) if number % every else ())
        for number, case in enumerate(cases)
    ]
