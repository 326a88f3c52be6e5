"""The command `mor-bench doctor`, and the recorded machines."""

from __future__ import annotations

import importlib.util
import json
from importlib.metadata import metadata

import pytest

from mor_bench.measure.machine_speed import recorded_machines
from mor_bench.runs import installation
from mor_bench.runs.installation import EXTRAS, installed_libraries
from tests.commands import invoke


def test_the_libraries_are_those_of_the_package_with_their_sizes() -> None:
    libraries = {library.name: library for library in installed_libraries()}
    assert {"mor-bench", "numpy", "numba", "llvmlite", "scipy"} <= libraries.keys()
    assert "ruff" not in libraries  # only for developers
    assert libraries["scipy"].size_bytes > 5e7


def test_every_extra_for_users_is_known() -> None:
    extras = set(metadata("mor-bench").get_all("Provides-Extra") or [])
    assert extras - {"all", "dev", "docs"} == set(EXTRAS)


def test_recorded_machines_differ_where_instructions_matter() -> None:
    first, second = (machine.speed for machine in recorded_machines()[:2])
    assert first.convolution_ms
    assert second.convolution_ms
    assert second.convolution_ms > 1.5 * first.convolution_ms


@pytest.mark.slow
def test_the_doctor_names_missing_extras_and_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    there = importlib.util.find_spec("json")
    monkeypatch.setattr(installation, "find_spec", lambda name: None if name == "onnx" else there)
    shown = invoke("doctor")
    assert shown.exit_code == 0, shown.output
    assert "The extra `onnx` is missing" in shown.output
    assert "The extra `learn` is missing" not in shown.output
    assert "residual" in shown.output
    found = json.loads(invoke("doctor", "--json").stdout)
    assert found["speed"]["residual_us"] > 0
    assert found["default_run_s"] > 0
    assert list(found["missing_extras"]) == ["onnx"]
