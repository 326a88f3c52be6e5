"""A run in compact form: results, conclusions, the errors of samples and the latencies of queries.

FOLDER/results.json       as the run wrote it
FOLDER/comparison.json    the same; wordings of sentences follow the code, numbers never change
FOLDER/errors.h5                               errors of samples, latencies of queries, float32

Predictions and loss curves are left out.
"""

from __future__ import annotations

import io
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.draws import Draws, Interval
from mor_bench.analysis.selection import decide
from mor_bench.analysis.selection_text import NO_RUNNER_UP, RUNNER_UP
from mor_bench.analysis.verdict import RULE, Verdict, needs_of
from mor_bench.measure.error_bounds import calibrated
from mor_bench.measure.error_metrics import ERRORS as FIGURES
from mor_bench.measure.error_metrics import SampleErrors, summary
from mor_bench.options import FOLDERS
from mor_bench.results.comparison import Comparison
from mor_bench.results.json_file import without_nan
from mor_bench.results.row import Row
from mor_bench.snapshots.store import write_atomically
from tests.published.stored import content_of

ERRORS = "errors.h5"

LEFT_OUT = (
    "all_threads_ms",
    "gc_ms",
    "used",
    "loss_curve",
    "validation_curve",
    "worst_prediction",
    "worst_reference",
    "worst_forces",
    "middle_prediction",
    "middle_reference",
    "middle_forces",
)
"""Arrays of a configuration that the compact form does not keep."""

PACKED_BYTES = 8192
"""Larger arrays are compressed; for smaller ones the description of the compression is larger."""

KEPT_OF_DATASETS = (
    "test_regions",
    "validation_regions",
    "singular_values",
    "snapshots_norm",
    "points",
    "cells",
    "patch_centres",
)


def compact(run: Path, folder: Path, shown: str) -> None:
    """Write a finished run in compact form; where its texts name its folder, they say `shown`."""
    comparison = Comparison.read(run)
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("results.json", "comparison.json"):
        content = json.loads((run / name).read_text(encoding="utf-8"))
        content.get("settings", {}).pop(FOLDERS, None)
        text = json.dumps(content, indent=None, separators=(",", ":"), allow_nan=False)
        text = text.replace(json.dumps(str(run))[1:-1], shown)
        for option, path in comparison.settings.get(FOLDERS, {}).items():
            if option == "datasets":  # published runs are of the suite's datasets
                continue
            text = text.replace(f" --{option} {json.dumps(shlex.quote(path))[1:-1]}", "")
        write_atomically(folder / name, (text + "\n").encode())
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver="latest") as file:
        for name in comparison.datasets:
            kept = comparison.dataset_arrays(name)
            _write(file.create_group(name), {k: kept[k] for k in KEPT_OF_DATASETS if k in kept})
        for row in comparison.rows:
            if row.ok:
                kept = comparison.samples(row)
                _write(
                    file.require_group(row.dataset).create_group(row.label),
                    {k: v for k, v in kept.items() if k not in LEFT_OUT},
                )
    write_atomically(folder / ERRORS, buffer.getvalue())


def _write(group: h5py.Group, arrays: Mapping[str, NDArray[Any]]) -> None:
    for name, array in arrays.items():
        stored = array.astype(np.float32) if array.dtype == np.float64 else array
        if array.dtype.kind == "i":
            stored = array.astype(np.min_scalar_type(int(array.max(initial=0))))
        packed = {"compression": "gzip", "shuffle": True} if stored.nbytes > PACKED_BYTES else {}
        group.create_dataset(name, data=stored, track_times=False, **packed)


def _intervals(record: Mapping[str, Any]) -> dict[str, Interval]:
    """Return the intervals of a row of comparison.json."""
    found = {k: v for k, v in record.items() if isinstance(v, dict)}
    return {
        k: (inf if v["low"] is None else v["low"], inf if v["high"] is None else v["high"])
        for k, v in found.items()
    }


def verdict_again(comparison: Comparison, analysis: Mapping[str, Any], name: str) -> Verdict:
    """Reach the verdict on a dataset from the rows and the stored intervals."""
    intervals = {r["label"]: _intervals(r) for r in analysis["rows"] if r["dataset"] == name}
    none = np.zeros((0, 1))
    return decide(comparison, name, needs_of(comparison, name), Draws([], none, none, intervals))


