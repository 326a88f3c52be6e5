"""`mor-bench run`: a comparison, or with `--dry-run` its plan."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import typer
from pydantic import Field
from rich.console import Console

import mor_bench
from mor_bench.cli.console import make_console
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import (
    OUTPUT,
    TableOutput,
    complete_datasets,
    complete_methods,
    with_options,
)
from mor_bench.cli.run_progress import show_run
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.options import CommandLine, RunOptions
from mor_bench.report.console_tables import print_plan, print_tables
from mor_bench.report.page import render
from mor_bench.runs.plan import Plan, plan

app = typer.Typer(rich_markup_mode=None)


class RunOutput(TableOutput):
    """Output of `mor-bench run`."""

    panel: ClassVar[str] = OUTPUT

    json_: Annotated[
        bool,
        Field(description="Print JSON to standard output, the rest to standard error."),
        CommandLine("--json"),
    ] = False


@command(
    app,
    {
        "run beam-tiny -m fem -m 'pod[n_modes=10,20]'": "Compare FEM with two sizes of POD, in "
        "less than a minute.",
        "run --split sample --out reports/runs/random": "Run the default comparison with a random "
        "split. The same command continues a run that was stopped.",
    },
    {1: "No configuration has a result; with --fail-fast, at least one failed."},
)
@with_options
def run(
    datasets: Annotated[
        list[str] | None,
        typer.Argument(
            help="Names or TOML files of datasets. [default: beam-coarse]",
            show_default=False,
            autocompletion=complete_datasets,
        ),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            "-m",
            help="Name or TOML file of a method; repeat for more. Values in brackets replace those "
            "of the file: -m 'pod[n_modes=10,20]'. "
            "[default: the core methods, or those that need no equations]",
            autocompletion=complete_methods,
        ),
    ] = None,
    *,
    options: RunOptions,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder to write to. [default: reports/runs/TIME-DATASETS]"
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only print the configurations and estimated times.")
    ] = False,
    output: RunOutput,
) -> None:
    """Fit, score and time methods on datasets, and write tables, figures and a report."""
    detail = output.detail
    console = make_console(stderr=output.json_)
    names = datasets or ["beam-coarse"]
    planned = partial(plan, names, method or None, **options.model_dump())
    if dry_run:
        _print_plan(planned, console, output.json_)
        return
    with show_run(console, planned, quiet=detail.quiet, verbose=detail.verbose) as listener:
        comparison = mor_bench.run(
            names, method or None, out=out, listener=listener, **options.model_dump()
        )
    analysis = comparison.analysis
    with notice_if_slow("Drawing figures and writing the report.", quiet=detail.quiet):
        written = render(
            comparison, analysis, pages=output.pages
        )  # first, since the tables may meet a closed pipe
    print_tables(comparison, console, analysis, detail)
    for path in written if detail.verbose else written[-1:]:
        console.print(str(path), highlight=False, soft_wrap=True)
    if output.json_:
        print((comparison.out / "results.json").read_text(encoding="utf-8"))
    failed = options.fail_fast and any(row.status == "failed" for row in comparison.rows)
    if failed or not any(row.ok for row in comparison.rows):
        raise typer.Exit(1)


def _print_plan(planned: Callable[[], Plan], console: Console, as_json: bool) -> None:
    with notice_if_slow(
        "Planning; methods are imported, and a few samples are solved to estimate times."
    ):
        found = planned()
    if as_json:
        print(json.dumps(found.as_dict(), indent=1))
    print_plan(found, console)
