"""The folder of a run, and the `Comparison` that reads and writes it.

OUT/results.json       schema version, machine, rows, learning curves
OUT/results.csv        the same rows, flat
OUT/comparison.json    conclusions from all rows, see `mor_bench.analysis.analyse.analyse`
OUT/samples/*.h5       raw latencies and per-sample errors of each row, arrays of each dataset
OUT/figures/*.png and *.svg, OUT/report.html, OUT/pages/*.html
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from mor_bench.array_files import read_hdf5
from mor_bench.checked_files import read_json
from mor_bench.errors import StoreError, printable
from mor_bench.results.arrays import write_arrays
from mor_bench.results.json_file import write_json
from mor_bench.results.raw_samples import OF_DATASETS, OF_ROWS, check_arrays
from mor_bench.results.row import LearningPoint, ResultsFile, Row
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs.one_line_errors import validated

if TYPE_CHECKING:
    import pandas as pd

SCHEMA_VERSION = 2

MOST_LETTERS = 10_000
"""Most letters of a text with control characters."""

MOST_ENTRIES = 10_000
"""Most entries of a table or list in results.json, such as rows."""

MOST_STEM = 160
"""Letters of the name of a file with raw samples before it is cut."""


@dataclass
class Comparison:
    """The results of a run.

    Attributes
    ----------
    out : Path
        The run's folder.
    machine : dict
        Processor, cores, versions.
    rows : list of Row
        One per configuration, in the order in which they ran.
    datasets, methods : dict
        Content of each dataset's and each method's file, by name.
    learning : list of LearningPoint
        Learning curves.
    analysis : dict or None
        Content of comparison.json, once `finish` has written it.
    settings : dict
        Profile, split, limit, threads, budgets and version of the run, and `folders`, those that
        its command named.
    """

    out: Path
    machine: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    datasets: dict[str, dict[str, Any]] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    methods: dict[str, dict[str, Any]] = field(default_factory=dict)
    learning: list[LearningPoint] = field(default_factory=list)
    analysis: dict[str, Any] | None = field(default=None, repr=False, compare=False)

    @property
    def table(self) -> pd.DataFrame:
        """A row per configuration; nested figures in columns such as ``error.mean_dof_m``."""
        import pandas as pd

        flat = [row.as_dict() for row in self.rows]
        for row in flat:
            del row["swept"]  # part of the parameters
            row["parameters"] = json.dumps(row["parameters"])
        return pd.json_normalize(flat)

    def put(self, row: Row, samples: Mapping[str, NDArray[Any]] | None = None) -> None:
        """Add or replace a configuration's row and write everything, raw samples first."""
        if samples:
            write_arrays(self.samples_path(row), samples)
        places = [
            place
            for place, other in enumerate(self.rows)
            if (other.dataset, other.label) == (row.dataset, row.label)
        ]
        if places:
            self.rows[places[0]] = row
        else:
            self.rows.append(row)
        self.write()

    def row(self, dataset: str, label: str) -> Row:
        """Return the row of a configuration."""
        return next(row for row in self.rows if (row.dataset, row.label) == (dataset, label))

    def add_samples(self, row: Row, samples: Mapping[str, NDArray[Any]]) -> None:
        """Write further raw samples of a row beside the existing ones."""
        write_arrays(self.samples_path(row), {**self.samples(row), **samples})

    def add_dataset(
        self, name: str, spec: dict[str, Any], arrays: Mapping[str, NDArray[Any]]
    ) -> None:
        """Record a dataset: its file's content, and arrays such as `singular_values`."""
        self.datasets[name] = spec
        write_arrays(self._samples_path(name), arrays)

    def samples(self, row: Row) -> dict[str, NDArray[Any]]:
        """Read the raw samples of a row that ran.

        `latency_ms`, `process`, `round` (n_queries,): latency, fresh process and interleaved round.
        `mean_dof_m`, `relative_l2`, `max_nodal_m`, `amplitude_m` (n_test,): errors.
        `validation_relative_l2` (n_validation,): errors on the validation samples.
        `seeds_relative_l2`, `seeds_validation_relative_l2` (n_seeds - 1, n): of other seeds.
        `worst_prediction`, `worst_reference`, `worst_forces` (n_nodes, 3): the sample with the
        largest finite error.
        `middle_prediction`, `middle_reference`, `middle_forces`: the one with the median
        deformation, the same for all methods.
        `loss_curve`, `validation_curve` (n_intervals,): losses, evenly spread over the training.

        Raises
        ------
        StoreError
            If the file is damaged, or an array has another type, shape or range.
        """
        path = self.samples_path(row)
        arrays, lengths = read_hdf5(path), {"test": row.n_test, "validation": row.n_validation}
        if any(name in arrays for name in ("worst_reference", "middle_reference")):
            with suppress(OSError, KeyError):
                lengths["nodes"] = len(self.dataset_arrays(row.dataset)["points"])
        check_arrays(path, arrays, OF_ROWS, lengths)
        return arrays

    def dataset_arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """Read a dataset's arrays.

        `singular_values` of the training displacements, perhaps the leading ones only, and
        `snapshots_norm`, the Frobenius norm of these displacements; `points` (n_nodes, 3), `cells`
        (n_cells, 8), `test_regions` (n_test, k), `validation_regions` (n_validation, k);
        `patch_centres` (n_patches, 3), m, of generated samples; `n_refused`, the number of samples
        without equilibrium; `test_force_n` (n_test,), the size of each test load's total force, N.

        Raises
        ------
        StoreError
            As `samples`.
        """
        path = self._samples_path(name)
        arrays = read_hdf5(path)
        sizes = {
            (row.n_test, row.n_validation) for row in self.rows if row.ok and row.dataset == name
        }
        lengths = (
            dict(zip(("test", "validation"), sizes.pop(), strict=True)) if len(sizes) == 1 else {}
        )
        check_arrays(path, arrays, OF_DATASETS, lengths)
        return arrays

    @property
    def is_compact(self) -> bool:
        """Whether the folder has the conclusions of a run without its raw samples."""
        return (self.out / "comparison.json").is_file() and not (self.out / "samples").exists()

    def stored_headlines(self) -> dict[str, str]:
        """Read the headline of the verdict on each dataset from comparison.json.

        Raises
        ------
        StoreError
            If comparison.json is damaged.
        """
        path = self.out / "comparison.json"
        try:
            found = read_json(path)["verdicts"]
            return {str(item["dataset"]): printable(str(item["headline"])) for item in found}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise StoreError(f"{path}: not the conclusions of a run ({error}).") from None

    def check_samples(self, dataset: str | None = None) -> None:
        """Check that the raw samples of the rows that ran exist and give the errors of these rows.

        Raises
        ------
        StoreError
            If some are missing or belong to another configuration: intervals and verdicts would be
            unknown or wrong.
        """
        ran = [row for row in self.rows if row.ok and dataset in (None, row.dataset)]
        missing = [path for path in map(self.samples_path, ran) if not path.exists()]
        if missing:
            raise StoreError(
                f"{missing[0]}: no such file. The raw samples of {len(missing)} of {len(ran)} "
                "configurations are missing, so their intervals are not known. Restore the "
                "folder `samples`, or run the comparison again."
                + (f" `mor-bench show {self.out}` has its verdict." if self.is_compact else "")
            )
        for row in ran:
            self._check_samples_of(row)

    def _check_samples_of(self, row: Row) -> None:
        stated, samples = row.error, self.samples(row)
        errors = samples.get("relative_l2", np.zeros(0))
        path = self.samples_path(row)
        if errors.shape != (row.n_test,):
            raise StoreError(
                f"{path}: `relative_l2` must have the shape ({row.n_test},), as {row.label} has "
                f"{row.n_test} test samples; got {errors.shape}."
            )
        if stated is None or not row.n_test:
            return
        figures = [
            ("median of `relative_l2`", np.median(errors), stated.rel_l2_median),
            ("maximum of `relative_l2`", errors.max(), stated.rel_l2_max),
        ]
        if row.latency_ms and len(times := samples.get("latency_ms", np.zeros(0))):
            figures.append(("median of `latency_ms`", np.median(times), row.latency_ms.median))
        for name, value, said in figures:
            if not np.isclose(value, said, rtol=1e-9, equal_nan=True):
                raise StoreError(
                    f"{path}: the {name} is {value:.6g}, but results.json says {said:.6g}. The "
                    "file belongs to another configuration or run."
                )

    def samples_path(self, row: Row) -> Path:
        """Return the file of a row's raw samples."""
        return self._samples_path(f"{row.dataset}--{row.label}")

    def _samples_path(self, name: str) -> Path:
        stem = re.sub(r"[^\w.=-]+", "-", name).strip("-")
        # File systems allow 255 bytes, with the ends of temporary names. Other letters than those
        # of common labels could make the names of two configurations equal.
        if len(stem) > MOST_STEM or re.search(r"[^\w.=\-\[\], ]", name):
            stem = f"{stem[:MOST_STEM]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"
        return self.out / "samples" / f"{stem}.h5"

    def finish(self, analysis: dict[str, Any]) -> None:
        """Write everything; comparison.json with the analysis marks the run as finished."""
        self.write()
        write_json(self.out / "comparison.json", analysis)
        self.analysis = analysis

    def write(self) -> None:
        """Write results.json and results.csv, each atomically."""
        self.out.mkdir(parents=True, exist_ok=True)
        content = {
            "schema_version": SCHEMA_VERSION,
            "machine": self.machine,
            "settings": self.settings,
            "datasets": self.datasets,
            "methods": self.methods,
            "rows": [row.as_dict() for row in self.rows],
            "learning": [point.as_dict() for point in self.learning],
        }
        write_json(self.out / "results.json", content)
        write_atomically(self.out / "results.csv", self.table.to_csv(index=False).encode())

    @classmethod
    def read(cls, out: str | Path) -> Self:
        """Read a run's folder.

        Raises
        ------
        StoreError
            If results.json does not exist, is not valid or has another schema version.
        """
        path = Path(out) / "results.json"
        try:
            content = read_json(path)
            _check_lengths(content)
            content = _without_controls(content)
            version = content["schema_version"]
            if version != SCHEMA_VERSION:
                raise StoreError(
                    f"{path}: schema version {printable(str(version), 50, '')}; "
                    f"this version of mor-bench reads version {SCHEMA_VERSION}."
                )
            file = validated(ResultsFile, content, str(path), error=StoreError)
        except FileNotFoundError:
            raise StoreError(f"{path}: no such file; is {out} the folder of a run?") from None
        except (ValueError, KeyError, TypeError) as error:
            raise StoreError(f"{path}: not a results file of mor-bench: {error}") from None
        return cls(
            Path(out),
            file.machine,
            file.rows,
            file.datasets,
            file.settings,
            file.methods,
            file.learning,
        )


def _check_lengths(value: Any) -> None:
    """Raise `ValueError` for a table or list that no run writes and that would fill the memory."""
    layer = [value]
    while layer:
        layer = [part for part in layer if isinstance(part, dict | list)]
        longest = max(map(len, layer), default=0)
        if longest > MOST_ENTRIES:
            raise ValueError(
                f"a table or list has {longest:,} entries; at most {MOST_ENTRIES:,} are allowed"
            )
        layer = [x for part in layer for x in (part.values() if isinstance(part, dict) else part)]


def _without_controls(value: Any) -> Any:
    """Escape control characters in all texts, which would steer a terminal."""
    if isinstance(value, str):
        return value if value.isprintable() else printable(value, MOST_LETTERS)
    if isinstance(value, dict):
        return {_without_controls(key): _without_controls(item) for key, item in value.items()}
    return [_without_controls(item) for item in value] if isinstance(value, list) else value
