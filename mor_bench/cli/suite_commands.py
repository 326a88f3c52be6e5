"""`mor-bench list` and `mor-bench check`: the files of the suite."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from textwrap import wrap
from typing import Annotated

import typer

from mor_bench.cli.console import console_width, print_wrapped
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import Json
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.errors import MissingDependencyError, MorBenchError, printable
from mor_bench.report.suite_overview import LEGEND, Item, by_family, overview
from mor_bench.specs import list_suite

app = typer.Typer(rich_markup_mode=None)

BUSY = "Still checking. Large files, and imports of a method's module, may take two minutes:"

LEAST_TITLE = 20
"""Least width of the column of titles, in characters."""

Suite = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Folder with datasets/ and methods/ to search first."),
]


@command(
    app,
    {
        "list": "List datasets and methods by family, with what each needs.",
        "list --json": "Print the same as JSON.",
    },
    name="list",
)
def list_suite_command(
    suite: Suite = None,
    as_json: Json = False,
) -> None:
    """List the datasets and methods of the suite by family, with what each needs."""
    found = overview(suite)
    if as_json:
        lists = {kind: [vars(item) for item in items] for kind, items in found.items()}
        print(json.dumps(lists, indent=1, ensure_ascii=False))
        return
    width = console_width()
    for kind, items in found.items():
        print(*_lines(kind, items, width), sep="\n")
    print(*wrap(LEGEND, width), sep="\n")


def _lines(kind: str, items: list[Item], width: int) -> Iterator[str]:
    """Yield the items of a kind by family; long titles continue in their column.

    Where there is no room for this column, titles stand below.
    """
    for family, members in by_family(items).items():
        yield f"{kind.capitalize()}: {family}"
        name, needs = (max(len(getattr(m, part)) for m in members) for part in ("name", "needs"))
        column = name + needs + 6
        below = width - column < LEAST_TITLE
        room = max(width - 4 if below else width - column, LEAST_TITLE)
        for item in members:
            titles = wrap(item.title, room, break_on_hyphens=False) or [""]
            first = "" if below else titles.pop(0)
            yield f"  {item.name:<{name}}  {item.needs:<{needs}}  {first}".rstrip()
            for line in titles:
                yield " " * (4 if below else column) + line
        yield ""


@command(
    app,
    {
        "check": "Check every file of the suite.",
        "check my-scene.toml my-method.toml": "Check two files of your own.",
    },
    {2: "A file is not valid. Standard error has one line for each."},
)
def check(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Dataset or method files. [default: all of the suite]",
            show_default=False,
        ),
    ] = None,
    suite: Suite = None,
) -> None:
    """Check dataset and method files: keys, ranges, meshes, regions and hyperparameters."""
    from mor_bench.runs.file_check import check_file  # slow to import, and `list` needs none of it

    shipped = [*list_suite("datasets", suite).values(), *list_suite("methods", suite).values()]
    problems = 0
    for path in files or shipped:
        try:
            with notice_if_slow(printable(f"{BUSY} {path}")):
                found = check_file(path)
            _print_checked(path, found)
        except MissingDependencyError as error:
            _print_checked(path, f"not checked in full: {error}")
        except MorBenchError as error:
            problems += 1
            message = str(error)
            line = message if message.startswith(str(path)) else f"{path}: {message}"
            typer.secho(printable(line, keep=""), fg="red", err=True)
    if problems:
        raise typer.Exit(2)


def _print_checked(path: Path, found: str) -> None:
    """Print a path, from the current folder if it is below it, and what a check found."""
    here = Path.cwd()
    shown = path.relative_to(here) if path.is_relative_to(here) else path
    print_wrapped(printable(f"{shown}: {found}", keep=""), "    ")
