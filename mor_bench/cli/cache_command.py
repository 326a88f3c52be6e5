"""`mor-bench cache`: list generated datasets and finished fits, and delete them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mor_bench.cli.option_groups import Json
from mor_bench.runs.cache_folder import cache_entries
from mor_bench.snapshots.generate import default_cache

app = typer.Typer(rich_markup_mode=None)


@app.command()
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
            f"{entry.kind:<8}{entry.name:<32}{entry.size_bytes / 1e6:>10,.1f} MB  "
            f"{entry.changed:%Y-%m-%d}{many}"
        )
    print(f"{folder}: {total / 1e6:,.1f} MB{' deleted' if clean else ''}")
