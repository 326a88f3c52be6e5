"""`mor-bench generate` and `mor-bench refine`: the data that methods learn from and its quality."""

from __future__ import annotations

import json
from functools import partial
from typing import Annotated, ClassVar

import typer
from pydantic import Field
from threadpoolctl import threadpool_limits

from mor_bench.cli.console import make_console
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import DatasetName, Json, QuietOutput, with_options
from mor_bench.cli.progress_bars import show_progress
from mor_bench.errors import UnsupportedSceneError
from mor_bench.measure.discretisation_error import RefinementPlan
from mor_bench.measure.discretisation_error import refine as refine_dataset
from mor_bench.options import Cluster, CommandLine, DataOptions, FolderOptions
from mor_bench.report.console_tables import print_discretisation
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
        "generate beam-fine --tests --workers 2": "Generate the named test sets too, in two "
        "processes.",
    },
)
@with_options
def generate(
    dataset: DatasetName,
    tests: Annotated[
        bool, typer.Option("--tests", help="Also generate the named test sets of the dataset.")
    ] = False,
    *,
    options: GenerateOptions,
    output: QuietOutput,
) -> None:
    """Generate the snapshots of a dataset and print its folder.

    Generation can be stopped at any moment; the same command resumes it.
    """
    spec = load_generated_spec(dataset, options.suite)
    items = with_test_sets(spec) if tests else [spec]
    with show_progress(make_console(stderr=True), quiet=output.quiet) as listener:
        for item in items:
            progress = partial(listener.generating, item.name)
            folder = generate_shards(
                item, options.limit, options.workers, options.cache, progress, options.cluster
            )
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
