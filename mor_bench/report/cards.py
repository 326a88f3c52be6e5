"""One run, method or dataset in detail, as a title and named facts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic.fields import FieldInfo

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.selection_text import ERROR
from mor_bench.errors import MissingDependencyError
from mor_bench.measure.discretisation_error import measured
from mor_bench.measure.mesh_limit import known_error
from mor_bench.options import allowed_values
from mor_bench.report.entries import dataset_names, verdict_of
from mor_bench.report.number_format import bytes_text, metres, percent, seconds_text
from mor_bench.report.short_names import renamed, short_names
from mor_bench.report.suite_overview import (
    dataset_family,
    dataset_needs,
    method_family,
    method_needs,
)
from mor_bench.results.comparison import Comparison
from mor_bench.runs.file_check import check_file
from mor_bench.snapshots.test_sets import available_sets
from mor_bench.specs import AnyDatasetSpec, DatasetSpec, MethodSpec, tables_of
from mor_bench.specs.parameters import annotated_defaults

UNITS = {"m": "m", "m2": "m²", "pa": "Pa", "n": "N", "s": "s"}
"""Units by the last part of a key."""


@dataclass(frozen=True)
class Card:
    """A thing in detail.

    Attributes
    ----------
    title : str
    facts : dict of str to str
        Facts by name, in reading order.
    hyperparameters : list of list of str
        Name, values in `mor-bench run`, and range of each.
    commands : list of str
        Commands to go on with.
    """

    title: str
    facts: Mapping[str, str]
    hyperparameters: list[list[str]] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return dict(vars(self))


def run_card(comparison: Comparison) -> Card:
    """Describe a run: its verdicts, settings, machine and files."""
    counts = Counter(row.status for row in comparison.rows)
    settings, machine = comparison.settings, comparison.machine
    headlines = comparison.stored_headlines() if comparison.is_compact else _headlines(comparison)
    facts = {}
    for dataset in dataset_names(comparison):
        names = short_names(row for row in comparison.rows if row.dataset == dataset)
        headline = headlines.get(dataset, "no configuration")
        facts[f"verdict on {dataset}"] = renamed(headline, names)
    rows = ", ".join(f"{n} {status}" for status, n in counts.items())
    facts |= {
        "configurations": f"{len(comparison.rows)} ({rows})" if rows else "none",
        "methods": ", ".join(dict.fromkeys(row.method for row in comparison.rows)),
        "settings": _pairs({k: v for k, v in settings.items() if not isinstance(v, dict)}),
        "machine": _machine(machine),
        "commit": str(machine.get("commit", "not recorded")),
        "files": _files(comparison.out),
    }
    commands = [f"mor-bench report {comparison.out}", f"mor-bench report {comparison.out} --wide"]
    if comparison.is_compact:
        facts["files"] += "; no raw samples, so that its tables and its page cannot be made again"
        commands = []
    return Card(f"Run {comparison.out.name}", facts, commands=commands)


def _headlines(comparison: Comparison) -> dict[str, str]:
    """Return the headline of the verdict on each dataset, from the raw samples."""
    comparison.check_samples()  # without them the verdict would be another one
    analysis = analyse(comparison)
    return {
        dataset: verdict_of(analysis, dataset)["headline"]
        for dataset in dataset_names(comparison)
        if verdict_of(analysis, dataset)
    }


def _machine(machine: Mapping[str, Any]) -> str:
    parts = [str(machine.get("processor", "unknown processor"))]
    parts += [f"{machine['cores']} cores"] if "cores" in machine else []
    if isinstance(memory := machine.get("memory_bytes"), int | float):
        parts.append(f"{bytes_text(memory)} of memory")
    return ", ".join(parts)


def _files(folder: Path) -> str:
    files = [path for path in folder.rglob("*") if path.is_file()]
    size = bytes_text(sum(path.stat().st_size for path in files))
    page = "; report.html" if (folder / "report.html").exists() else "; no report.html yet"
    return f"{len(files)} files, {size}, in {folder}{page}"


def method_card(spec: MethodSpec) -> Card:
    """Describe a method: origin, needs, limits and hyperparameters."""
    regime = spec.regime
    facts = {
        "family": method_family(spec),
        "needs": method_needs(spec),
        "built for": regime.says if regime else "",
        "limits": spec.limits.strip(),
        "origin": spec.source,
        "class": spec.surrogate,
        "cost of a fit": _cost_of_fit(spec),
    }
    table: list[list[str]] = []
    if spec.folder is None:  # the class of a third party is not imported here
        try:
            table = _hyperparameters(spec)
        except MissingDependencyError as error:
            facts["hyperparameters"] = str(error)
    name = spec.asked or spec.name
    scene = f"{OBSERVED} --limit 400" if spec.observed else "beam-tiny"
    commands = [f"mor-bench run {scene} -m fem -m {name}", f"mor-bench stress -m {name}"]
    return Card(f"{spec.name} – {spec.title}", _given(facts), table, commands)


OBSERVED = "liver-hex-observed"
"""Dataset of the suite whose methods are given observed displacements."""


def _cost_of_fit(spec: MethodSpec) -> str:
    """Return the time of one core on a dataset of the suite; with both trainings if they differ."""
    quick, own = spec.fit_seconds("quick"), spec.fit_s
    if not quick:
        return ""
    text = f"about {seconds_text(quick)} of one core on "
    text += OBSERVED if spec.observed else "beam-coarse"
    if own == quick:
        return text
    return f"{text} with the profile quick; about {seconds_text(own)} with the profile full" + (
        f" and its {n:,} iterations" if (n := spec.parameters_of("full").get("iterations")) else ""
    )


def _hyperparameters(spec: MethodSpec) -> list[list[str]]:
    """Return a row per hyperparameter: its name, its values in `run`, and its range."""
    rows = []
    swept = spec.sweep_of("quick")
    given = spec.parameters_of("quick")
    for name, (annotation, default) in annotated_defaults(spec.load_class()).items():
        values = swept.get(name, [given.get(name, "" if default is ... else default)])
        allowed = allowed_values(FieldInfo.from_annotation(annotation))
        rows.append([name, ", ".join(map(str, values)), allowed])
    return rows


def dataset_card(spec: AnyDatasetSpec, path: Path, cache: Path | None = None) -> Card:
    """Describe a dataset: mesh, material, loads, split, needs and discretisation error."""
    facts = {
        "family": dataset_family(spec),
        "mesh and samples": check_file(path).partition(", ")[2],
        "needs": dataset_needs(spec),
        "origin": spec.source,
    }
    if isinstance(spec, DatasetSpec):
        loads = spec.loads
        facts |= {
            "geometry": _pairs(spec.geometry.model_dump(mode="json", exclude_none=True)),
            "material": _pairs(spec.material.model_dump(mode="json", exclude_none=True)),
            "loads": f"{loads.simultaneous} at a time, kind "
            + " and ".join(
                f"{table.kind}, {table.magnitude[0]:g} to {table.magnitude[1]:g} {table.unit}"
                for table in tables_of(loads)
            )
            + f", {loads.sampling}"
            if loads
            else "",
            "split": _pairs(spec.split.model_dump(mode="json", exclude_none=True)) if loads else "",
            "named test sets": ", ".join(available_sets(spec)) if loads else "",
            "discretisation error": _discretisation(spec, cache),
        }
    commands = [f"mor-bench run {spec.name}", f"mor-bench pick {spec.name}"]
    return Card(f"{spec.name} – {spec.title}", _given(facts), commands=commands)


def _discretisation(spec: DatasetSpec, cache: Path | None) -> str:
    record = measured(spec, cache)
    if record is None or record.get("error_m") is None:
        return f"not measured; mor-bench refine {spec.name} measures it"
    error_m, relative, at_least = known_error(record)
    if error_m is None:
        return "not known; displacements change more with every refinement"
    least = "at least " if at_least else ""
    size = f"{least}{metres(error_m)} m per degree of freedom"
    return f"{size}, {ERROR} {percent(relative)} % (median)"


def _given(facts: Mapping[str, str]) -> dict[str, str]:
    return {name: text for name, text in facts.items() if text}


def _pairs(content: Mapping[str, Any]) -> str:
    """Format a table of a file in one line, without nested tables."""
    shown = {k: v for k, v in content.items() if not isinstance(v, dict) and v is not None}
    return ", ".join(pair_text(key, value) for key, value in shown.items())


def pair_text(key: str, value: Any) -> str:
    """Format a key and its value; the end of the key is the unit."""
    words, _, last = key.rpartition("_")
    unit = UNITS.get(last) if words else None
    name = words if unit else key
    return f"{name.replace('_', ' ')} {_plain(value)}{f' {unit}' if unit else ''}"


def _plain(value: Any) -> str:
    if isinstance(value, list | tuple):
        return " × ".join(map(_plain, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
