"""The command line: every command is one call of a public function. Nothing heavy is imported before it is used."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from mor_bench.results.row import Row
    from mor_bench.runs.dataset_run import Listener
    from mor_bench.snapshots.dataset import Dataset
    from mor_bench.snapshots.test_sets import SetName

app = typer.Typer(
    help="Compare model-order-reduction methods for hyperelastic solids: error at equal time, time at equal error.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


SAY_EVERY_S = 10.0
"""Between lines about generation, where there is no terminal to show a bar."""


class ProfileName(StrEnum):
    """Budgets and sweeps of the method files."""

    quick = "quick"
    full = "full"


class DeviceName(StrEnum):
    """Where trainings compute."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class SplitName(StrEnum):
    """How training and test are parted."""

    region = "region"
    sample = "sample"
    direction = "direction"


Suite = Annotated[
    Path | None, typer.Option(help="Folder with datasets/ and methods/ to look in first.")
]
Cache = Annotated[
    Path | None,
    typer.Option(help="Folder for generated datasets. [default: the user's cache folder]"),
]
Limit = Annotated[
    int | None,
    typer.Option(min=1, help="Only the first samples; they cover the load regions evenly."),
]
Workers = Annotated[
    int | None, typer.Option(min=1, help="Processes for data generation. [default: all cores]")
]
TrainingDevice = Annotated[
    DeviceName, typer.Option(help="Of trainings; auto is a CUDA device if there is one.")
]
FitSeconds = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="That each training is sized to, in the place of its number of iterations.",
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Dask scheduler whose workers generate instead: tcp://host:port."
    ),
]


@contextmanager
def _clear_errors() -> Iterator[None]:
    """One line on standard error and exit code 2 for every error that has a name; 130 after an interrupt."""
    from mor_bench.errors import MorBenchError

    try:
        yield
    except MorBenchError as error:
        typer.secho(f"mor-bench: {error}", fg="red", err=True)
        raise typer.Exit(2) from None
    except OSError as error:
        typer.secho(
            f"mor-bench: {error.filename or ''}: {error.strerror or error}", fg="red", err=True
        )
        raise typer.Exit(2) from None
    except KeyboardInterrupt:
        said = "finished samples and rows are kept. A run goes on when it is given the same --out, a training from its last checkpoint."
        typer.secho(f"mor-bench: stopped; {said}", fg="yellow", err=True)
        raise typer.Exit(130) from None


def _console(stderr: bool = False) -> Console:
    """A console as wide as the terminal, or wide enough for every column where there is none."""
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    return Console(stderr=stderr, width=None if stream.isatty() else 120)


