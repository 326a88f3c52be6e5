"""What a run leaves on disk, and the `Comparison` that reads it.

OUT/results.json       schema version, machine, rows, learning curves
OUT/results.csv        the same rows, flat
OUT/comparison.json    time at error, error at time, intervals, pairs, whole cost: see `mor_bench.analysis.analyse.analyse`
OUT/samples/*.h5       raw latencies and per-sample errors of each row, singular values of each dataset
OUT/figures/*.png, OUT/report.html
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.frontier import compare
from mor_bench.errors import StoreError
from mor_bench.snapshots.store import write_atomically

if TYPE_CHECKING:
    import pandas as pd

SCHEMA_VERSION = 2
_WHAT_RAN = (
    "dataset",
    "split",
    "method",
    "label",
    "parameters",
    "n_train",
    "n_test",
    "n_dofs",
    "threads",
)
_WHAT_CAME_OUT = (
    "status",
    "reason",
    "n_failed",
    "error",
    "latency_ms",
    "all_threads_ms",
    "throughput",
    "offline_s",
    "memory_bytes",
    "model_bytes",
    "cost",
    "sets",
    "hidden",
    "discretisation_error_m",
)
ROW_KEYS = frozenset([*_WHAT_RAN, *_WHAT_CAME_OUT])
"""What every row of results.json has."""


def label_of(method: str, swept: Mapping[str, Any]) -> str:
    """A configuration's name: the method, and the swept parameters in brackets."""
    inside = ", ".join(f"{key}={value}" for key, value in swept.items())
    return f"{method} [{inside}]" if inside else method


def _plain(value: Any) -> Any:
    """A copy without NaN or infinity, which JSON does not know: they become strings `nan`, `inf`."""
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def _with_numbers(row: dict[str, Any]) -> dict[str, Any]:
    """A row read from JSON with the `nan` and `inf` of its errors as numbers again."""

    def numbers(record: dict[str, Any]) -> dict[str, Any]:
        return {
            name: float(value)
            if isinstance(value, str) and value in ("nan", "inf", "-inf")
            else value
            for name, value in record.items()
        }

    def of_seeds(record: dict[str, Any]) -> dict[str, Any]:
        spread = {name: numbers(value) for name, value in record.items() if isinstance(value, dict)}
        return {
            **record,
            **spread,
            "trainings": [numbers(training) for training in record.get("trainings", [])],
        }

    read: dict[str, Any] = {
        key: row[key] and numbers(row[key])
        for key in ("error", "hidden", "range", "training")
        if key in row
    }
    if row.get("seeds"):
        read["seeds"] = of_seeds(row["seeds"])
    return {
        **row,
        **read,
        "sets": {name: numbers(record) for name, record in row.get("sets", {}).items()},
    }


