"""`mor-bench show`: one run, method or dataset in detail."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Annotated

import typer
from rich.text import Text

from mor_bench.cli.console import make_console
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import Json, complete_datasets, complete_methods
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.errors import InvalidInputError
from mor_bench.report.cards import Card, dataset_card, method_card, run_card
from mor_bench.report.line_wrapping import command_lines, wrapped
from mor_bench.results.comparison import Comparison
from mor_bench.runs.pick import RUNS
from mor_bench.specs import is_method_file, list_suite, load_dataset_spec, load_method_spec
from mor_bench.specs.inline_parameters import split_method
from mor_bench.specs.one_line_errors import nearest_name
from mor_bench.specs.suite_folder import FORMER_NAMES, Kind

app = typer.Typer(rich_markup_mode=None)


def complete_names(incomplete: str) -> list[str]:
    """Return the names of datasets and methods that begin with a text."""
    return [*complete_datasets(incomplete), *complete_methods(incomplete)]


@command(
    app,
    {
        "show hpod": "Show a method: what it needs, its limits and its hyperparameters.",
        "show beam-coarse": "Show a dataset: mesh, material, loads and discretisation error.",
    },
)
def show(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="A method or dataset of the suite, a TOML file, the folder of a run, or the name "
            "of a folder in reports/runs.",
            autocompletion=complete_names,
        ),
    ],
    suite: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder with datasets/ and methods/ to search first."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Show one run, method or dataset in detail."""
    with notice_if_slow("Reading; a large mesh takes some time."):
        card = card_of(name, suite)
    if as_json:
        print(json.dumps(card.as_dict(), indent=1, ensure_ascii=False))
        return
    print_card(card)


def card_of(name: str, suite: Path | None = None) -> Card:
    """Return the card of a run, a method or a dataset.

    Raises
    ------
    InvalidInputError
        If there is nothing of this name; the message gives the nearest one.
    """
    for folder in (Path(name), RUNS / name):
        if folder.is_dir():
            return run_card(Comparison.read(folder))
    if name.endswith(".toml"):
        path = Path(name)
        if is_method_file(path):
            return method_card(load_method_spec(path))
        return dataset_card(load_dataset_spec(path), path)
    methods, datasets = _known("methods", suite), _known("datasets", suite)
    if split_method(name)[0] in {*methods, *FORMER_NAMES["methods"]}:
        return method_card(load_method_spec(name, suite))
    if name in datasets:
        return dataset_card(load_dataset_spec(name, suite), datasets[name])
    runs = [path.parent.name for path in RUNS.glob("*/results.json")]
    raise InvalidInputError(
        f"{name!r} is no run, method or dataset{nearest_name(name, [*methods, *datasets, *runs])} "
        "`mor-bench list` shows the names."
    )


def _columns(rows: Sequence[Sequence[str]], width: int) -> Iterator[str]:
    """Yield name, values and range of hyperparameters; a range without room has its own line."""
    wide = [max((len(row[i]) for row in rows), default=0) for i in (0, 1)]
    for name, values, allowed in rows:
        first = f"  {name:<{wide[0]}}  {values:<{wide[1]}}  "
        if len(first) + len(allowed) <= width:
            yield first + allowed
        else:
            yield first.rstrip()
            yield from wrap(allowed, width, initial_indent=" " * 6, subsequent_indent=" " * 6)


def _known(kind: Kind, suite: Path | None) -> dict[str, Path]:
    own = list_suite(kind, suite) if suite is not None else {}
    return {**list_suite(kind), **own}


def print_card(card: Card) -> None:
    """Print a card: the title, each fact under its name, a table, and commands to go on with."""
    console = make_console()
    console.print(Text(card.title, style="bold"))
    for name, text in card.facts.items():
        console.print(Text(name, style="dim"))
        for line in wrapped(text, console.width, "  ", first="  "):
            console.print(Text(line, no_wrap=True), soft_wrap=True)
    if card.hyperparameters:
        console.print(Text("hyperparameters in `mor-bench run`", style="dim"))
    for line in _columns(card.hyperparameters, console.width):
        console.print(Text(line), soft_wrap=True)
    console.print()
    for line in (
        part for given in card.commands for part in command_lines(given, console.width, "")
    ):
        console.print(Text(line, no_wrap=True), soft_wrap=True, highlight=False)
