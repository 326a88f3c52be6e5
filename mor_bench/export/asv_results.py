"""A comparison as result files of asv (airspeed velocity), so that its dashboard shows comparisons over commits.

OUT/benchmarks.json                    what is measured; entries that are not named `comparison.*` are left as they are
OUT/MACHINE/machine.json               left as it is where there is one
OUT/MACHINE/COMMIT-mor-bench-py*.json  the figures of one commit; asv's own are in files of other names

Every figure is lower where it is better, since asv takes an increase for a regression.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import platform
import re
import subprocess
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.machine import describe_machine
from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import write_atomically

VERSION = {"machine": 1, "benchmarks": 2, "results": 2}
"""asv's versions of its three kinds of file."""

GROUP = "comparison"
PARAMETERS = ("configuration", "setting")
_STATISTICS = ("ci_99_a", "ci_99_b", "q_25", "q_75", "number", "repeat")
_COLUMNS = ("result", "params", "version", *(f"stats_{name}" for name in _STATISTICS))

Key = tuple[str, ...]
"""Values of `PARAMETERS`, each as Python prints it, which is how asv keeps them."""


@dataclass(frozen=True)
class _Quantity:
    """A figure of a results row: where it stands there, times `factor`, or its inverse."""

    kind: str
    unit: str
    path: tuple[str, str]
    about: str
    factor: float = 1.0
    inverse: bool = False

    def of(self, row: Mapping[str, Any]) -> float | None:
        """The value; NaN if it was not measured, None, which is asv's word for a failure, if it is infinite."""
        found = (row.get(self.path[0]) or {}).get(self.path[1])
        if found is None:
            return math.nan
        value = 1 / found if self.inverse else self.factor * found
        return value if math.isfinite(value) else None


QUANTITIES: dict[str, _Quantity] = {
    "latency": _Quantity(
        "time", "seconds", ("latency_ms", "median"), "Median latency of a single query.", 1e-3
    ),
    "relative_error": _Quantity(
        "track",
        "relative l2",
        ("error", "rel_l2_median"),
        "Median relative l2 error on the test samples.",
    ),
    "mean_dof_error": _Quantity(
        "track",
        "m",
        ("error", "mean_dof_m"),
        "Mean absolute error per degree of freedom on the test samples.",
    ),
    "fit": _Quantity(
        "time", "seconds", ("offline_s", "fit"), "Fitting, without the generation of the samples."
    ),
    "peak_memory_fit": _Quantity(
        "peakmemory", "bytes", ("memory_bytes", "fit"), "Peak resident memory of fitting."
    ),
    "peak_memory_predict": _Quantity(
        "peakmemory", "bytes", ("memory_bytes", "predict"), "Peak resident memory of queries."
    ),
    **{
        f"query_in_batch_{n}": _Quantity(
            "time",
            "seconds",
            ("throughput", n),
            f"Time per query in batches of {n}: 1 / throughput.",
            inverse=True,
        )
        for n in ("8", "64", "512")
    },
}


def export_asv(
    comparison: Comparison,
    out: str | Path,
    *,
    commit: str | None = None,
    machine: str | None = None,
) -> list[Path]:
    """Write a comparison's figures for one commit into asv's folder of results, beside what is there.

    What the folder holds of other commits, machines, configurations and settings stays; the same configuration in the same
    setting is replaced. A skipped configuration is left out, a failed one is a failure in asv too.

    Parameters
    ----------
    comparison : Comparison
        A setting is its profile and, of each row, split, numbers of training and test samples and threads.
    out : path
        `results_dir` of asv.conf.json; made where there is none.
    commit : str, optional
        Name or hash of the commit of mor-bench that ran the comparison; by default that which is checked out in the
        working folder.
    machine : str, optional
        Name of the machine on the dashboard; by default this machine's, if the comparison ran on it.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    InvalidInputError
        If the working folder is no checkout of mor-bench or has no such commit, the comparison ran on another machine and
        `machine` does not name it, or no row has finished.
    StoreError
        If a file in `out` is not one of asv's, or of another version.
    """
    out = Path(out)
    commit_hash, date = _commit(Path(), commit)
    name = _machine_name(comparison, machine)
    figures = _figures(comparison)
    if not figures:
        raise InvalidInputError(
            f"{comparison.out}: no configuration has finished; there is nothing to export."
        )
    python = ".".join(str(comparison.machine["python"]).split(".")[:2])
    environment = f"mor-bench-py{python}"
    path, machine_path = (
        out / name / f"{commit_hash[:8]}-{environment}.json",
        out / name / "machine.json",
    )
    _read(
        out / "benchmarks.json", "benchmarks"
    )  # so that nothing is written if it cannot be added to
    about = _read(machine_path, "machine") or _about(comparison, name)
    before = _read(path, "results") or {"results": {}, "commit_hash": commit_hash}
    if before["commit_hash"] != commit_hash:
        raise StoreError(
            f"{path}: holds results of commit {before['commit_hash']}, not of {commit_hash}."
        )
    results = dict(before["results"])
    for benchmark, values in figures.items():
        results[benchmark] = _row({**_values(before, benchmark), **values})
    content = {
        "commit_hash": commit_hash,
        "env_name": environment,
        "date": date,
        "params": {
            **{key: value for key, value in about.items() if key != "version"},
            "python": python,
        },
        "python": python,
        "requirements": {},
        "env_vars": {},
        "result_columns": _COLUMNS,
        "results": results,
        "durations": {},
    }
    _write(machine_path, about, "machine")
    _write(path, content, "results")
    return [machine_path, path, describe(out)]