def _write_json(path: Path, content: Any) -> None:
    write_atomically(path, json.dumps(_plain(content), indent=1, allow_nan=False).encode())


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read what `write_arrays` wrote."""
    with h5py.File(path, "r") as file:
        return {key: np.asarray(file[key][()]) for key in file}


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays to an HDF5 file, atomically."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, track_times=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, buffer.getvalue())


@dataclass
class Comparison:
    """The results of a run.

    Attributes
    ----------
    out : Path
        The run's folder.
    machine : dict
        Processor, cores, versions.
    rows : list of dict
        One per fitted configuration, in the order in which they ran: `dataset`, `split`, `method`, `label`,
        `parameters`, `status` (`ok`, `failed` or `skipped`), `reason`, `n_train`, `n_test`, `n_failed` (test samples
        without a prediction), `n_dofs`, `threads`, `warnings`, and what was measured: `error`; `latency_ms` of single queries
        with the interval `low`, `high` in which a repeated measurement's median is expected, the garbage collector's share
        `gc` and whether it was `stable`; `all_threads_ms`; `throughput` in queries per second by size of the batch;
        `offline_s`; `memory_bytes`, resident at most while fitting and while predicting; `model_bytes`; `cost` per query,
        which no machine changes; `sets`, errors on the named test sets, and of the loads whose error is unusual how many
        are flagged as out of range; `range`, what is usual, with the false alarms in range, see
        `mor_bench.measure.range_flags.Flags`; `hidden`, errors on a test set of fresh draws; `training`, its device, seconds,
        iterations and last losses; `seeds`, with how many seeds it was trained (`n` of those `asked` for), which `failed`, and of
        `mean_dof_m` and `rel_l2_median` median, min, max and std over all; `tuning_s`, what it took of the tuning budget. Of the
        dataset's own mesh against the limit of fine ones `discretisation_error_m` (mean e) and `discretisation_rel_l2`
        (median). None where not measured.
    datasets, methods : dict
        For each its spec, as in its file.
    learning : list of dict
        Learning curves: `dataset`, `method`, `label`, `n_train`, `status`, `reason`, `fit_s`, `error`.
    analysis : dict or None
        The content of comparison.json, once `finish` has written it.
    settings : dict
        Profile, split, limit, threads, budgets and version of the run.
    """

    out: Path
    machine: dict[str, Any]
    rows: list[dict[str, Any]] = field(default_factory=list)
    datasets: dict[str, dict[str, Any]] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    methods: dict[str, dict[str, Any]] = field(default_factory=dict)
    learning: list[dict[str, Any]] = field(default_factory=list)
    analysis: dict[str, Any] | None = field(default=None, repr=False, compare=False)

    @property
    def table(self) -> pd.DataFrame:
        """A row per fitted configuration; nested figures in columns such as ``error.mean_dof_m``."""
        import pandas as pd

        flat = [{**row, "parameters": json.dumps(row["parameters"])} for row in self.rows]
        return pd.json_normalize(flat)

    @property
    def frontier(self) -> dict[str, Any]:
        """Time at error and error at time: the content of comparison.json."""
        return compare(self.rows)

    def _samples_path(self, name: str) -> Path:
        return self.out / "samples" / (re.sub(r"[^\w.=-]+", "-", name).strip("-") + ".h5")

    def put(self, row: dict[str, Any], samples: Mapping[str, NDArray[Any]] | None = None) -> None:
        """Add a row, or replace that of the same configuration, and write everything; raw samples first."""
        if samples:
            write_arrays(self._samples_path(f"{row['dataset']}--{row['label']}"), samples)
        places = [
            i
            for i, other in enumerate(self.rows)
            if (other["dataset"], other["label"]) == (row["dataset"], row["label"])
        ]
        if places:
            self.rows[places[0]] = row
        else:
            self.rows.append(row)
        self.write()

    def add_samples(self, row: Mapping[str, Any], samples: Mapping[str, NDArray[Any]]) -> None:
        """Write more raw samples of a row beside those that are there."""
        write_arrays(
            self._samples_path(f"{row['dataset']}--{row['label']}"),
            {**self.samples(row), **samples},
        )

    def add_dataset(
        self, name: str, spec: dict[str, Any], arrays: Mapping[str, NDArray[Any]]
    ) -> None:
        """Record a dataset: its spec and arrays such as `singular_values` (of the training snapshots)."""
        self.datasets[name] = spec
        write_arrays(self._samples_path(name), arrays)

    def samples(self, row: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        """Raw samples of a row that ran.

        `latency_ms`, `process`, `round` (n_queries,), the last two numbers of the fresh process and of the interleaved round
        that a query was timed in; `mean_dof_m`, `relative_l2`, `max_nodal_m`, `amplitude_m` (n_test,); of the sample
        with the largest finite e `worst_prediction`, `worst_reference`, `worst_forces` (n_nodes, 3); and of a training
        `loss_curve`, `validation_curve` (n_intervals,), evenly spread from its beginning to its end.
        """
        return read_arrays(self._samples_path(f"{row['dataset']}--{row['label']}"))

    def dataset_arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """Arrays of a dataset: `singular_values`, `points` (n_nodes, 3), `cells` (n_cells, 8), `test_regions` (n_test, k)."""
        return read_arrays(self._samples_path(name))

    def finish(self) -> dict[str, Any]:
        """Write everything, and what follows from all rows together, comparison.json; that is returned."""
        from mor_bench.analysis.analyse import analyse

        self.write()
        analysis = analyse(self)
        _write_json(self.out / "comparison.json", analysis)
        self.analysis = analysis
        return analysis

    def write(self) -> None:
        """Write results.json and results.csv, each atomically."""
        self.out.mkdir(parents=True, exist_ok=True)
        parts = ("machine", "settings", "datasets", "methods", "rows", "learning")
        content = {
            "schema_version": SCHEMA_VERSION,
            **{name: getattr(self, name) for name in parts},
        }
        _write_json(self.out / "results.json", content)
        write_atomically(self.out / "results.csv", self.table.to_csv(index=False).encode())

    @classmethod
    def read(cls, out: str | Path) -> Comparison:
        """Read a run's folder.

        Raises
        ------
        StoreError
            If there is no results.json, or it is not valid or of another schema version.
        """
        path = Path(out) / "results.json"
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            version = content["schema_version"]
            if version != SCHEMA_VERSION:
                raise StoreError(
                    f"{path}: schema version {version}; this version of mor-bench reads version {SCHEMA_VERSION}."
                )
            rows = [_with_numbers(row) for row in content["rows"]]
            for row in rows:
                absent = ROW_KEYS - row.keys()
                if absent:
                    raise StoreError(f"{path}: a row lacks {', '.join(sorted(absent))}.")
            learning = [_with_numbers(record) for record in content["learning"]]
            return cls(
                Path(out),
                content["machine"],
                rows,
                content["datasets"],
                content["settings"],
                content["methods"],
                learning,
            )
        except FileNotFoundError:
            raise StoreError(f"{path}: no such file; is {out} the folder of a run?") from None
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise StoreError(f"{path}: not a results file of mor-bench: {error}") from None