@contextmanager
def _progress(console: Console) -> Iterator[Listener]:
    """A bar for generation, with its rate, one for the configurations, and a line for each finished one; a bar for a training, with its loss."""
    from time import perf_counter

    from rich.markup import escape
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from mor_bench.runs.dataset_run import Listener

    texts = TextColumn("{task.description}"), TextColumn("{task.fields[rate]}")
    columns = (
        texts[0],
        BarColumn(),
        MofNCompleteColumn(),
        texts[1],
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bars:
        tasks: dict[str, Any] = {}
        begun: dict[str, tuple[int, float]] = {}
        said: dict[str, tuple[int, float]] = {}

        def generating(dataset: str, done: int, total: int) -> None:
            now = perf_counter()
            if dataset not in tasks:
                # What was there before is no part of the rate, nor of the time left that follows from it.
                tasks[dataset] = bars.add_task(
                    f"samples of {escape(dataset)}", total=total, completed=done, rate=""
                )
                begun[dataset] = said[dataset] = done, now
            before, since = begun[dataset]
            rate = (done - before) / (now - since) if done > before else 0.0
            bars.update(
                tasks[dataset], completed=done, total=total, rate=f"{rate:.1f}/s" if rate else ""
            )
            if (
                rate
                and not console.is_terminal
                and (now - said[dataset][1] >= SAY_EVERY_S or done == total)
            ):
                said[dataset] = done, now
                left = (total - done) / rate
                bars.console.print(
                    f"{dataset}: {done:,} of {total:,} samples, {rate:.1f}/s, {left:.0f} s left",
                    highlight=False,
                    markup=False,
                )

        def starting(dataset: str, label: str, number: int, total: int) -> None:
            if "run" not in tasks:
                tasks["run"] = bars.add_task("", total=total, rate="")
            bars.update(
                tasks["run"], description=escape(f"{dataset}: {label}"), completed=number - 1
            )

        def fitted(row: Row) -> None:
            if row.ok and row.error and row.offline_s:
                text = (
                    f"ē {row.error.mean_dof_m:.2e} m   rel. l2 {row.error.rel_l2_median:.3%}   "
                    f"fit {row.offline_s.fit:.3g} s"
                )
            else:
                text = f"{row.status}: {row.reason}"
            bars.console.print(
                f"[bold]{escape(row.label):<46}[/bold] {escape(text)}", highlight=False
            )

        def timing(dataset: str, done: int, total: int) -> None:
            name = f"timing {dataset}"
            if name not in tasks:
                tasks[name] = bars.add_task(escape(name), total=total, rate="")
                if not console.is_terminal:
                    bars.console.print(
                        f"{dataset}: all fitted; timing them beside each other",
                        highlight=False,
                        markup=False,
                    )
            bars.update(tasks[name], completed=done)

        def training(done: int, total: int, loss: float) -> None:
            now = perf_counter()
            if "training" not in tasks:
                tasks["training"] = bars.add_task("training", total=total, completed=done, rate="")
                said["training"] = done, now
            bars.update(tasks["training"], completed=done, total=total, rate=f"loss {loss:.3g}")
            if not console.is_terminal and now - said["training"][1] >= SAY_EVERY_S:
                said["training"] = done, now
                bars.console.print(
                    f"training: {done:,} of {total:,} iterations, loss {loss:.3g}", highlight=False
                )

        yield Listener(generating, starting, fitted, timing, training=training)


@app.command()
def run(
    datasets: Annotated[
        list[str] | None,
        typer.Argument(help="Names or TOML files. [default: beam-coarse]", show_default=False),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            "-m",
            help="Name or TOML file; repeat for more. [default: the core methods, or those that need no equations]",
        ),
    ] = None,
    profile: Annotated[
        ProfileName, typer.Option(help="Budgets and sweeps of the method files.")
    ] = ProfileName.quick,
    split: Annotated[
        SplitName | None,
        typer.Option(
            help="What the test part has that training has not. [default: as the dataset says]"
        ),
    ] = None,
    limit: Limit = None,
    out: Annotated[
        Path | None, typer.Option(help="Where to write. [default: reports/runs/TIME-DATASETS]")
    ] = None,
    threads: Annotated[
        int, typer.Option(min=1, help="Threads of a prediction; fitting uses all cores.")
    ] = 1,
    workers: Workers = None,
    jobs: Annotated[int, typer.Option(min=1, help="Fits at once, which share the cores.")] = 1,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Dask scheduler whose workers generate and fit: tcp://host:port.",
        ),
    ] = None,
    test_seed: Annotated[
        str | None,
        typer.Option(
            metavar="N|fresh",
            help="Also score on a test set drawn after all fits, by this seed or one that no one knows.",
        ),
    ] = None,
    device: TrainingDevice = DeviceName.cpu,
    fit_seconds: FitSeconds = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Trainings of each configuration of a method with a seed. [default: 1; full: 3]",
        ),
    ] = None,
    time_limit: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Of all fits of a method on a dataset together."),
    ] = None,
    memory_limit: Annotated[
        float | None,
        typer.Option(metavar="GB", help="Of a method's process. [default: 3/4 of the memory]"),
    ] = None,
    retime: Annotated[
        bool, typer.Option("--retime", help="Take timings again that the cache holds.")
    ] = False,
    fail_fast: Annotated[
        bool, typer.Option("--fail-fast", help="End at the first row that fails.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what would run, and how long it would take.")
    ] = False,
    cache: Cache = None,
    suite: Suite = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print results.json to standard output and the rest to standard error."
        ),
    ] = False,
) -> None:
    """Fit, score and time methods on datasets; end with tables, figures and a report."""
    with _clear_errors():
        import mor_bench
        from mor_bench.report import print_tables, render

        console = _console(stderr=as_json)
        if dry_run:
            from mor_bench.report.console_tables import print_plan
            from mor_bench.runs.plan import plan

            planned = plan(
                datasets or ["beam-coarse"],
                method or None,
                profile.value,
                limit=limit,
                split=split.value if split else None,
                threads=threads,
                workers=workers,
                jobs=jobs,
                device=device.value,
                fit_seconds=fit_seconds,
                seeds=seeds,
                cache=cache,
                suite=suite,
            )
            if as_json:
                print(json.dumps(planned.as_dict(), indent=1))
            print_plan(planned, console)
            return
        seed = int(test_seed) if test_seed and test_seed.isdecimal() else test_seed
        with _progress(console) as listener:
            comparison = mor_bench.run(
                datasets or ["beam-coarse"],
                method or None,
                profile.value,
                out,
                limit=limit,
                split=split.value if split else None,
                threads=threads,
                workers=workers,
                jobs=jobs,
                cluster=cluster,
                test_seed=seed,
                device=device.value,
                fit_seconds=fit_seconds,
                seeds=seeds,
                time_limit_s=time_limit,
                memory_limit_bytes=memory_limit and 1e9 * memory_limit,
                retime=retime,
                fail_fast=fail_fast,
                cache=cache,
                suite=suite,
                listener=listener,
            )
        analysis = comparison.analysis
        print_tables(comparison, console, analysis)
        for path in render(comparison, analysis):
            console.print(str(path), highlight=False, soft_wrap=True)
        if as_json:
            print((comparison.out / "results.json").read_text(encoding="utf-8"))
        failed = fail_fast and any(row["status"] == "failed" for row in comparison.rows)
        if failed or not any(row["status"] == "ok" for row in comparison.rows):
            raise typer.Exit(1)


