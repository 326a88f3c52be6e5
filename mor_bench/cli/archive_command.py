"""`mor-bench archive`: a dataset for a data repository."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import typer
from pydantic import Field

from mor_bench.cli.console import make_console
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import DatasetName, QuietOutput, with_options
from mor_bench.cli.progress_bars import show_progress
from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.export.archive import write_archive
from mor_bench.export.data_card import CREATIVE_COMMONS, Licence
from mor_bench.options import CommandLine, DataOptions
from mor_bench.specs import ImportedDatasetSpec, list_suite, load_dataset_spec

SUITE_AUTHORS = "The mor-bench authors"
"""Default authors of the suite's datasets."""

app = typer.Typer(rich_markup_mode=None)


class ArchiveOptions(DataOptions):
    """Options of `mor-bench archive`."""

    panel: ClassVar[str] = "Archive"

    tests: Annotated[bool, Field(description="Add the named test sets of the dataset.")] = False
    licence: Annotated[
        str,
        Field(
            description=f"Licence of the data: {', '.join(CREATIVE_COMMONS)}, or the path of "
            "a text."
        ),
        CommandLine(metavar="LICENCE"),
    ] = "CC-BY-4.0"


@command(
    app,
    {
        "archive beam-coarse --out beam-coarse.zip": "Write all samples to a ZIP file.",
        "archive my.toml --out my-data --author 'Ada Byron' --tests": "Write a folder, with the "
        "named test sets.",
    },
)
@with_options
def archive(
    dataset: DatasetName,
    out: Annotated[
        Path,
        typer.Option(
            metavar="PATH", help="ZIP file to write if it ends in .zip, otherwise a folder."
        ),
    ],
    author: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Author of the data; repeat for more."),
    ] = None,
    *,
    options: ArchiveOptions,
    output: QuietOutput,
) -> None:
    """Write a dataset with all its samples for a data repository, such as Zenodo.

    It holds samples, the dataset's files, checksums, a data card, a licence and metadata. Missing
    samples are generated first. `mor-bench generate --from-archive` reads it.
    """
    if options.limit is not None:
        raise InvalidInputError("`--limit` must be absent: an archive holds the whole dataset.")
    spec = load_dataset_spec(dataset, options.suite)
    if isinstance(spec, ImportedDatasetSpec):
        raise UnsupportedSceneError(
            f"{spec.name}: its snapshots were imported. Publish their file and the TOML instead."
        )
    authors = author or ([SUITE_AUTHORS] if dataset in list_suite("datasets") else [])
    if not authors:
        raise InvalidInputError(
            "`--author` must name the authors of a dataset that is not of the suite."
        )
    with show_progress(make_console(stderr=True), quiet=output.quiet) as listener:
        written = write_archive(
            spec,
            out,
            authors,
            Licence.named(options.licence),
            tests=options.tests,
            cache=options.cache,
            workers=options.workers,
            progress=partial(listener.generating, spec.name),
        )
    print(written.path)
    typer.echo(f"SHA-256 of its list of checksums: {written.sums_sha256}", err=True)
