"""`mor-bench export`: samples and results for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

import mor_bench
from mor_bench.cli.console import make_console
from mor_bench.cli.help_texts import command
from mor_bench.cli.option_groups import DatasetName, with_options
from mor_bench.cli.progress_bars import show_progress
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.errors import InvalidInputError
from mor_bench.export.asv_results import export_asv
from mor_bench.export.load_path import export_load_path
from mor_bench.export.npz_file import export_numpy
from mor_bench.export.onnx_file import export_onnx
from mor_bench.export.pvd_files import export_load_path_pvd, export_pvd
from mor_bench.export.vtu_files import PARTS, Part, export_vtu
from mor_bench.options import DataOptions
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.test_sets import SET_NAMES, SetName
from mor_bench.specs import load_dataset_spec

WRITING = "Writing the files."

app = typer.Typer(rich_markup_mode=None)
export = typer.Typer(
    help="Write samples and results for other programs.",
    epilog="mor-bench export COMMAND --help shows the options, examples and exit codes of one.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
app.add_typer(export, name="export")


@command(
    export,
    {
        "export vtu beam-tiny --sample 3 --out vtu": "Write test sample 3.",
        "export vtu beam-tiny --sample 3 --model pod.safetensors --out vtu": "Write the prediction "
        "of a fitted model too.",
    },
)
@with_options
def vtu(
    dataset: DatasetName,
    sample: Annotated[
        int, typer.Option(min=0, help="Number of the sample in its part, counted from 0.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write to.")],
    part: Annotated[
        str, typer.Option(help="train, validation, test, or the name of a test set.")
    ] = "test",
    model: Annotated[
        list[Path] | None,
        typer.Option("--model", metavar="FILE", help="Fitted model; repeat for more."),
    ] = None,
    *,
    options: DataOptions,
) -> None:
    """Write a sample and its predictions as VTU for ParaView."""
    chosen = _part(part)
    data = _load(dataset, options, [name for name in SET_NAMES if name == part])
    with notice_if_slow(WRITING):
        paths = export_vtu(data, sample, out, part=chosen, models=model or [])
    for path in paths:
        print(path)


@command(
    export,
    {
        "export pvd beam-tiny --sample 3 --sample 5 --out two.pvd": "Write two test samples.",
        "export pvd beam-tiny --sample 3 --steps 20 --out path.pvd": "Write the load path of one.",
    },
)
@with_options
def pvd(
    dataset: DatasetName,
    sample: Annotated[
        list[int],
        typer.Option(min=0, help="Number of a sample in its part, from 0; repeat for more."),
    ],
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="PVD file to write. VTU files are written beside it."),
    ],
    part: Annotated[
        str, typer.Option(help="train, validation, test, or the name of a test set.")
    ] = "test",
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Steps of the load path of one test sample, from rest."),
    ] = None,
    *,
    options: DataOptions,
) -> None:
    """Write samples, or the load path of one, as a time series for ParaView."""
    chosen = _part(part)
    if steps is not None and (len(sample) > 1 or part != "test"):
        raise InvalidInputError("`--steps` needs one test sample: give `--sample` once.")
    data = _load(dataset, options, [name for name in SET_NAMES if name == part])
    with notice_if_slow(WRITING):
        if steps is None:
            paths = export_pvd(data, sample, out, part=chosen)
        else:
            paths = export_load_path_pvd(data, sample[0], out, n_steps=steps)
    for path in paths:
        print(path)


@command(
    export,
    {
        "export gif beam-tiny --out path.gif": "Draw the first test sample.",
        "export gif beam-tiny --sample 3 --out path.gif": "Draw test sample 3.",
    },
)
@with_options
def gif(
    dataset: DatasetName,
    out: Annotated[Path, typer.Option(metavar="FILE", help="GIF file to write.")],
    sample: Annotated[
        int, typer.Option(min=0, help="Number of the test sample, counted from 0.")
    ] = 0,
    *,
    options: DataOptions,
) -> None:
    """Write the deformation under the growing load of a test sample as animated GIF.

    The extra `viz` renders the meshes with PyVista; without it, matplotlib draws them.
    """
    data = _load(dataset, options)
    with notice_if_slow(WRITING):
        path = export_load_path(data, sample, out)
    print(path)


@command(
    export,
    {
        "export numpy beam-tiny --out tiny.npz": "Write all samples.",
        "export numpy beam-coarse --limit 500 --out some.npz": "Write the first 500 samples.",
    },
)
@with_options
def numpy(
    dataset: DatasetName,
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="NPZ file to write. A TOML that reads it again is written beside it.",
        ),
    ],
    *,
    options: DataOptions,
) -> None:
    """Write the samples of a dataset as NumPy arrays."""
    data = _load(dataset, options)
    with notice_if_slow(WRITING):
        paths = export_numpy(data, out)
    for path in paths:
        print(path)


@command(
    export,
    {
        "export onnx net.safetensors --out net.onnx": "Write a fitted network.",
        "fit beam-tiny -m umesh-small --out net.safetensors": "Make such a file first.",
    },
)
def onnx(
    model: Annotated[Path, typer.Argument(help="File of a fitted model that has a network.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="ONNX file to write.")],
) -> None:
    """Write a fitted network as ONNX.

    It maps nodal forces (N) to nodal displacements (m).
    """
    with notice_if_slow(WRITING):
        path, difference = export_onnx(model, out)
    print(path)
    compared = (
        "not compared: onnxruntime is not installed"
        if difference is None
        else f"ONNX Runtime's answers agree to {difference:.1e}"
    )
    typer.echo(compared, err=True)


@command(
    export,
    {
        "export asv reports/runs/RUN --out .asv/results": "Write a run under the commit of this "
        "checkout.",
        "export asv RUN_DIR --out .asv/results --commit v1.0": "Write it under another commit.",
    },
)
def asv(
    folder: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="Folder of a run.")],
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder of asv's results; the asv.conf.json of mor-bench uses .asv/results.",
        ),
    ],
    commit: Annotated[
        str | None,
        typer.Option(
            help="Commit of mor-bench that made the run. "
            "[default: HEAD of the checkout in the working folder]"
        ),
    ] = None,
    machine: Annotated[
        str | None,
        typer.Option(
            help=(
                "Name of the machine that made the run. [default: this machine, if it made the run]"
            )
        ),
    ] = None,
) -> None:
    """Write the figures of a comparison for asv.

    The dashboard of asv then shows them over commits.
    """
    with notice_if_slow(WRITING):
        comparison = mor_bench.Comparison.read(folder)
        paths = export_asv(comparison, out, commit=commit, machine=machine)
    for path in paths:
        print(path)


def _part(name: str) -> Part:
    """Return the part of this name; `InvalidInputError` if there is none."""
    known = {part: part for part in PARTS}
    if name not in known:
        raise InvalidInputError(f"`--part` must be {', '.join(known)}; got {name!r}.")
    return known[name]


def _load(dataset: str, options: DataOptions, tests: Sequence[SetName] = ()) -> Dataset:
    """Load a dataset, with a progress bar if it must be generated first."""
    spec = load_dataset_spec(dataset, options.suite)
    with show_progress(make_console(stderr=True)) as listener:
        return load_dataset(
            spec,
            options.limit,
            tests=tests,
            cache=options.cache,
            workers=options.workers,
            progress=partial(listener.generating, spec.name),
        )
