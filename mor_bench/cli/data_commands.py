"""`mor-bench generate` and `mor-bench refine`: the data that methods learn from and its quality."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import typer
from pydantic import Field
from threadpoolctl import threadpool_limits

from mor_bench.cli.console import make_console
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import (
    DatasetName,
    Json,
    OptionalDatasetName,
    QuietOutput,
    with_options,
)
from mor_bench.cli.progress_bars import show_progress
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.measure.discretisation_error import RefinementPlan
from mor_bench.measure.discretisation_error import refine as refine_dataset
from mor_bench.options import Cluster, CommandLine, DataOptions, FolderOptions
from mor_bench.report.console_tables import print_discretisation
from mor_bench.snapshots.archive_import import import_archive
from mor_bench.snapshots.generate import generate as generate_shards
from mor_bench.snapshots.test_sets import with_test_sets
from mor_bench.specs import Contact, load_generated_spec

app = typer.Typer(rich_markup_mode=None)


class GenerateOptions(DataOptions):
    """Options of `mor-bench generate`."""

    panel: ClassVar[str] = "Data"

    cluster: Cluster = None


class RefineOptions(FolderOptions):
    """Options of `mor-bench refine`."""

    panel: ClassVar[str] = "Refinement"

    n_loads: Annotated[
        int,
        Field(description="Number of samples to solve, spread over the load patches."),
        CommandLine("--loads"),
    ] = 5
    levels: Annotated[
        int, Field(description="Number of refinements; each doubles the cells per axis.")
    ] = 2
    max_dofs: Annotated[
        int, Field(description="Skip meshes with more degrees of freedom than this.")
    ] = 150_000


@command(
    app,
    {
        "generate beam-coarse": "Generate all samples, on all cores.",
        "generate --from-archive beam-fine.zip": "Check the samples of an archive, and use them.",
    },
)
@with_options
def generate(
    dataset: OptionalDatasetName = None,
    tests: Annotated[
        bool, typer.Option("--tests", help="Also generate the named test sets of the dataset.")
    ] = False,
    from_archive: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Folder or ZIP file of `mor-bench archive`: check it, and take its samples "
            "instead of generating them. DATASET may be absent.",
        ),
    ] = None,
    *,
    options: GenerateOptions,
    output: QuietOutput,
) -> None:
    """Generate the snapshots of a dataset and print its folder.

    Generation can be stopped at any moment; the same command resumes it.
    """
    if from_archive is not None:
        _take(from_archive, dataset, tests, options)
        return
    if dataset is None:
        raise InvalidInputError("DATASET or `--from-archive` must be given.")
    spec = load_generated_spec(dataset, options.suite)
    items = with_test_sets(spec) if tests else [spec]
    with show_progress(make_console(stderr=True), quiet=output.quiet) as listener:
        for item in items:
            progress = partial(listener.generating, item.name)
            folder = generate_shards(
                item, options.limit, options.workers, options.cache, progress, options.cluster
            )
            print(folder)


def _take(archive: Path, dataset: str | None, tests: bool, options: GenerateOptions) -> None:
    """Put the samples of an archive into the cache, and print their folders."""
    given = {"--tests": tests, "--limit": options.limit} | {
        "--workers": options.workers,
        "--cluster": options.cluster,
    }
    if useless := [flag for flag, value in given.items() if value]:
        raise InvalidInputError(
            f"`{useless[0]}` and `--from-archive` cannot be used together: an archive is taken "
            "whole."
        )
    wanted = load_generated_spec(dataset, options.suite) if dataset else None
    with notice_if_slow("Checking the archive and copying its samples."):
        folders = import_archive(archive, options.cache, wanted)
    for folder in folders:
        print(folder)


@command(
    app,
    {
        "refine beam-coarse": "Solve five samples on meshes with two and four times the cells per "
        "axis.",
        "refine beam-tiny --levels 1 --json": "Refine once, and print the record as JSON.",
    },
)
@with_options
def refine(
    dataset: DatasetName,
    *,
    options: RefineOptions,
    output: QuietOutput,
    as_json: Json = False,
) -> None:
    """Measure the discretisation error of a dataset's mesh on refined meshes.

    Later runs show it beside the errors of the methods.
    """
    spec = load_generated_spec(dataset, options.suite)
    if isinstance(spec.loads, Contact):
        raise UnsupportedSceneError(
            f"{spec.name}: the discretisation error can be measured for forces only, not where "
            "`loads.kind` is 'contact'."
        )
    console = make_console(stderr=True)
    with show_progress(console, quiet=output.quiet) as listener, threadpool_limits(1):
        record = refine_dataset(
            spec,
            RefinementPlan(options.n_loads, options.levels, options.max_dofs),
            cache=options.cache,
            suite=options.suite,
            progress=partial(listener.generating, f"{spec.name} on refined meshes"),
        )
    if as_json:
        print(json.dumps(record, indent=1, allow_nan=False))
    else:
        print_discretisation(record, make_console())
