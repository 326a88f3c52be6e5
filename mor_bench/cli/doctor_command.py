"""`mor-bench doctor`: what is installed, and how fast this machine is."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated

import typer

from mor_bench.cli.option_groups import Json
from mor_bench.measure.machine_speed import MachineSpeed
from mor_bench.runs.installation import Installation
from mor_bench.runs.plan import plan
from mor_bench.runs.self_test import require, self_test

app = typer.Typer(rich_markup_mode=None)

SHOWN = 8
"""Number of libraries that are shown, the largest first."""

SPEEDS = {
    "interpreter_ms": "Python loop, ms",
    "residual_us": "residual and tangent, µs",
    "back_solve_us": "back-solve, µs",
    "convolution_ms": "convolution, ms",
    "bandwidth_gb_s": "memory bandwidth, GB/s",
}
"""Names of the measured speeds; of the last one, more is better."""


@app.command()
def doctor(
    test: Annotated[
        bool,
        typer.Option(
            "--self-test",
            help="Instead, test generation, model files, isolation, limits and clean-up.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Show what is installed, its size, missing extras, and the speed of this machine."""
    if test:
        _self_test(as_json)
        return
    found, seconds = Installation.inspect(), plan().seconds
    if as_json:
        print(json.dumps({**found.as_dict(), "default_run_s": seconds}, indent=1))
        return
    for line in _lines(found, seconds):
        print(line)


def _self_test(as_json: bool) -> None:
    """Print the checks as they end; the exit code is 2 if one fails."""
    done = []
    for check in self_test():
        done.append(check)
        if not as_json:
            word = {True: "passed", False: "FAILED", None: "not here"}[check.passed]
            print(f"{check.name:<16}{word:<10}{check.detail}", flush=True)
    if as_json:
        print(json.dumps([asdict(check) for check in done], indent=1))
    require(done)


def _lines(found: Installation, seconds: float) -> Iterator[str]:
    machine = found.machine
    memory = machine["memory_bytes"] / 1e9
    yield f"{machine['processor']}, {machine['cores']} cores, {memory:.0f} GB of memory"
    yield f"{machine['system']}, Python {machine['python']}"
    yield ""
    yield f"Installed: {len(found.libraries)} libraries, {found.size_bytes / 1e6:,.0f} MB"
    for library in found.libraries[:SHOWN]:
        yield f"  {library.name} {library.version}: {library.size_bytes / 1e6:,.0f} MB"
    if "learn" not in found.missing:
        yield f"  PyTorch is built for {f'CUDA {found.cuda}' if found.cuda else 'processors only'}."
    for extra, use in found.missing.items():
        yield f"  The extra `{extra}` is missing: {use}."
    yield ""
    yield "Speed, on one thread (less is better, except bandwidth):"
    columns = ["here", *(item.name for item in found.recorded)]
    speeds = [found.speed, *(item.speed for item in found.recorded)]
    for name, title in SPEEDS.items():
        values = (
            f"{column} {_shown(speed, name)}" for column, speed in zip(columns, speeds, strict=True)
        )
        yield f"  {title}: {'; '.join(values)}"
    for item in found.recorded:
        if item.run_min is not None:
            yield f"  `mor-bench run` took {item.run_min:g} min on {item.name}."
    yield ""
    yield f"`mor-bench run` is expected to take about {seconds / 60:.1f} min here."


def _shown(speed: MachineSpeed, name: str) -> str:
    value = getattr(speed, name)
    return "–" if value is None else f"{value:.3g}"
