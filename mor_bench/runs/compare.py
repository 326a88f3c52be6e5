"""The public `run`: fit, score and time every configuration of every method on every dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from mor_bench.analysis.analyse import analyse
from mor_bench.errors import InvalidInputError
from mor_bench.measure.method_session import MethodSession
from mor_bench.options import RunOptions
from mor_bench.results.comparison import Comparison
from mor_bench.runs.compilation import compile_kernels
from mor_bench.runs.configurations import checked_specs, configurations_of
from mor_bench.runs.dataset_run import DatasetRun, RunPart
from mor_bench.runs.listener import Listener
from mor_bench.runs.run_context import RunContext
from mor_bench.runs.run_folder import only_run_in, open_run
from mor_bench.runs.timing_stage import StopRunError
from mor_bench.sandbox.fork_server import CAN_FORK, ForkServer
from mor_bench.scratch import scratch_folder
from mor_bench.specs import AnyDatasetSpec, ImportedDatasetSpec


def run(
    datasets: Sequence[str | Path | Mapping[str, Any]] = ("beam-coarse",),
    methods: Sequence[str | Path] | None = None,
    profile: str = "quick",
    out: str | Path | None = None,
    *,
    listener: Listener = Listener(),
    **options: Any,
) -> Comparison:
    """Compare methods on datasets.

    All specifications are checked first. Kernels that this machine has not compiled yet are
    compiled, which counts for no method. Each configuration is fitted in a process of its own,
    which gets the training samples only. Then all are timed side by side in fresh processes.
    The cache keeps fits, scores and timings. A run that was stopped resumes, and another run
    computes only new results. A full comparison also scores named test sets, trains with other
    seeds and draws learning curves. Discretisation errors come from the records that
    `mor_bench.measure.discretisation_error.refine` left; they are not measured here.

    Parameters
    ----------
    datasets, methods : sequences of names or paths of TOML files
        A dataset may also be a dict with the same keys. The default methods are `CORE_METHODS`, or
        `DATA_METHODS` on imported snapshots. With the profile "full" they are all methods of the
        suite. Methods of the option ``suite`` are added.
    profile : {"quick", "full"}
        Profile of the method files, with its sweep and budget.
    out : path, optional
        Folder to write; ``reports/runs/TIME-DATASETS`` by default.
    listener : Listener
        Callbacks for progress.
    **options
        See `mor_bench.options.RunOptions`: limit, split, threads, workers, jobs, cluster,
        test_seed, device, fit_seconds, seeds, time_limit_s, memory_limit_bytes, train, retime,
        fail_fast, cache and suite.

    Raises
    ------
    SpecError
        If a dataset, a method or a parameter is not valid.
    InvalidInputError
        If an option is unknown or out of range, or ``out`` cannot be written or holds another run.
    StoreError
        If the record of a discretisation error is damaged.

    Examples
    --------
    >>> import mor_bench
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:  # doctest: +SKIP
    ...     comparison = mor_bench.run(["beam-tiny"], ["linear-fem"], out=f"{folder}/run")
    ...     [row.label for row in comparison.rows]
    ['linear-fem']
    """
    context = RunContext.of(RunOptions(profile=profile, **options), listener)
    specs, methods_found, _ = checked_specs(datasets, methods, context.options)
    _check_test_seed(context.options.test_seed, specs)
    files = {
        spec.name: str(given)
        for given, spec in zip(datasets, specs, strict=True)
        if not isinstance(given, Mapping) and str(given) != spec.name and Path(given).is_file()
    }
    comparison = open_run(out, specs, methods_found, context, files)
    configurations = configurations_of(methods_found, profile, context.training)
    with only_run_in(comparison.out):
        with ExitStack() as stack:
            fork_server = None
            if CAN_FORK:
                fork_server = ForkServer(MethodSession, passive_wait=True)
                stack.callback(fork_server.close)
            scratch = stack.enter_context(scratch_folder())
            stack.enter_context(suppress(StopRunError))
            for number, spec in enumerate(specs):
                compile_kernels(spec, configurations, context, fork_server, scratch)
                part = RunPart(number, len(specs), scratch / f"{number}", fork_server)
                DatasetRun(spec, configurations, comparison, context, part).run()
        comparison.finish(analyse(comparison))
    return comparison


def _check_test_seed(test_seed: int | str | None, specs: Sequence[AnyDatasetSpec]) -> None:
    if test_seed is None:
        return
    for spec in specs:
        if isinstance(spec, ImportedDatasetSpec):
            raise InvalidInputError(
                f"`test_seed`: no fresh test set can be drawn for {spec.name}, "
                "because its snapshots were imported."
            )
        if test_seed == spec.load_plan.seed:
            raise InvalidInputError(
                f"`test_seed` must differ from the seed of {spec.name}, {spec.load_plan.seed}; "
                f"got {test_seed!r}."
            )
