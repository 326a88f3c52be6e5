"""Run experiments whose results are published, and store what the pages need.

    python -m tests.published.record quick-start trust/timing.json
    python -m tests.published.record --list

`reports/sources.toml` gives the command of each experiment. In a command, `{out}` is the folder or
file that it writes, and `{cache}` a new empty folder. The evidence goes to `reports/`, with the
command, commit, machine, date and seconds in `run.toml` beside it. Commit all changes before, so
that the commit tells which code ran.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from mor_bench.machine import describe_machine
from mor_bench.snapshots.store import write_atomically
from tests.published.compact import compact
from tests.published.stored import REPORTS, ROOT, EvidenceError, content_of
from tests.verification.trust_record import CODE, git

SOURCES = "reports/sources.toml"


def experiments() -> dict[str, dict[str, Any]]:
    """Return the experiments of sources.toml, by name.

    The name of a run is its folder in `reports/`; that of another experiment is its JSON file.
    """
    return {entry["name"]: entry for entry in content_of(SOURCES)["experiment"]}


def record_of(name: str) -> tuple[Path, str]:
    """Return the `run.toml` of an experiment, and the experiment's key in it."""
    path = REPORTS / name
    return (path.parent / "run.toml", path.name) if path.suffix else (path / "run.toml", "run")


def _toml(content: dict[str, Any]) -> str:
    """Format tables of texts and numbers as TOML."""
    lines = []
    for table, values in content.items():
        lines.append(f'["{table}"]')
        for key, value in values.items():
            text = str(value) if isinstance(value, int | float) else f'"{_escaped(str(value))}"'
            lines.append(f"{key} = {text}")
        lines.append("")
    return "\n".join(lines)


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def record(name: str, allow_changes: bool = False) -> None:
    """Run one experiment and store its evidence.

    Raises
    ------
    EvidenceError
        If the name is unknown, the code has uncommitted changes, or the command fails.
    """
    if name not in experiments():
        raise EvidenceError(f"{SOURCES} has no experiment {name!r}.")
    command = experiments()[name]["command"]
    if git("status", "--porcelain", "--", *CODE) and not allow_changes:
        raise EvidenceError("The code has uncommitted changes; commit them first.")
    path, key = record_of(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    machine, commit = describe_machine(), git("rev-parse", "HEAD")
    begun, date = perf_counter(), datetime.now(UTC)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / ("out" + (REPORTS / name).suffix)
        _run(command, out, Path(folder) / "cache")
        seconds = perf_counter() - begun
        if out.is_dir():
            compact(out, REPORTS / name, f"reports/{name}")
        else:
            write_atomically(REPORTS / name, out.read_bytes())
    content_of.cache_clear()
    known = content_of(path.relative_to(ROOT).as_posix()) if path.is_file() else {}
    facts = {
        "command": command,
        "commit": commit,
        "date": f"{date:%Y-%m-%d %H:%M} UTC",
        "seconds": round(seconds, 1),
        "machine": f"{machine['processor']} ({machine['processor_model']}), "
        f"{machine['cores']} cores, {machine['memory_bytes'] / 2**30:.0f} GiB",
        "load_before": machine["load"][0],
        "python": machine["python"],
    }
    write_atomically(path, _toml({**known, key: facts}).encode())


def _run(command: str, out: Path, cache: Path) -> None:
    """Run a command of this interpreter's environment; it must write `out`."""
    words = [word.format(out=out, cache=cache) for word in shlex.split(command)]
    programs = Path(sys.executable).parent
    words[0] = {"mor-bench": str(programs / "mor-bench"), "python": sys.executable}[words[0]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=ROOT, env=environment, check=False)
    if not out.exists():
        raise EvidenceError(f"`{command}` wrote nothing; exit code {done.returncode}.")


def main(
    names: Annotated[list[str] | None, typer.Argument(help="Names of experiments.")] = None,
    every: Annotated[bool, typer.Option("--list", help="List the experiments.")] = False,
    allow_changes: Annotated[
        bool, typer.Option(help="Also with uncommitted changes, for trials.")
    ] = False,
) -> None:
    """Run experiments of sources.toml and store their evidence."""
    if every:
        for name, entry in experiments().items():
            stored = "stored " if record_of(name)[0].is_file() else "missing"
            print(f"{stored}  about {entry['minutes']:g} min  {name}: {entry['command']}")
    for name in names or []:
        print(f"== {name}", flush=True)
        record(name, allow_changes)


if __name__ == "__main__":
    typer.run(main)
