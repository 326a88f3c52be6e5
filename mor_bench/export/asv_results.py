"""A comparison as result files of asv (airspeed velocity), whose dashboard shows many commits.

OUT/benchmarks.json                    the benchmarks; asv's own entries are kept
OUT/MACHINE/machine.json               kept if it exists
OUT/MACHINE/COMMIT-mor-bench-py*.json  the figures of one commit, apart from asv's own files

For every figure, lower is better, because asv reports an increase as a regression.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mor_bench.errors import InvalidInputError, StoreError, printable
from mor_bench.export.asv_files import (
    COLUMNS,
    Figure,
    Figures,
    check_results,
    check_texts,
    commit_and_date,
    describe_for_asv,
    from_columns,
    machine_name,
    read_file,
    to_columns,
    write_file,
)
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from mor_bench.specs.base import NAME_PATTERN

GROUP = "comparison"
PARAMETERS = ("configuration", "setting")


@dataclass(frozen=True)
class _Quantity:
    """A figure of a row as a benchmark of asv, multiplied by `factor` or inverted.

    `kind`, `unit` and `about` are asv's texts. `part` and `name` locate the figure in the row.
    """

    kind: str
    unit: str
    part: str
    name: str
    about: str
    factor: float = 1.0
    inverse: bool = False

    def of(self, row: Row) -> float | None:
        """Return the value; NaN if it was not measured, and None (a failure) if it is infinite."""
        part = getattr(row, self.part)
        found = part.get(self.name) if isinstance(part, dict) else getattr(part, self.name, None)
        if found is None:
            return math.nan
        value = 1 / found if self.inverse else self.factor * found
        return value if math.isfinite(value) else None


def _memory(name: str, about: str) -> _Quantity:
    return _Quantity("peakmemory", "bytes", "memory_bytes", name, about)


def _batch(size: str) -> _Quantity:
    about = f"Time per query in batches of {size}: 1 / throughput."
    return _Quantity("time", "seconds", "throughput", size, about, inverse=True)


QUANTITIES = {
    "latency": _Quantity(
        "time", "seconds", "latency_ms", "median", "Median latency of a single query.", 1e-3
    ),
    "relative_error": _Quantity(
        "track",
        "relative l2",
        "error",
        "rel_l2_median",
        "Median relative l2 error on the test samples.",
    ),
    "mean_dof_error": _Quantity(
        "track",
        "m",
        "error",
        "mean_dof_m",
        "Mean absolute error per degree of freedom on the test samples.",
    ),
    "fit": _Quantity(
        "time", "seconds", "offline_s", "fit", "Fitting, without the generation of the samples."
    ),
    "peak_memory_fit": _memory("fit", "Peak resident memory of fitting."),
    "peak_memory_predict": _memory("predict", "Peak resident memory of queries."),
    **{f"query_in_batch_{size}": _batch(size) for size in ("8", "64", "512")},
}
"""Exported figures, by the last part of the benchmark's name."""

_BENCHMARK = re.compile(rf"{GROUP}\.[a-z0-9-]+\.({'|'.join(QUANTITIES)})")


def export_asv(
    comparison: Comparison,
    out: str | Path,
    *,
    commit: str | None = None,
    machine: str | None = None,
) -> list[Path]:
    """Add a comparison's figures for one commit to asv's folder; return the written files.

    Results of the same configuration in the same setting are replaced; others are kept. A skipped
    configuration is left out; a failed one is a failure in asv too.

    Parameters
    ----------
    comparison : Comparison
        A setting is its profile and, for each row, the split, sample counts and threads.
    out : path
        `results_dir` of asv.conf.json; created if it does not exist.
    commit : str, optional
        Name or hash of the commit that ran the comparison. Default: the one that is checked out.
    machine : str, optional
        Name of the machine on the dashboard. Default: this machine, if the comparison ran on it.

    Raises
    ------
    InvalidInputError
        If the working folder is not a checkout of mor-bench or lacks the commit; if no row has
        finished; or if `machine` is not given and the comparison ran on another machine.
    StoreError
        If a file in `out` is not asv's or has another version, if the machine is not recorded, or
        if a text could become markup.
    """
    out = Path(out)
    _check_recorded(comparison)
    commit_hash, date = commit_and_date(commit)
    name = machine_name(comparison.machine, machine)
    figures = _figures(comparison)
    if not figures:
        raise InvalidInputError(
            f"{comparison.out}: no configuration has finished; there is nothing to export."
        )
    python = ".".join(str(comparison.machine["python"]).split(".")[:2])
    environment = f"mor-bench-py{python}"
    path = out / name / f"{commit_hash[:8]}-{environment}.json"
    machine_path = out / name / "machine.json"
    read_file(out / "benchmarks.json", "benchmarks")  # refuse a bad one before writing anything
    about = read_file(machine_path, "machine") or describe_for_asv(comparison.machine, name)
    check_texts(map(str, about.values()), machine_path)
    content = {
        "commit_hash": commit_hash,
        "env_name": environment,
        "date": date,
        "params": {**about, "python": python},
        "python": python,
        "requirements": {},
        "env_vars": {},
        "result_columns": COLUMNS,
        "results": _merged(path, commit_hash, figures),
        "durations": {},
    }
    write_file(machine_path, about, "machine")
    write_file(path, content, "results")
    return [machine_path, path, describe(out)]


