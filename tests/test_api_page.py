"""The API reference: every public name is on the page once, and has an example that runs."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
from collections import Counter
from typing import Any

import pytest

import mor_bench
import mor_bench.adapters
from tests.published.stored import ROOT


def names_of_the_page() -> list[str]:
    """Return the full names that docs/api.md lists."""
    module, names = "", []
    for line in (ROOT / "docs" / "api.md").read_text(encoding="utf-8").splitlines():
        if found := re.match(r"\.\. currentmodule:: (\S+)", line):
            module = found[1]
        elif found := re.fullmatch(r"   ([A-Za-z_][\w.]*)", line):
            names.append(f"{module}.{found[1]}")
    return names


NAMES = names_of_the_page()

LONG = ("mor_bench.run", "mor_bench.pick", "mor_bench.Comparison", "mor_bench.Verdict")
"""Their examples time a method, so pytest's collection of docstrings leaves them out."""


def test_every_public_name_is_on_the_page_once() -> None:
    assert [name for name, times in Counter(NAMES).items() if times > 1] == []
    public = {f"mor_bench.{name}" for name in mor_bench.__all__}
    assert public | {f"mor_bench.adapters.{name}" for name in mor_bench.adapters.__all__} <= {
        *NAMES
    }


def examples_of(name: str) -> tuple[list[doctest.Example], dict[str, Any]]:
    """Return the examples of a name's docstring, and the globals of its module."""
    module, _, last = name.rpartition(".")
    thing = getattr(importlib.import_module(module), last)
    _, _, section = (inspect.getdoc(thing) or "").partition("\nExamples\n--------\n")
    names = vars(importlib.import_module(thing.__module__))
    return doctest.DocTestParser().get_examples(section), dict(names)


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_has_an_example_that_is_checked(name: str) -> None:
    examples, _ = examples_of(name)
    assert any(example.want for example in examples), f"{name} has no example with a result"
    left_out = any(example.options.get(doctest.SKIP) for example in examples)
    assert left_out == (name in LONG)


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_examples_that_time_methods_run(name: str) -> None:
    examples, names = examples_of(name)
    for example in examples:
        example.options.pop(doctest.SKIP, None)
    runner = doctest.DocTestRunner()
    runner.run(doctest.DocTest(examples, names, name, None, None, None))
    assert (runner.failures, runner.tries) == (0, len(examples))
