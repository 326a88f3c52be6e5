"""`mor-bench fit`: fit one configuration, save the model, and print its test error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import typer
from pydantic import Field

import mor_bench
from mor_bench.cli.console import make_console, print_wrapped
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import (
    OUTPUT,
    DatasetName,
    QuietOutput,
    complete_methods,
    with_options,
)
from mor_bench.cli.progress_bars import show_progress
from mor_bench.errors import InvalidInputError
from mor_bench.options import CommandLine, FitOptions
from mor_bench.report.number_format import seconds_text
from mor_bench.specs.inline_parameters import parse_value

app = typer.Typer(rich_markup_mode=None)


class FitOutput(QuietOutput):
    """Output of `mor-bench fit`."""

    panel: ClassVar[str] = OUTPUT

    out: Annotated[
        Path,
        Field(description="Safetensors file to write or to overwrite."),
        CommandLine(metavar="FILE"),
    ]


@command(
    app,
    {
        "fit beam-tiny -m 'pod[n_modes=20]' --out pod.safetensors": "Fit POD with 20 modes.",
        "fit beam-coarse -m umesh --fit-seconds 60 --out net.safetensors": "Train a network "
        "for about a minute.",
    },
)
@with_options
def fit(
    dataset: DatasetName,
    method: Annotated[
        str,
        typer.Option(
            "--method",
            "-m",
            help="Name or TOML file of a method, with values in brackets as in 'pod[n_modes=20]'.",
            autocompletion=complete_methods,
        ),
    ],
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="PARAMETER=VALUE",
            help=(
                "Hyperparameter to change; repeat for more. [default: values of the method file]"
            ),
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed of the method's random draws; the same as --set seed=N."),
    ] = None,
    *,
    options: FitOptions,
    output: FitOutput,
) -> None:
    """Fit one configuration on the training part of a dataset, and save the model.

    Repeat the same command to resume a training that was stopped.
    """
    given = parse_hyperparameters(parameters or [])
    if seed is not None:
        given["seed"] = seed
    with show_progress(make_console(stderr=True), quiet=output.quiet) as listener:
        fitted = mor_bench.fit(
            dataset, method, given, out=output.out, listener=listener, **options.model_dump()
        )
    if output.quiet:
        print(fitted.out)
        return
    error = fitted.error
    iterations = "" if fitted.iterations is None else f", {fitted.iterations:,} iterations"
    for name, values in fitted.first_of.items():
        print_wrapped(
            f"{name} = {values[0]!r}, the first of the {len(values)} values of its sweep; "
            f"choose another one with --set {name}=VALUE"
        )
    seconds = seconds_text(fitted.seconds)
    print(f"fit: {seconds}{iterations}, {fitted.n_train:,} training samples")
    relative = ", ".join(
        f"{name} {error[f'rel_l2_{name}']:.3%}" for name in ("median", "p95", "max")
    )
    print_wrapped(
        f"test error: ē {error['mean_dof_m']:.2e} m, relative L2 error {relative} "
        f"({fitted.n_test:,} samples)"
    )
    print(fitted.out)


def parse_hyperparameters(given: Sequence[str]) -> dict[str, Any]:
    """Read ``name=value`` pairs. A value is written as in TOML; anything else is text.

    >>> parse_hyperparameters(["n_modes=20", "schedule=constant"])
    {'n_modes': 20, 'schedule': 'constant'}
    """
    parsed: dict[str, Any] = {}
    for item in given:
        name, equals, value = item.partition("=")
        if not equals or not name.strip():
            raise InvalidInputError(f"`--set` takes PARAMETER=VALUE; got {item!r}.")
        parsed[name.strip()] = parse_value(value)
    return parsed
