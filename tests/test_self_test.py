"""The self-test of `mor-bench doctor` passes here, and notices what is broken."""

from __future__ import annotations

import json

import pytest

from mor_bench.method_loading import load_method
from mor_bench.runs import self_test
from mor_bench.sandbox import landlock, process
from tests.commands import invoke


@pytest.mark.slow
def test_the_self_test_passes() -> None:
    done = invoke("doctor", "--self-test", "--json")
    assert done.exit_code == 0, done.output
    found = {check["name"]: check["passed"] for check in json.loads(done.stdout)}
    assert len(found) == 5
    assert all(passed or passed is None for passed in found.values())
    assert found["sealed folders"] == (True if landlock.version() else None)


@pytest.mark.slow
def test_the_self_test_notices_what_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_test, "load_surrogate", lambda path: load_method("pod"))
    monkeypatch.setattr(process, "MEMORY_CHECK_S", 100.0)
    monkeypatch.setattr(self_test, "HOLD_S", 0.5)
    checks = {check.name: check.passed for check in self_test.self_test()}
    assert not checks["damaged models"]
    assert not checks["memory limit"]
