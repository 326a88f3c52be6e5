"""`mor-bench cache`: list generated datasets and finished fits, and delete them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import Json
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.report.number_format import bytes_text
from mor_bench.runs.cache_folder import cache_entries
from mor_bench.snapshots.generate import default_cache

app = typer.Typer(rich_markup_mode=None)


@command(
    app,
    {
        "cache": "List everything in the cache.",
        "cache beam-fine --clean": "Delete the generated samples of one dataset.",
    },
)
def cache(
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Names of datasets and methods. [default: all]", show_default=False),
    ] = None,
    clean: Annotated[
        bool,
        typer.Option("--clean", help="Delete the listed entries. Do not do so during a run."),
    ] = False,
    cache: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Cache folder. [default: the user's]")
    ] = None,
    as_json: Json = False,
) -> None:
    """List the generated datasets and finished fits in the cache with their sizes.

    Everything in the cache can be computed again.
    """
    folder = cache or default_cache()
    with notice_if_slow("Deleting." if clean else "Adding up the sizes."):
        entries = cache_entries(folder, names or [])
        if clean:
            for entry in entries:
                entry.remove()
    total = sum(entry.size_bytes for entry in entries)
    if as_json:
        content = {"folder": str(folder), "cleaned": clean, "size_bytes": total}
        print(json.dumps({**content, "entries": [entry.as_dict() for entry in entries]}, indent=1))
        return
    for entry in entries:
        many = f", {len(entry.folders)} folders" if len(entry.folders) > 1 else ""
        print(
            f"{entry.kind:<8}{entry.name:<32}{bytes_text(entry.size_bytes):>9}  "
            f"{entry.changed:%Y-%m-%d}{many}"
        )
    print(f"{folder}: {bytes_text(total)}{' deleted' if clean else ''}")
