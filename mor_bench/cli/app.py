"""The command `mor-bench`: its subcommands, and how it ends after an error."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from mor_bench.cli.clear_errors import clear_errors, open_streams
from mor_bench.cli.windows_job import end_children_with_this_process

COMMANDS = {
    "run": ("run_command", "Fit, score and time methods on datasets, and write a report."),
    "fit": ("fit_command", "Fit one configuration on a dataset and save the model."),
    "pick": ("result_commands", "Name the fastest configuration that meets a dataset's needs."),
    "report": ("result_commands", "Print tables and draw figures of a finished run again."),
    "list": ("suite_commands", "List the datasets and methods of the suite."),
    "check": ("suite_commands", "Check dataset and method files for errors."),
    "new-method": ("new_method", "Write the files of a new method from a template."),
    "doctor": ("doctor_command", "Show what is installed, and the speed of this machine."),
    "generate": ("data_commands", "Generate the snapshots of a dataset."),
    "refine": ("data_commands", "Measure the discretisation error of a dataset's mesh."),
    "cache": ("cache_command", "List generated datasets and finished fits, or delete them."),
    "stress": ("stress_command", "Try the hard cases on the full-order model and on methods."),
    "export": ("export_commands", "Write samples and results for other programs."),
}
"""Name, file and summary of each command."""


class LazyCommands(TyperGroup):
    """Subcommands; each file is imported only when its command is used."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        file, _ = COMMANDS[cmd_name]
        group = typer.main.get_group(import_module(f"mor_bench.cli.{file}").app)
        return group.commands[cmd_name]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])

    def main(self, *args: Any, **extra: Any) -> Any:
        open_streams()
        end_children_with_this_process()
        with clear_errors():
            return super().main(*args, **extra)

    def invoke(self, ctx: Any) -> Any:
        with clear_errors():  # before Typer catches interrupts
            return super().invoke(ctx)


app = typer.Typer(
    cls=LazyCommands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # Rich would take `[default: …]` in a help text for markup.
)


@app.callback(invoke_without_command=True)
def main(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Compare model-order-reduction methods for hyperelastic solids.

    A comparison gives the error at equal time and the time at equal error.
    """
    if version:
        from mor_bench.version import __version__

        print(__version__)
        raise typer.Exit
