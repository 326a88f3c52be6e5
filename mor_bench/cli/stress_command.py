"""`mor-bench stress`: the hard cases."""

from __future__ import annotations

import json
from collections.abc import Callable
from math import inf
from pathlib import Path
from time import perf_counter
from typing import Annotated, ClassVar

import typer
from pydantic import Field
from rich.status import Status

from mor_bench.cli.console import make_console
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import Json, QuietOutput, complete_methods, with_options
from mor_bench.cli.progress_bars import PRINT_EVERY_S, print_plain
from mor_bench.errors import InvalidInputError
from mor_bench.hard_cases.suite import stress as run_cases
from mor_bench.options import FolderOptions, Profile
from mor_bench.report.hard_case_table import print_stress
from mor_bench.snapshots.store import check_replaceable

app = typer.Typer(rich_markup_mode=None)


class StressOptions(FolderOptions):
    """Options of `mor-bench stress`."""

    panel: ClassVar[str] = "Cases"

    profile: Annotated[
        Profile,
        Field(description="Parameters of the method files; quick also shortens trainings."),
    ] = "quick"


@command(
    app,
    {
        "stress -m pod -m my-method.toml": "Try all hard cases on two methods.",
        "stress --case zero-force --out stress.json": "Try one case on all methods, and keep the "
        "numbers.",
    },
)
@with_options
def stress(
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            "-m",
            help="Name or TOML file of a method; repeat for more. [default: all of the suite]",
            autocompletion=complete_methods,
        ),
    ] = None,
    case: Annotated[
        list[str] | None,
        typer.Option("--case", help="Name of a hard case; repeat for more. [default: all]"),
    ] = None,
    *,
    options: StressOptions,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="JSON file to write.")] = None,
    output: QuietOutput,
    as_json: Json = False,
) -> None:
    """Try the hard cases on the full-order model and on methods.

    The table shows the expected and the actual behaviour. The exit code is 0 even if a method
    falls short.
    """
    if out is not None and not out.resolve().parent.is_dir():
        raise InvalidInputError(f"`--out`: there is no folder {out.resolve().parent}.")
    if out is not None:
        check_replaceable(out)
    console = make_console(stderr=as_json)
    with Status("", console=make_console(True, output.quiet)) as status:
        found = run_cases(
            method or None, case or None, starting=_shown_in(status), **options.model_dump()
        )
    print_stress(found, console, output.quiet)
    if out is not None:
        found.write(out)
        console.print(str(out), highlight=False, soft_wrap=True)
    if as_json:
        print(json.dumps(found.as_dict(), indent=1, allow_nan=False, ensure_ascii=False))


def _shown_in(status: Status) -> Callable[[str, str, int, int], None]:
    """Return a function that shows the present case, or prints one now and then in a pipe."""
    printed_at = -inf

    def show(name: str, tried: str, number: int, total: int) -> None:
        nonlocal printed_at
        text = f"{number} of {total}: {name}, {tried}"
        if status.console.is_terminal:
            status.update(text)
        elif perf_counter() - printed_at >= PRINT_EVERY_S:
            printed_at = perf_counter()
            print_plain(status.console, text)

    return show
