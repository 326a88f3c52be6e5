"""`mor-bench doctor`: what is installed, and how fast this machine is."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated

import typer

from mor_bench.cli.console import console_width
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import Json
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.measure.machine_speed import MachineSpeed
from mor_bench.report.line_wrapping import wrapped
from mor_bench.report.number_format import bytes_text, seconds_text
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


@command(
    app,
    {
        "doctor": "Show versions, sizes, missing extras and the speed of this machine.",
        "doctor --self-test": "Test whether mor-bench works here.",
    },
    {2: "With --self-test: a check failed."},
)
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
    with notice_if_slow("Measuring the speed of this machine; a few samples are solved."):
        found, seconds = Installation.inspect(), plan().seconds
    if as_json:
        print(json.dumps({**found.as_dict(), "default_run_s": seconds}, indent=1))
        return
    width = console_width()
    for line in _lines(found, seconds):
        indent = " " * (len(line) - len(line.lstrip()))
        if len(line) > width:
            lines = wrapped(line.lstrip(), width, f"{indent}  ", first=indent)
            print(*lines, sep="\n")
        else:
            print(line)


def _self_test(as_json: bool) -> None:
    """Print the checks as they end; the exit code is 2 if one fails."""
    done = []
    with notice_if_slow("Testing; this takes about a minute.") as spoken:
        for check in self_test():
            done.append(check)
            if not as_json:
                spoken()
                word = {True: "passed", False: "FAILED", None: "not here"}[check.passed]
                first = f"{check.name:<16}{word:<10}"
                lines = wrapped(check.detail, console_width(), " " * len(first), first=first)
                print(*lines, sep="\n", flush=True)
    if as_json:
        print(json.dumps([asdict(check) for check in done], indent=1))
    require(done)


def _lines(found: Installation, seconds: float) -> Iterator[str]:
    machine = found.machine
    memory = bytes_text(machine["memory_bytes"])
    yield f"{machine['processor']}, {machine['cores']} cores, {memory} of memory"
    yield f"{machine['system']}, Python {machine['python']}"
    yield ""
    yield f"Installed: {len(found.libraries)} libraries, {bytes_text(found.size_bytes)}"
    for library in found.libraries[:SHOWN]:
        yield f"  {library.name} {library.version}: {bytes_text(library.size_bytes)}"
    if "learn" not in found.missing:
        yield f"  PyTorch is built for {f'CUDA {found.cuda}' if found.cuda else 'processors only'}."
    for extra, use in found.missing.items():
        yield f"  The extra `{extra}` is missing: {use}."
    yield ""
    yield "Speed, on one thread (less is better, except bandwidth):"
    yield from _speeds(found)
    yield ""
    yield f"`mor-bench run` is expected to take about {seconds_text(seconds)} here."


def _speeds(found: Installation) -> Iterator[str]:
    """Yield a table of this machine beside the recorded ones, and what their numbers mean."""
    headings = ["here", *(f"({i})" for i, _ in enumerate(found.recorded, start=1))]
    speeds = [found.speed, *(item.speed for item in found.recorded)]
    first = max(map(len, SPEEDS.values()))
    yield f"  {'':<{first}}" + "".join(f"{heading:>8}" for heading in headings)
    for name, title in SPEEDS.items():
        cells = "".join(f"{_shown(speed, name):>8}" for speed in speeds)
        yield f"  {title:<{first}}{cells}"
    for heading, item in zip(headings[1:], found.recorded, strict=True):
        yield f"  {heading} {item.name}"


def _shown(speed: MachineSpeed, name: str) -> str:
    value = getattr(speed, name)
    return "–" if value is None else f"{value:.3g}"