AGAIN, EVIDENCE, UNDECIDED = " Time again: ", "Evidence: ", "Cannot be told apart"
UNCHECKED = (EVIDENCE, UNDECIDED)
"""Beginnings of sentences that do not follow from rows and intervals alone."""


def _checked(beside: Sequence[str]) -> list[str]:
    """Return the sentences beside a headline that follow from rows and intervals alone."""
    shown = [line.partition(AGAIN)[0] for line in beside]
    return [line for line in shown if not line.startswith(UNCHECKED)]


def wrong_verdicts(folder: Path) -> Iterator[str]:
    """Reach the verdicts again from the stored rows and intervals; yield each difference."""
    comparison = Comparison.read(folder)
    analysis = content_of("comparison.json", folder)
    for stored in analysis["verdicts"]:
        name = stored["dataset"]
        for record in analysis["rows"]:
            for figure, (low, high) in _intervals(record).items():
                value = inf if record[figure]["value"] is None else record[figure]["value"]
                if record["dataset"] == name and not low <= value <= high:
                    yield f"{record['label']}: {figure} lies outside its interval"
        again = verdict_again(comparison, analysis, name)
        qualified = [row.label for row in again.qualified]
        if qualified != stored["qualified"]:
            yield f"{name}: {qualified} qualify, stated are {stored['qualified']}"
        if again.headline != stored["headline"]:
            yield f"{name}: {again.headline!r} is stated as {stored['headline']!r}"
        if RULE not in stored["beside"]:
            yield f"{name}: the rule is not stated as {RULE!r}"
        if again.summary()["cheapest"] != stored["cheapest"]:
            yield f"{name}: the cheapest is stated as {stored['cheapest']!r}"
        stated, reached = _checked(stored["beside"]), _checked(again.beside)
        yield from (f"{name}: states {line!r}" for line in stated if line not in reached)
        yield from (f"{name}: does not state {line!r}" for line in reached if line not in stated)


class StoredRun(Comparison):
    """A run in compact form, with the errors of its samples."""

    def samples(self, row: Row) -> dict[str, NDArray[Any]]:
        """Read the errors of a row that ran."""
        return self._arrays(f"{row.dataset}/{row.label}")

    def dataset_arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """Read the arrays of a dataset."""
        return self._arrays(name)

    def _arrays(self, name: str) -> dict[str, NDArray[Any]]:
        with h5py.File(self.out / ERRORS, "r") as file:
            found = {k: v[()] for k, v in file[name].items() if isinstance(v, h5py.Dataset)}
        return {k: v.astype(float) if v.dtype == np.float32 else v for k, v in found.items()}


PARTS = {"validation": "validation_relative_l2", "hidden": "hidden_relative_l2"}
"""Arrays of the relative errors on other samples than those of the test set, by part of a row."""


def reword(folder: Path) -> bool:
    """Word headlines, and what is beside them, as the code does now; return whether a text changed.

    Numbers stay. What does not follow from rows and intervals alone is kept as it is stored.
    """
    comparison, path = Comparison.read(folder), folder / "comparison.json"
    analysis = json.loads(path.read_text(encoding="utf-8"))
    for stored in analysis["verdicts"]:
        again = verdict_again(comparison, analysis, stored["dataset"])
        stored["headline"] = again.headline
        stored["beside"] = _reworded(stored["beside"], again.beside)
    text = json.dumps(analysis, indent=None, separators=(",", ":"), allow_nan=False) + "\n"
    changed = text != path.read_text(encoding="utf-8")
    if changed:
        write_atomically(path, text.encode())
    return changed


def _reworded(stored: Sequence[str], again: Sequence[str]) -> list[str]:
    """Take the sentences of `again`, but those on draws, folders and commands from `stored`."""
    kept = {start: [line for line in stored if line.startswith(start)] for start in UNCHECKED}
    command = next((line.partition(AGAIN)[2] for line in stored if AGAIN in line), "")
    lines = []
    for line in again:
        if line.startswith(UNCHECKED):
            lines += kept[EVIDENCE]
        else:
            said, with_command, _ = line.partition(AGAIN)
            lines.append(f"{said}{AGAIN}{command}" if with_command else line)
        if line.startswith((RUNNER_UP.capitalize(), NO_RUNNER_UP)):
            lines += kept[UNDECIDED]
    return lines