def _check_recorded(comparison: Comparison) -> None:
    where = comparison.out / "results.json"
    for name in ("python", "processor", "cores", "system"):
        if not isinstance(comparison.machine.get(name), str | int):
            raise StoreError(f"{comparison.out}: `machine.{name}` of results.json is missing.")
        check_texts([str(comparison.machine[name])], where)
    if not re.fullmatch(r"\d+\.\d+[\w.+-]*", str(comparison.machine["python"])):
        raise StoreError(f"{where}: `machine.python` must be a version.")
    for row in comparison.rows:
        if not re.fullmatch(NAME_PATTERN, row.dataset):
            raise StoreError(f"{where}: a dataset is called {printable(row.dataset, 100, '')!r}.")
        check_texts([row.label, _setting(comparison, row)], where)


def _merged(path: Path, commit_hash: str, figures: Mapping[str, Figures]) -> dict[str, Any]:
    """Merge figures into the results of a file, in asv's columns."""
    before = _read_results(path) or {"results": {}, "commit_hash": commit_hash}
    if before["commit_hash"] != commit_hash:
        raise StoreError(
            f"{path}: holds results of commit {before['commit_hash']}, not of {commit_hash}."
        )
    results = dict(before["results"])
    for benchmark, new in figures.items():
        old = from_columns(results[benchmark]) if benchmark in results else {}
        results[benchmark] = to_columns({**old, **new})
    return results


def describe(out: str | Path) -> Path:
    """List in benchmarks.json every comparison benchmark that has results in the folder.

    When asv runs, it rewrites that file with only its own benchmarks. This function keeps them.

    Raises
    ------
    StoreError
        If a file in `out` is not asv's, or has another version.
    """
    out = Path(out)
    found = [_read_results(path) or {} for path in sorted(out.glob("*/*-mor-bench-py*.json"))]
    found.sort(key=lambda content: content["date"])
    parameters: dict[str, list[dict[str, None]]] = {}
    for content in found:
        for benchmark, row in content["results"].items():
            seen = parameters.setdefault(benchmark, [{} for _ in PARAMETERS])
            for values, more in zip(seen, row[COLUMNS.index("params")], strict=True):
                values.update(dict.fromkeys(more))
    path = out / "benchmarks.json"
    entries = read_file(path, "benchmarks") or {}
    for benchmark, seen in parameters.items():
        entries[benchmark] = _entry(benchmark, [list(values) for values in seen])
    write_file(path, entries, "benchmarks")
    return path


def _entry(benchmark: str, parameters: list[list[str]]) -> dict[str, Any]:
    quantity = QUANTITIES[benchmark.rpartition(".")[2]]
    return {
        "name": benchmark,
        "code": quantity.about,
        "type": quantity.kind,
        "unit": quantity.unit,
        "param_names": list(PARAMETERS),
        "params": parameters,
        "timeout": None,
        "version": "1",
    }


def _read_results(path: Path) -> dict[str, Any] | None:
    """Read a file of results that `export_asv` wrote; None if it does not exist."""
    content = read_file(path, "results")
    if content is not None:
        check_results(content, path)
        for name in content["results"]:
            if not _BENCHMARK.fullmatch(name):
                raise StoreError(f"{path}: {printable(name, 100, '')!r} is not of mor-bench.")
    return content


def _figures(comparison: Comparison) -> dict[str, Figures]:
    """Collect the figures of each benchmark; a benchmark without figures is left out."""
    figures: dict[str, Figures] = {}
    rows = [row for row in comparison.rows if row.status != "skipped"]
    for row, (name, quantity) in itertools.product(rows, QUANTITIES.items()):
        statistics = _statistics(row) if name == "latency" else {}
        key = repr(row.label), repr(_setting(comparison, row))
        figures.setdefault(f"{GROUP}.{row.dataset}.{name}", {})[key] = (
            Figure(quantity.of(row), statistics) if row.ok else Figure(None)
        )
    return {
        name: found
        for name, found in figures.items()
        if any(f.value is not None and not math.isnan(f.value) for f in found.values())
    }


def _setting(comparison: Comparison, row: Row) -> str:
    threads = f"{row.threads} thread{'s' if row.threads != 1 else ''}"
    samples = f"{row.n_train} + {row.n_test} samples"
    return f"{comparison.settings.get('profile', '')}, split by {row.split}, {samples}, {threads}"


def _statistics(row: Row) -> dict[str, float]:
    """asv's 99 % interval and quartiles of the median latency, s.

    They are computed from the row's 95 % interval for a lognormal variable.
    """
    latency = row.latency_ms
    if latency is None or latency.low is None or latency.high is None:
        return {}
    low, median, high = latency.low, latency.median, latency.high
    if not 0 < low <= median <= high:
        return {}
    wider, narrower = 2.5758 / 1.9600, 0.6745 / 1.9600
    return {
        "ci_99_a": 1e-3 * median * (low / median) ** wider,
        "ci_99_b": 1e-3 * median * (high / median) ** wider,
        "q_25": 1e-3 * median * (low / median) ** narrower,
        "q_75": 1e-3 * median * (high / median) ** narrower,
        "number": 1,
        "repeat": latency.n_queries or 1,
    }