@app.command()
def fit(
    dataset: Annotated[str, typer.Argument(help="Name or TOML file.")],
    method: Annotated[str, typer.Option("--method", "-m", help="Name or TOML file.")],
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Safetensors file to write, or to write over.")
    ],
    knobs: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KNOB=VALUE",
            help="In the place of the file's; repeat for more. [default: as the file says]",
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Of what the method draws at random; the same as --set seed=N."),
    ] = None,
    split: Annotated[
        SplitName | None,
        typer.Option(
            help="What the test part has that training has not. [default: as the dataset says]"
        ),
    ] = None,
    limit: Limit = None,
    device: TrainingDevice = DeviceName.cpu,
    fit_seconds: FitSeconds = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="That a training that was stopped goes on from. [default: .NAME.checkpoint beside --out]",
        ),
    ] = None,
    start_from: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Model of the same method whose weights the training starts from."
        ),
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Of the fit. [default: all cores]")
    ] = None,
    workers: Workers = None,
    cache: Cache = None,
    suite: Suite = None,
) -> None:
    """Fit one configuration on a dataset's training part and save it; a training that was stopped goes on when given the same command."""
    with _clear_errors():
        import mor_bench

        given = {**_knobs(knobs or []), **({} if seed is None else {"seed": seed})}
        with _progress(_console(stderr=True)) as listener:
            fitted = mor_bench.fit(
                dataset,
                method,
                given,
                out=out,
                split=split.value if split else None,
                limit=limit,
                device=device.value,
                fit_seconds=fit_seconds,
                checkpoint=checkpoint,
                start_from=start_from,
                threads=threads,
                workers=workers,
                cache=cache,
                suite=suite,
                listener=listener,
            )
        error = fitted.error
        iterations = "" if fitted.iterations is None else f", {fitted.iterations:,} iterations"
        print(f"fit: {fitted.seconds:.3g} s{iterations}, {fitted.n_train:,} training samples")
        relative = ", ".join(
            f"{name} {error[f'rel_l2_{name}']:.3%}" for name in ("median", "p95", "max")
        )
        print(
            f"test error: ē {error['mean_dof_m']:.2e} m, relative l2 {relative} ({fitted.n_test:,} samples)"
        )
        print(fitted.out)


def _knobs(given: Sequence[str]) -> dict[str, Any]:
    """Values of ``knob=value`` as TOML has them; what is none of its values is text."""
    import tomllib

    from mor_bench.errors import InvalidInputError

    knobs: dict[str, Any] = {}
    for item in given:
        name, equals, value = item.partition("=")
        if not equals or not name.strip():
            raise InvalidInputError(f"`--set` takes KNOB=VALUE; got {item!r}.")
        try:
            knobs[name.strip()] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            knobs[name.strip()] = value.strip()
    return knobs


