"""Commands on damaged and forged files end with code 0 or 2, and never with a traceback."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

import mor_bench
from tests.commands import invoke
from tests.damaged_runs import a_run
from tests.mutations import JSON, OF_COMMANDS, TEXT, Reader, attacked, documented

SUITE = Path(mor_bench.__file__).parents[1]

COMMAND_S = 30.0
"""Processor time for a command; a report draws figures."""


def ends_well(path: Path, *arguments: str) -> None:
    """Call the command line on a file; an unclean end is an error."""
    place = {"FILE": path, "RUN": path.parent, "ASV": path.parent / "asv"}
    done = invoke(*(str(place.get(word, word)) for word in arguments))
    assert done.exit_code in (0, 2), done.exit_code
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert "Traceback" not in done.output + done.stderr


def of_suite(kind: str, name: str) -> Callable[[Path], object]:
    return lambda path: shutil.copyfile(SUITE / kind / name, path)


def reader(name: str, write: Callable[[Path], object], *arguments: str) -> Reader:
    mutators = TEXT if name.endswith(".toml") else JSON
    return Reader(name, write, partial(_called, arguments=arguments), mutators, COMMAND_S)


def _called(path: Path, arguments: tuple[str, ...]) -> None:
    ends_well(path, *arguments)


ARGUMENTS = {
    "check": ("check", "FILE"),
    "show d.toml": ("show", "FILE"),
    "show results.json": ("show", "RUN"),
    "pick": ("pick", "beam-tiny", "--comparison", "RUN"),
    "report": ("report", "RUN"),
    "export": ("export", "asv", "RUN", "--out", "ASV"),
}
FILES = {
    "d.toml": of_suite("datasets", "beam-tiny.toml"),
    "m.toml": of_suite("methods", "pod.toml"),
    "results.json": a_run,
}


def reader_of(name: str) -> Reader:
    command, file = name.split()
    return reader(file, FILES[file], *ARGUMENTS.get(name, ARGUMENTS.get(command, ())))


@pytest.mark.parametrize("name", OF_COMMANDS)
def test_commands_on_mutated_files_end_well(name: str, tmp_path: Path) -> None:
    attacked(reader_of(name), tmp_path, OF_COMMANDS[name][0])


@pytest.mark.nightly
@pytest.mark.parametrize("name", OF_COMMANDS)
def test_commands_on_many_mutated_files_end_well(name: str, tmp_path: Path) -> None:
    attacked(reader_of(name), tmp_path, OF_COMMANDS[name][1])


def test_the_documented_count_is_that_of_these_tests() -> None:
    total = sum(slow for _, slow in OF_COMMANDS.values())
    assert documented()["files of commands: check, show, pick, report, export"] == total
