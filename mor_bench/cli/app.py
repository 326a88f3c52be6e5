"""The command `mor-bench`: its subcommands, and how it ends after an error."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import platformdirs
import typer
from typer.core import TyperCommand, TyperGroup

from mor_bench.cli.address_space import check_address_space
from mor_bench.cli.clear_errors import (
    StoppedBySignal,
    clear_errors,
    exit_by_signal,
    open_streams,
)
from mor_bench.cli.clear_warnings import clear_warnings
from mor_bench.cli.windows_job import end_children_with_this_process

COMMANDS = {
    "run": (
        "run_command",
        "Fit, score and time methods on datasets, and write a report.",
        "Compare",
    ),
    "pick": (
        "result_commands",
        "Name the fastest configuration that meets a dataset's needs.",
        "Compare",
    ),
    "report": (
        "result_commands",
        "Print tables and draw figures of a finished run again.",
        "Compare",
    ),
    "list": ("suite_commands", "List the datasets and methods of the suite.", "Look up"),
    "show": ("show_command", "Show one run, method or dataset in detail.", "Look up"),
    "doctor": (
        "doctor_command",
        "Show what is installed, and the speed of this machine.",
        "Look up",
    ),
    "fit": (
        "fit_command",
        "Fit one configuration on a dataset and save the model.",
        "Methods",
    ),
    "new-method": (
        "new_method",
        "Write the files of a new method from a template.",
        "Methods",
    ),
    "check": (
        "suite_commands",
        "Check dataset and method files for errors.",
        "Methods",
    ),
    "stress": (
        "stress_command",
        "Try the hard cases on the full-order model and on methods.",
        "Methods",
    ),
    "generate": ("data_commands", "Generate the snapshots of a dataset.", "Data"),
    "refine": ("data_commands", "Measure the discretisation error of a dataset's mesh.", "Data"),
    "export": ("export_commands", "Write samples and results for other programs.", "Data"),
    "archive": ("archive_command", "Write a dataset for a data repository.", "Data"),
    "cache": (
        "cache_command",
        "List generated datasets and finished fits, or delete them.",
        "Data",
    ),
}
"""Name, file, summary and panel of each command."""

HELP_WIDTH = 100
"""Most characters in a line of a help text."""


class LazyCommands(TyperGroup):
    """Subcommands; each file is imported only when its command is used."""

    completing = False

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = {  # for suggestions, and for completion without imports
            name: TyperCommand(name, help=summary) for name, (_, summary, _) in COMMANDS.items()
        }

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS or self.completing:
            return super().get_command(ctx, cmd_name)
        file, _, _ = COMMANDS[cmd_name]
        group = typer.main.get_group(import_module(f"mor_bench.cli.{file}").app)
        return group.commands[cmd_name]

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        self.completing = True
        return super().shell_complete(ctx, incomplete)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        panels: dict[str, list[tuple[str, str]]] = {}
        for name, (_, summary, panel) in COMMANDS.items():
            panels.setdefault(panel, []).append((name, summary))
        for panel, lines in panels.items():
            with formatter.section(panel):
                formatter.write_dl(lines)

    def main(self, *args: Any, **extra: Any) -> Any:
        open_streams()
        end_children_with_this_process()
        # PyTorch makes this folder for every training, and would leave it among temporary files.
        torch_files = Path(platformdirs.user_cache_dir("mor-bench")) / "torch"
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(torch_files))
        try:
            with clear_errors(), clear_warnings():
                return super().main(*args, **extra)
        except StoppedBySignal as stop:  # it came while the context ended
            exit_by_signal(stop)

    def invoke(self, ctx: Any) -> Any:
        with clear_errors():  # before Typer catches interrupts
            check_address_space()
            return super().invoke(ctx)


app = typer.Typer(
    cls=LazyCommands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # Rich would take `[default: …]` in a help text for markup.
    context_settings={"max_content_width": HELP_WIDTH},
    epilog="mor-bench COMMAND --help shows the options, examples and exit codes of a command.",
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