@app.command(name="list")
def list_(
    suite: Suite = None, as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False
) -> None:
    """List the datasets and methods of the suite."""
    with _clear_errors():
        from mor_bench.specs import list_suite, load_dataset_spec, load_method_spec

        datasets = [
            {"name": name, "title": load_dataset_spec(path).title}
            for name, path in list_suite("datasets", suite).items()
        ]
        methods = [
            {"name": name, "title": load_method_spec(path).title}
            for name, path in list_suite("methods", suite).items()
        ]
        if as_json:
            print(
                json.dumps({"datasets": datasets, "methods": methods}, indent=1, ensure_ascii=False)
            )
            return
        width = max(len(entry["name"]) for entry in [*datasets, *methods])
        for heading, entries in (("Datasets", datasets), ("Methods", methods)):
            print(heading)
            for entry in entries:
                print(f"  {entry['name']:<{width}}  {entry['title']}")


@app.command()
def check(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Dataset or method files. [default: all of the suite]", show_default=False
        ),
    ] = None,
    suite: Suite = None,
) -> None:
    """Validate dataset and method files, down to regions that must not be empty and parameters in range."""
    with _clear_errors():
        from mor_bench.errors import MissingDependencyError, MorBenchError
        from mor_bench.runs.file_check import check_file
        from mor_bench.specs import list_suite

        paths = files or [
            *list_suite("datasets", suite).values(),
            *list_suite("methods", suite).values(),
        ]
        problems = 0
        for path in paths:
            try:
                print(f"{path}: {check_file(path)}")
            except MissingDependencyError as error:
                print(f"{path}: not checked in full: {error}")
            except MorBenchError as error:
                problems += 1
                message = str(error)
                typer.secho(
                    message if message.startswith(str(path)) else f"{path}: {message}",
                    fg="red",
                    err=True,
                )
        if problems:
            raise typer.Exit(2)


@app.command()
def generate(
    dataset: Annotated[str, typer.Argument(help="Name or TOML file.")],
    limit: Limit = None,
    tests: Annotated[
        bool, typer.Option("--tests", help="Also the named test sets that the dataset has.")
    ] = False,
    workers: Workers = None,
    cluster: Cluster = None,
    cache: Cache = None,
    suite: Suite = None,
) -> None:
    """Generate a dataset's snapshots; stop and resume at any moment. Prints its folder, and one for each test set."""
    with _clear_errors():
        from mor_bench.snapshots.generate import generate as generate_shards
        from mor_bench.snapshots.test_sets import with_test_sets
        from mor_bench.specs import load_generated_spec

        spec = load_generated_spec(dataset, suite)
        items = with_test_sets(spec) if tests else [spec]
        with _progress(_console(stderr=True)) as listener:
            folders = [
                generate_shards(
                    item, limit, workers, cache, partial(listener.generating, item.name), cluster
                )
                for item in items
            ]
        print(*folders, sep="\n")


@app.command()
def refine(
    dataset: Annotated[str, typer.Argument(help="Name or TOML file.")],
    loads: Annotated[
        int, typer.Option(help="Samples that are solved, spread over the load patches.")
    ] = 5,
    levels: Annotated[
        int, typer.Option(help="Refinements, each with twice the cells per axis of the one before.")
    ] = 2,
    max_dofs: Annotated[
        int, typer.Option(help="Meshes with more unknowns are left out.")
    ] = 150_000,
    cache: Cache = None,
    suite: Suite = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print the record to standard output and the rest to standard error."
        ),
    ] = False,
) -> None:
    """Measure the error of a dataset's own mesh on refined ones; later runs show it beside the methods' errors."""
    with _clear_errors():
        from threadpoolctl import threadpool_limits

        from mor_bench.measure.discretisation_error import refine as refine_dataset
        from mor_bench.specs import load_generated_spec

        spec = load_generated_spec(dataset, suite)
        with _progress(_console(stderr=True)) as listener, threadpool_limits(1):
            record = refine_dataset(
                spec,
                loads,
                levels,
                max_dofs=max_dofs,
                cache=cache,
                suite=suite,
                progress=lambda done, total: listener.generating(
                    f"{spec.name} on refined meshes", done, total
                ),
            )
        if as_json:
            print(json.dumps(record, indent=1, allow_nan=False))
            return
        from mor_bench.report.console_tables import print_discretisation

        print_discretisation(record, _console())


