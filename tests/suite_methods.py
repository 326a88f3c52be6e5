"""Every method in `methods/`, set up for the shared tests by the table `[battery]` of its TOML."""

from __future__ import annotations

import pytest

import mor_bench
from mor_bench.errors import MissingDependencyError
from mor_bench.specs import MethodSpec, list_suite, load_method_spec
from mor_bench.surrogate import Surrogate

SPECS: dict[str, MethodSpec] = {name: load_method_spec(name) for name in list_suite("methods")}
"""Name and specification of every method in the suite."""


def cheap_method(name: str, observed: bool = False) -> Surrogate:
    """Make a method with its cheap hyperparameters; skip the test if an extra is not installed."""
    try:
        return mor_bench.load_method(name, **SPECS[name].battery.parameters_for(observed))
    except MissingDependencyError as error:
        pytest.skip(str(error))
