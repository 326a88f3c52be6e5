"""`mor-bench run`: a comparison, or with `--dry-run` its plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

import mor_bench
from mor_bench.cli.console import make_console
from mor_bench.cli.option_groups import Json, with_options
from mor_bench.cli.progress_bars import show_progress
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.options import RunOptions
from mor_bench.report.console_tables import print_plan, print_tables
from mor_bench.report.page import render
from mor_bench.runs.plan import plan

app = typer.Typer(rich_markup_mode=None)

DRAWING = "Drawing figures and writing the report."


@app.command()
@with_options
def run(
    datasets: Annotated[
        list[str] | None,
        typer.Argument(
            help="Names or TOML files of datasets. [default: beam-coarse]",
            show_default=False,
        ),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            "-m",
            help="Name or TOML file of a method; repeat for more. "
            "[default: the core methods, or those that need no equations]",
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
    as_json: Json = False,
) -> None:
    """Fit, score and time methods on datasets, and write tables, figures and a report."""
    console = make_console(stderr=as_json)
    names = datasets or ["beam-coarse"]
    if dry_run:
        _print_plan(names, method or None, options, as_json)
        return
    with show_progress(console) as listener:
        comparison = mor_bench.run(
            names, method or None, out=out, listener=listener, **options.model_dump()
        )
    analysis = comparison.analysis
    with notice_if_slow(DRAWING):  # first, since the tables may meet a closed pipe
        written = render(comparison, analysis)
    print_tables(comparison, console, analysis)
    for path in written:
        console.print(str(path), highlight=False, soft_wrap=True)
    if as_json:
        print((comparison.out / "results.json").read_text(encoding="utf-8"))
    failed = options.fail_fast and any(row.status == "failed" for row in comparison.rows)
    if failed or not any(row.ok for row in comparison.rows):
        raise typer.Exit(1)


def _print_plan(
    datasets: list[str], methods: list[str] | None, options: RunOptions, as_json: bool
) -> None:
    with notice_if_slow("Planning; a few samples are solved to estimate the times."):
        planned = plan(datasets, methods, **options.model_dump())
    if as_json:
        print(json.dumps(planned.as_dict(), indent=1))
    print_plan(planned, make_console(stderr=as_json))