@app.command()
def report(out: Annotated[Path, typer.Argument(help="Folder of a run.")]) -> None:
    """Print the tables of a finished run and draw its figures and report again."""
    with _clear_errors():
        import mor_bench
        from mor_bench.analysis.analyse import analyse
        from mor_bench.report import print_tables, render

        comparison = mor_bench.Comparison.read(out)
        analysis = analyse(comparison)
        comparison.finish(analysis)
        print_tables(comparison, _console(), analysis)
        for path in render(comparison, analysis):
            print(path)


export_app = typer.Typer(help="Write samples and results for other programs.", no_args_is_help=True)
app.add_typer(export_app, name="export")


@export_app.command(name="vtu")
def export_vtu(
    dataset: Annotated[str, typer.Argument(help="Name or TOML file.")],
    sample: Annotated[int, typer.Option(min=0, help="Number of the sample in its part.")],
    out: Annotated[Path, typer.Option(help="Folder to write to.")],
    part: Annotated[str, typer.Option(help="train, test, or the name of a test set.")] = "test",
    model: Annotated[
        list[Path] | None, typer.Option("--model", help="File of a fitted model; repeat for more.")
    ] = None,
    limit: Limit = None,
    cache: Cache = None,
    suite: Suite = None,
) -> None:
    """Write a sample, and what fitted models predict for it, as VTU for ParaView."""
    with _clear_errors():
        from mor_bench.errors import InvalidInputError
        from mor_bench.export.data import PARTS
        from mor_bench.export.data import export_vtu as write
        from mor_bench.snapshots.test_sets import SET_NAMES

        known = {name: name for name in PARTS}
        if part not in known:
            raise InvalidInputError(f"`--part` must be {', '.join(known)}; got {part!r}.")
        data = _dataset(dataset, limit, cache, suite, [name for name in SET_NAMES if name == part])
        for path in write(data, sample, out, part=known[part], models=model or []):
            print(path)


@export_app.command(name="numpy")
def export_numpy(
    dataset: Annotated[str, typer.Argument(help="Name or TOML file.")],
    out: Annotated[
        Path,
        typer.Option(help="The .npz file to write; a TOML that reads it in again goes beside it."),
    ],
    limit: Limit = None,
    cache: Cache = None,
    suite: Suite = None,
) -> None:
    """Write a dataset's training and test samples as NumPy arrays."""
    with _clear_errors():
        from mor_bench.export.data import export_numpy as write

        for path in write(_dataset(dataset, limit, cache, suite), out):
            print(path)


@export_app.command(name="onnx")
def export_onnx(
    model: Annotated[Path, typer.Argument(help="File of a fitted model that has a network.")],
    out: Annotated[Path, typer.Option(help="The .onnx file to write.")],
) -> None:
    """Write a fitted network, from nodal forces (N) to nodal displacements (m), as ONNX."""
    with _clear_errors():
        from mor_bench.export.data import export_onnx as write

        path, difference = write(model, out)
        print(path)
        compared = (
            "not compared: onnxruntime is not installed"
            if difference is None
            else f"ONNX Runtime's answers agree to {difference:.1e}"
        )
        typer.echo(compared, err=True)


@export_app.command(name="asv")
def export_asv(
    folder: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="Folder of a run.")],
    out: Annotated[
        Path, typer.Option(help="asv's folder of results, by asv.conf.json .asv/results.")
    ],
    commit: Annotated[
        str | None,
        typer.Option(
            help="Commit of mor-bench that ran it. [default: HEAD of the checkout in the working folder]"
        ),
    ] = None,
    machine: Annotated[
        str | None, typer.Option(help="Machine that it ran on. [default: this one, if it is]")
    ] = None,
) -> None:
    """Write a comparison's figures as results of asv, so that its dashboard shows them over commits."""
    with _clear_errors():
        import mor_bench
        from mor_bench.export.asv_results import export_asv as write

        for path in write(mor_bench.Comparison.read(folder), out, commit=commit, machine=machine):
            print(path)


