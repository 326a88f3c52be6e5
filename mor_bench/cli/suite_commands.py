"""`mor-bench list` and `mor-bench check`: the files of the suite."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.errors import MissingDependencyError, MorBenchError, printable
from mor_bench.specs import list_suite, load_dataset_spec, load_method_spec

app = typer.Typer(rich_markup_mode=None)

BUSY = "still checking; large files take a minute."

Suite = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Folder with datasets/ and methods/ to search first."),
]


@app.command(name="list")
def list_suite_command(
    suite: Suite = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the lists as JSON.")] = False,
) -> None:
    """List the datasets and methods of the suite."""
    datasets = {
        name: load_dataset_spec(path).title for name, path in list_suite("datasets", suite).items()
    }
    methods = {
        name: load_method_spec(path).title for name, path in list_suite("methods", suite).items()
    }
    if as_json:
        lists = {
            kind: [{"name": name, "title": title} for name, title in titles.items()]
            for kind, titles in (("datasets", datasets), ("methods", methods))
        }
        print(json.dumps(lists, indent=1, ensure_ascii=False))
        return
    width = max(map(len, [*datasets, *methods]))
    for heading, titles in (("Datasets", datasets), ("Methods", methods)):
        print(heading)
        for name, title in titles.items():
            print(f"  {name:<{width}}  {title}")


@app.command()
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
    """Check dataset and method files: keys, ranges, meshes, regions and hyperparameters.

    The exit code is 2 if any file is not valid.
    """
    from mor_bench.runs.file_check import check_file  # slow to import, and `list` needs none of it

    shipped = [*list_suite("datasets", suite).values(), *list_suite("methods", suite).values()]
    problems = 0
    for path in files or shipped:
        try:
            with notice_if_slow(printable(f"{path}: {BUSY}")):
                found = check_file(path)
            print(printable(f"{path}: {found}", keep=""))
        except MissingDependencyError as error:
            print(printable(f"{path}: not checked in full: {error}"))
        except MorBenchError as error:
            problems += 1
            message = str(error)
            line = message if message.startswith(str(path)) else f"{path}: {message}"
            typer.secho(printable(line, keep=""), fg="red", err=True)
    if problems:
        raise typer.Exit(2)