def wrong_summaries(folder: Path) -> Iterator[str]:
    """Compare the errors in results.json with those of the samples; yield each difference."""
    run = StoredRun.read(folder)
    for row in run.rows:
        if not row.ok or row.error is None:
            continue
        samples = run.samples(row)
        if len(samples["relative_l2"]) != row.n_test:
            yield f"{row.label}: {len(samples['relative_l2'])} samples of {row.n_test}"
        computed = {"error": summary(SampleErrors(**{name: samples[name] for name in FIGURES}))}
        for part, name in PARTS.items():
            if getattr(row, part) is not None and name not in samples:
                yield f"{row.label}: there are no samples of {part}"
            elif getattr(row, part) is not None:
                computed[part] = _relative(samples[name])
        for part, figures in computed.items():
            for name, value in figures.items():
                said = float(getattr(getattr(row, part), name))
                if not _close(value, said):
                    where = f"{row.dataset}, {row.label}: {name}" + f" of {part}" * (part in PARTS)
                    yield f"{where} is {value:g}, stated as {said:g}"


def wrong_bounds(folder: Path) -> Iterator[str]:
    """Calibrate the bounds of single errors again from the stored samples; yield differences.

    Of the test sets, the samples of the main one are stored.
    """
    run = StoredRun.read(folder)
    for row in run.rows:
        if not row.ok or row.bound is None:
            continue
        samples, where = run.samples(row), f"{row.dataset}, {row.label}"
        patches = run.dataset_arrays(row.dataset)["validation_regions"]
        regions = patches[:, 0] if patches.shape[1] == 1 else patches
        grouped = regions if row.bound.n_groups < row.bound.n else None
        again = calibrated(samples["validation_relative_l2"], grouped, row.bound.level)
        if not _close(again.relative_l2, row.bound.relative_l2):
            yield f"{where}: bound is {again.relative_l2:g}, stated as {row.bound.relative_l2:g}"
        least, most = (
            float((samples["relative_l2"] <= row.bound.relative_l2 * factor).mean())
            for factor in (1 - 1e-6, 1 + 1e-6)
        )
        if not least <= row.bound.coverage.get("test", least) <= most:
            yield f"{where}: {least:g} of the test is covered, stated as {row.bound.coverage}"


def _relative(errors: NDArray[Any]) -> dict[str, float]:
    return {
        "rel_l2_median": float(np.median(errors)),
        "rel_l2_p95": float(np.percentile(errors, 95, method="higher")),
        "rel_l2_max": float(np.max(errors)),
    }


def wrong_conclusions(folder: Path) -> Iterator[str]:
    """Draw all conclusions again from the stored samples; yield each number that differs.

    Of verdicts, labels are compared; see `wrong_verdicts` for their sentences.
    """
    run, stated = StoredRun.read(folder), content_of("comparison.json", folder)
    settings = stated["settings"]
    again = analyse(run, n_resamples=settings["n_resamples"], seed=settings["seed"])
    plain: dict[str, Any] = without_nan(again)
    for verdict in (*plain["verdicts"], *(stated := json.loads(json.dumps(stated)))["verdicts"]):
        for sentences in ("headline", "evidence", "beside"):
            verdict.pop(sentences, None)
    yield from _differences(plain, stated, "")


def _differences(computed: Any, said: Any, where: str) -> Iterator[str]:
    if isinstance(computed, dict) and isinstance(said, dict) and set(computed) == set(said):
        name = said.get("label") or said.get("method") or said.get("dataset")
        where = f"{where} ({name})" if isinstance(name, str) else where
        for key in computed:
            yield from _differences(computed[key], said[key], f"{where}/{key}")
    elif isinstance(computed, list) and isinstance(said, list) and len(computed) == len(said):
        for i, (value, other) in enumerate(zip(computed, said, strict=True)):
            yield from _differences(value, other, f"{where}/{i}")
    elif not _same(computed, said):
        yield f"{where} is {computed}, stated as {said}"


def _same(computed: Any, said: Any) -> bool:
    numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in (computed, said))
    return _close(computed, said) if numbers else bool(computed == said)


def _close(value: float, said: float) -> bool:
    """Return whether two numbers agree up to the single precision of the stored samples."""
    return bool(np.isclose(value, said, rtol=1e-5, atol=1e-12, equal_nan=True))