def _dataset(
    dataset: str,
    limit: int | None,
    cache: Path | None,
    suite: Path | None,
    tests: Sequence[SetName] = (),
) -> Dataset:
    """A dataset, with a bar for what must be generated first."""
    from mor_bench.snapshots.dataset import load_dataset
    from mor_bench.specs import load_dataset_spec

    spec = load_dataset_spec(dataset, suite)
    with _progress(_console(stderr=True)) as listener:
        return load_dataset(
            spec,
            limit,
            tests=tests,
            cache=cache,
            progress=lambda done, total: listener.generating(spec.name, done, total),
        )


@app.command()
def pick(
    dataset: Annotated[str, typer.Argument(help="Name or TOML file.")],
    error: Annotated[
        float | None,
        typer.Option(
            help="Relative l2, median over the test set; 0.01 is 1 %. [default: the dataset's need]"
        ),
    ] = None,
    latency: Annotated[
        float | None, typer.Option(help="Of one query, median, ms. [default: the dataset's need]")
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option(
            help="Of the process that predicts, resident at most, MB (1e6 bytes). [default: any]"
        ),
    ] = None,
    offline: Annotated[
        float | None,
        typer.Option(help="Data generation (core-seconds) and fit together, s. [default: any]"),
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the run that is the evidence. [default: the newest finished one, or a new comparison]",
        ),
    ] = None,
    cache: Cache = None,
    suite: Suite = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the choice to standard output as JSON.")
    ] = False,
) -> None:
    """Name the cheapest configuration that meets a dataset's needs, with the evidence; or, with exit code 1, what would have to give."""
    with _clear_errors():
        import mor_bench

        with _progress(_console(stderr=True)) as listener:
            chosen = mor_bench.pick(
                dataset,
                error=error,
                latency_ms=latency,
                memory_bytes=None if memory is None else 1e6 * memory,
                offline_s=offline,
                comparison=run,
                cache=cache,
                suite=suite,
                listener=listener,
            )
        print(
            json.dumps(chosen.as_json(), indent=1, ensure_ascii=False, allow_nan=False)
            if as_json
            else chosen.text()
        )
        if chosen.choice is None:
            raise typer.Exit(1)


@app.command()
def stress(
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method", "-m", help="Name or TOML file; repeat for more. [default: all of the suite]"
        ),
    ] = None,
    case: Annotated[
        list[str] | None,
        typer.Option("--case", help="Name of a hard case; repeat for more. [default: all]"),
    ] = None,
    profile: Annotated[
        ProfileName,
        typer.Option(help="Parameters of the method files; quick also cuts trainings short."),
    ] = ProfileName.quick,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="JSON file to write.")] = None,
    cache: Cache = None,
    suite: Suite = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print JSON to standard output and the rest to standard error."
        ),
    ] = False,
) -> None:
    """Try the hard cases on the full-order model and every method: what is expected, what happened. Falling short is no error."""
    with _clear_errors():
        from rich.status import Status

        from mor_bench.errors import InvalidInputError
        from mor_bench.hard_cases.suite import stress as run_cases
        from mor_bench.report.hard_case_table import print_stress

        if out is not None and not out.resolve().parent.is_dir():
            raise InvalidInputError(f"`--out`: there is no folder {out.resolve().parent}.")
        console = _console(stderr=as_json)
        with Status("", console=console) as status:
            found = run_cases(
                method or None,
                case or None,
                profile.value,
                cache=cache,
                suite=suite,
                starting=lambda name, tried, number, total: status.update(
                    f"{number} of {total}: {name}, {tried}"
                ),
            )
        print_stress(found, console)
        if out is not None:
            found.write(out)
            console.print(str(out), highlight=False, soft_wrap=True)
        if as_json:
            print(json.dumps(found.as_dict(), indent=1, allow_nan=False, ensure_ascii=False))


@app.callback(invoke_without_command=True)
def main(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Compare model-order-reduction methods for hyperelastic solids: error at equal time, time at equal error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(
            stream, TextIOWrapper
        ):  # Windows' encodings of files and pipes lack letters such as ē
            stream.reconfigure(errors="replace")
    if version:
        from mor_bench.version import __version__

        print(__version__)
        sys.exit(0)