def describe(out: str | Path) -> Path:
    """Name in benchmarks.json every benchmark of comparisons that the folder holds results of.

    asv writes that file anew with only its own benchmarks whenever it runs; what it wrote stays.

    Raises
    ------
    StoreError
        If a file in `out` is not one of asv's, or of another version.
    """
    out = Path(out)
    found = [_read(path, "results") or {} for path in sorted(out.glob("*/*-mor-bench-py*.json"))]
    found.sort(key=lambda content: content["date"])
    parameters: dict[str, list[dict[str, None]]] = {}
    for content in found:
        for benchmark, row in content["results"].items():
            seen = parameters.setdefault(benchmark, [{} for _ in PARAMETERS])
            for values, more in zip(seen, row[_COLUMNS.index("params")], strict=True):
                values.update(dict.fromkeys(more))
    path = out / "benchmarks.json"
    entries = _read(path, "benchmarks") or {}
    entries.update(
        {
            benchmark: _entry(benchmark, [list(values) for values in seen])
            for benchmark, seen in parameters.items()
        }
    )
    _write(path, entries, "benchmarks")
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


def _figures(comparison: Comparison) -> dict[str, dict[Key, tuple[float | None, dict[str, float]]]]:
    """Value and statistics of each benchmark under each key; quantities that no row has are left out."""
    figures: dict[str, dict[Key, tuple[float | None, dict[str, float]]]] = {}
    rows = [row for row in comparison.rows if row["status"] in ("ok", "failed")]
    for row, (name, quantity) in itertools.product(rows, QUANTITIES.items()):
        ok = row["status"] == "ok"
        statistics = _statistics(row) if ok and name == "latency" else {}
        key = repr(row["label"]), repr(_setting(comparison, row))
        figures.setdefault(f"{GROUP}.{row['dataset']}.{name}", {})[key] = (
            (quantity.of(row) if ok else None),
            statistics,
        )
    return {
        name: values
        for name, values in figures.items()
        if any(value is not None and not math.isnan(value) for value, _ in values.values())
    }


def _setting(comparison: Comparison, row: Mapping[str, Any]) -> str:
    profile, threads = comparison.settings.get("profile", ""), row["threads"]
    return f"{profile}, split by {row['split']}, {row['n_train']} + {row['n_test']} samples, {threads} thread{'s' if threads != 1 else ''}"


def _statistics(row: Mapping[str, Any]) -> dict[str, float]:
    """asv's interval of 99 % and quartiles of the median latency, s, as a lognormal variable with the row's interval of 95 % has them."""
    latency = row["latency_ms"]
    low, median, high = (latency.get(name) for name in ("low", "median", "high"))
    if low is None or high is None or not 0 < low <= median <= high:
        return {}
    wider, narrower = 2.5758 / 1.9600, 0.6745 / 1.9600
    limits = {
        "ci_99_a": (low, wider),
        "ci_99_b": (high, wider),
        "q_25": (low, narrower),
        "q_75": (high, narrower),
    }
    return {
        name: 1e-3 * median * (limit / median) ** power for name, (limit, power) in limits.items()
    } | {
        "number": 1,
        "repeat": latency.get("n_queries") or 1,
    }


