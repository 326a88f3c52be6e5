"""Commands and blocks of Python in the documentation: they parse, and the names in them exist.

A block of Python runs when its page is built (`{code-cell}`), or in a test (`<!-- python -->`, see
`test_own_data_guide.py`). Any other block is marked `<!-- excerpt -->`. Its names are checked here,
and a slow test runs it on few samples.
"""

from __future__ import annotations

import ast
import re
import shlex
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import typer

import mor_bench
from mor_bench.cli.app import app
from mor_bench.specs.suite_folder import list_suite
from tests.published.stored import ROOT
from tests.small_runs import short_timing

UsageError = typer.BadParameter.__mro__[1]

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"^\s*(mor-bench .+)$|`(mor-bench [^`]+)`", re.MULTILINE)
PROSE = re.compile(r" (?:a|are|as|its|the) ")
"""Words of a sentence that begins with `mor-bench` at the start of a line."""

PLACEHOLDER = re.compile(r"[A-Z]{2}|…|^my\b|^mean\b|^nearest\b|^pymor-pod\b|[/.]")
"""Of names that the reader replaces, and of files: those that do not belong to the suite."""


def commands_of(page: Path) -> Iterator[str]:
    """Yield the calls of `mor-bench` in a page, without prose, comments, pipes and redirections."""
    for line, inline in COMMAND.findall(page.read_text(encoding="utf-8")):
        call = re.split(r" #| \\?\||>", line or inline)[0].strip()
        if not (line and PROSE.search(call)):
            yield call


COMMANDS = sorted({(page.name, text) for page in PAGES for text in commands_of(page)})


def parsed(text: str) -> dict[str, Any]:
    """Return the parameters of a call, parsed as by the shell and by `mor-bench`.

    Nothing runs: options of the whole program, such as `--install-completion`, would act while they
    are parsed, so they are only looked up.
    """
    command: Any = typer.main.get_command(
        app
    )  # of Click, or of the copy in newer versions of Typer
    words = shlex.split(text, comments=True)[1:]
    if words[0].startswith("-"):
        assert words[0] in {option for p in command.params for option in p.opts}
        return {}
    context = command.make_context("mor-bench", list(words))
    while words and hasattr(command, "resolve_command"):
        name, command, words = command.resolve_command(context, words)
        # `mor-bench pick` in a sentence has no arguments
        context = command.make_context(
            name, list(words), parent=context, resilient_parsing=not words
        )
    parameters: dict[str, Any] = context.params
    return parameters


def unknown_names(parameters: dict[str, Any]) -> list[str]:
    """Return the names of datasets and methods that the suite does not have."""
    known = {*list_suite("datasets"), *list_suite("methods")}
    found = []
    for name in ("dataset", "datasets", "method", "methods", "name", "names"):
        value = parameters.get(name)
        texts = value if isinstance(value, list | tuple) else [value]
        names = (text.partition("[")[0] for text in texts if isinstance(text, str))
        found += [text for text in names if text not in known and not PLACEHOLDER.search(text)]
    return found


@pytest.mark.parametrize(("page", "text"), COMMANDS)
def test_every_command_parses_and_names_what_exists(page: str, text: str) -> None:
    assert unknown_names(parsed(text)) == [], page


def test_commands_with_errors_are_found() -> None:
    assert len(COMMANDS) > 80
    for wrong in ("run beam-coarse --sed 3", "no-such-command beam-tiny", "run --split by"):
        with pytest.raises(UsageError):
            parsed(f"mor-bench {wrong}")
    for wrong in ("run beam-corse", "run beam-tiny -m podd", "pick beem"):
        assert unknown_names(parsed(f"mor-bench {wrong}"))


BLOCKS = [
    (page.name, mark, block)
    for page in PAGES
    for mark, block in re.findall(
        r"(?:<!-- (\w+) -->\n)?```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL
    )
]


@pytest.mark.parametrize(("page", "mark", "block"), BLOCKS)
def test_every_block_of_python_is_run_or_is_an_excerpt_of_names_that_exist(
    page: str, mark: str, block: str
) -> None:
    assert mark == "excerpt" or (page, mark) == ("own-data.md", "python")
    compile(block, page, "exec")
    for node in ast.walk(ast.parse(block)):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "mor_bench":
            assert hasattr(mor_bench, node.attr)


EXCERPTS = [(page, block) for page, mark, block in BLOCKS if mark == "excerpt"]

LIMIT = 60
"""Samples of a dataset while an excerpt runs."""


@pytest.mark.slow
@pytest.mark.parametrize(("page", "block"), EXCERPTS)
def test_every_excerpt_runs(
    page: str, block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "Comparison.read" not in block:
        monkeypatch.chdir(tmp_path)
    cache = tmp_path / "cache"
    for name in ("load_dataset", "run"):
        function: Any = getattr(mor_bench, name)
        monkeypatch.setattr(mor_bench, name, partial(function, cache=cache, limit=LIMIT))
    module = ModuleType("excerpt")
    vars(module).update(np=np, mor_bench=mor_bench)
    monkeypatch.setitem(sys.modules, "excerpt", module)  # where dataclasses look themselves up
    with short_timing():
        exec(compile(block, page, "exec"), vars(module))


def test_there_are_excerpts() -> None:
    assert len(EXCERPTS) > 8


def test_no_page_installs_the_unpublished_package_by_name() -> None:
    pages = [page.name for page in PAGES if "pip install 'mor-bench" in page.read_text("utf-8")]
    assert pages == []
