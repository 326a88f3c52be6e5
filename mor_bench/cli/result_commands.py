"""`mor-bench report` and `mor-bench pick`: tables and conclusions of a finished run."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import typer
from pydantic import Field

import mor_bench
from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.told import told_at_most
from mor_bench.analysis.verdict import Verdict
from mor_bench.cli.console import console_width, make_console
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import (
    Json,
    QuietOutput,
    TableOutput,
    complete_datasets,
    with_options,
)
from mor_bench.cli.run_progress import show_run
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.options import CommandLine, FolderOptions
from mor_bench.report.console_tables import finding_lines, print_tables, sentence_lines
from mor_bench.report.line_wrapping import wrapped
from mor_bench.report.number_format import explain_short_names
from mor_bench.report.page import render
from mor_bench.report.short_names import renamed, short_names
from mor_bench.runs.plan import plan
from mor_bench.specs.method_spec import Told

app = typer.Typer(rich_markup_mode=None)


TOLD_HELP = "The most that a method may be told at query time; others are left out."


class PickOptions(FolderOptions):
    """Options of `mor-bench pick`."""

    panel: ClassVar[str] = "Limits and evidence"

    error: Annotated[
        float | None,
        Field(description="Upper limit of the median relative L2 error; 0.01 is 1 %."),
        CommandLine(default="the dataset's need"),
    ] = None
    latency_ms: Annotated[
        float | None,
        Field(description="Upper limit of the median latency of one query, in ms."),
        CommandLine("--latency", metavar="MS", default="the dataset's need"),
    ] = None
    memory_bytes: Annotated[
        float | None,
        Field(description="Upper limit of the resident memory of the predicting process, in GB."),
        CommandLine("--memory", metavar="GB", default="any", scale=1e9),
    ] = None
    offline_s: Annotated[
        float | None,
        Field(description="Upper limit of the offline cost (data and fit), in core-seconds."),
        CommandLine("--offline", metavar="SECONDS", default="any"),
    ] = None
    told: Annotated[
        Told | None,
        Field(description=TOLD_HELP),
        CommandLine(default="equations"),
    ] = None
    comparison: Annotated[
        Path | None,
        Field(description="Folder of the run that provides the evidence."),
        CommandLine("--run", metavar="DIR", default="the newest finished run, or a new one"),
    ] = None


@command(
    app,
    {
        "report reports/runs/20261122-101500-beam-coarse": "Print the verdict and six columns, and "
        "write the report again.",
        "report RUN_DIR --wide | less -S": "Look at every column and table.",
    },
)
@with_options
def report(
    out: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="Folder of a run.")],
    told: Annotated[
        Told | None, typer.Option(help=f"{TOLD_HELP} Then only the tables are printed.")
    ] = None,
    *,
    output: TableOutput,
) -> None:
    """Print the tables of a finished run, and draw its figures and report again."""
    detail = output.detail
    notice = "Reading the run and drawing its figures."
    with notice_if_slow(notice, quiet=detail.quiet) as spoken:
        comparison = mor_bench.Comparison.read(out)
        comparison.check_samples()
        if told is not None:
            spoken()
            print_tables(told_at_most(comparison, told), make_console(), detail=detail)
            return
        analysis = analyse(comparison)
        comparison.finish(analysis)
        spoken()
        print_tables(comparison, make_console(), analysis, detail)
        written = render(comparison, analysis, pages=output.pages)
    for path in written if detail.verbose else written[-1:]:
        print(path)


PickedDataset = Annotated[
    str,
    typer.Argument(
        metavar="DATASET|RUN_DIR",
        help="Name or TOML file of a dataset, or the folder of a run of one dataset: then its "
        "stored results are the evidence.",
        autocompletion=complete_datasets,
    ),
]


@command(
    app,
    {
        "pick beam-coarse": "Choose by the limits of the dataset's [needs], on the evidence of the "
        "newest run. The folder of a run also names its dataset.",
        "pick beam-coarse --error 0.003 --memory 0.5": "Choose with an error of at most 0.3 % and "
        "with at most 0.5 GB.",
    },
    {1: "No configuration qualifies; the output says how far the limits must be relaxed."},
)
@with_options
def pick(
    dataset: PickedDataset,
    *,
    options: PickOptions,
    output: QuietOutput,
    as_json: Json = False,
) -> None:
    """Name the fastest configuration that meets a dataset's needs, with the evidence.

    If there is none, the exit code is 1 and the output says how far the needs must be relaxed.
    """
    planned = partial(plan, [dataset], cache=options.cache, suite=options.suite)
    with show_run(make_console(stderr=True), planned, quiet=output.quiet) as listener:
        chosen = mor_bench.pick(dataset, listener=listener, **options.model_dump())
    if as_json:
        print(json.dumps(chosen.as_json(), indent=1, ensure_ascii=False, allow_nan=False))
    else:
        print(*_lines(chosen, console_width(), quiet=output.quiet), sep="\n")
    if chosen.choice is None:
        raise typer.Exit(1)


def _lines(chosen: Verdict, width: int, *, quiet: bool) -> Iterator[str]:
    """Yield the verdict in lines of this width: the headline, its figures, all else."""
    names = short_names(chosen.rows)
    if quiet:
        yield from wrapped(renamed(chosen.headline, names), width, names=names.values())
        return
    yield from finding_lines(chosen.headline, names, width)
    for line in chosen.evidence:
        name = re.match(r" +\w+ +", line)  # such as "    latency  "
        first = (
            name[0] if name and line.startswith("    ") else " " * (len(line) - len(line.lstrip()))
        )
        text = renamed(line, names)[len(first) :]
        yield from wrapped(text, width, " " * len(first), first=first, names=names.values())
    yield from sentence_lines(chosen.headline, chosen.beside, names, width)
    swept = explain_short_names(row.swept for row in chosen.rows)
    yield from wrapped(swept, width)