def _row(values: Mapping[Key, tuple[float | None, Mapping[str, float]]]) -> list[Any]:
    """Figures in asv's order, that of the product of the parameters' values; NaN, asv's word for skipped, where there is none."""
    parameters = [list(dict.fromkeys(column)) for column in zip(*values, strict=True)]
    listed = [values.get(key, (math.nan, {})) for key in itertools.product(*parameters)]
    statistics = [[figures.get(name) for _, figures in listed] for name in _STATISTICS]
    return [
        [value for value, _ in listed],
        parameters,
        "1",
        *(column if any(x is not None for x in column) else None for column in statistics),
    ]


def _values(
    content: Mapping[str, Any], benchmark: str
) -> dict[Key, tuple[float | None, dict[str, float]]]:
    """The inverse of `_row`."""
    if benchmark not in content["results"]:
        return {}
    listed, parameters, _, *columns = content["results"][benchmark]
    values = {}
    for i, key in enumerate(itertools.product(*parameters)):
        figures = {
            name: column[i]
            for name, column in zip(_STATISTICS, columns, strict=True)
            if column and column[i] is not None
        }
        values[key] = listed[i], figures
    return values


def _machine_name(comparison: Comparison, machine: str | None) -> str:
    if machine is None:
        here, there = describe_machine(), comparison.machine
        if any(here[name] != there.get(name) for name in ("processor", "cores")):
            raise InvalidInputError(
                f"the comparison ran on another machine ({there.get('processor')}, {there.get('cores')} cores); give its name as `machine`."
            )
        machine = platform.node()
    if not re.fullmatch(r"\w[\w.-]*", machine):
        raise InvalidInputError(
            f"`machine` must consist of letters, digits, '.', '-' and '_', and not begin with a mark; got {machine!r}."
        )
    return machine


def _about(comparison: Comparison, name: str) -> dict[str, str]:
    """What asv knows of a machine, as asv writes it, so that both stand under one machine."""
    there, here = comparison.machine, name == platform.node()
    return {
        "arch": platform.machine() if here else "",
        "cpu": str(there["processor"]),
        "machine": name,
        "num_cpu": str(there["cores"]),
        "os": str(there["system"]),
        "ram": _memory() if here else "",
    }


def _memory() -> str:
    try:
        return str(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # Windows has none, others not these names
        return ""


def _commit(folder: Path, commit: str | None) -> tuple[str, int]:
    """Hash of a commit and its date, ms since 1970."""
    top = _git(folder, "rev-parse", "--show-toplevel")
    project = Path(top) / "pyproject.toml" if top else None
    if (
        project is None
        or not project.is_file()
        or tomllib.loads(project.read_text(encoding="utf-8")).get("project", {}).get("name")
        != "mor-bench"
    ):
        raise InvalidInputError(
            f"{folder.resolve()} is in no git checkout of mor-bench, which must hold the commit that ran the comparison."
        )
    found = _git(
        folder,
        "rev-parse",
        "--verify",
        "--quiet",
        "--end-of-options",
        f"{commit or 'HEAD'}^{{commit}}",
    )
    if not found:
        raise InvalidInputError(f"`commit` must name a commit of {top}; got {commit or 'HEAD'!r}.")
    return found, 1000 * int(_git(folder, "show", "-s", "--format=%at", found) or 0)


def _git(folder: Path, *arguments: str) -> str | None:
    """What git prints; None if it fails or is not installed."""
    try:
        return subprocess.run(
            ["git", *arguments],
            cwd=folder,
            check=True,
            capture_output=True,
            text=True,
            encoding="utf-8",
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _read(path: Path, kind: str) -> dict[str, Any] | None:
    """Content of one of asv's files, without its version; None if there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        version = content.pop("version")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"{path}: not a file of asv: {error!r}") from None
    if version != VERSION[kind]:
        raise StoreError(
            f"{path}: asv's {kind} in version {version}; this version of mor-bench knows version {VERSION[kind]}."
        )
    if kind == "results" and not _ours(content):
        raise StoreError(f"{path}: not written by mor-bench.")
    return dict(content)


def _ours(content: Mapping[str, Any]) -> bool:
    named: Iterable[str] = content.get("results") or ()
    known = all(
        name.startswith(f"{GROUP}.") and name.rpartition(".")[2] in QUANTITIES for name in named
    )
    return (
        known
        and content.get("result_columns") == list(_COLUMNS)
        and "commit_hash" in content
        and "date" in content
    )


def _write(path: Path, content: Mapping[str, Any], kind: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({**content, "version": VERSION[kind]}, indent=1).encode())
