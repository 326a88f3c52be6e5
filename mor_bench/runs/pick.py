"""The public `pick`: choose a configuration for a scene, on the evidence of a comparison."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mor_bench.analysis.analyse import verdict_on
from mor_bench.analysis.told import told_at_most
from mor_bench.analysis.verdict import Requirements, Verdict, needs_of
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.results.comparison import Comparison
from mor_bench.runs.compare import run
from mor_bench.runs.listener import Listener
from mor_bench.specs import AnyDatasetSpec, list_suite, load_dataset_spec
from mor_bench.specs.method_spec import Told

__all__ = ["Verdict", "newest_run", "pick", "run_folder"]

RUNS = Path("reports") / "runs"


def pick(
    dataset: str | Path | Mapping[str, Any],
    *,
    comparison: Comparison | str | Path | None = None,
    cache: Path | None = None,
    suite: Path | None = None,
    listener: Listener = Listener(),
    told: Told | None = None,
    **limits: float | None,
) -> Verdict:
    """Choose the fastest configuration that meets a scene's needs, by the rule of every report.

    Parameters
    ----------
    dataset : str, Path or dict
        A name in ``datasets/``, the path of a TOML, or its content. Also the folder of a run of one
        dataset: its stored results are the evidence, and its stored needs the default limits.
    comparison : Comparison or path, optional
        Comparison to choose from, or the folder of a run. By default the newest finished run
        of the dataset under ``reports/runs``. If there is none, `mor_bench.run` compares the
        default methods.
    cache, suite : Path, optional
        Cache folder; folder with ``datasets/`` and ``methods/``.
    listener : Listener
        Callbacks for progress, if a comparison must be run.
    told : Told, optional
        The most that a method may be told at query time. By default all methods take part.
    **limits
        Upper limits, see `mor_bench.analysis.verdict.Requirements`: error and latency_ms, by
        default those of the dataset's ``[needs]``; memory_bytes and offline_s, by default none.

    Raises
    ------
    InvalidInputError
        If a limit is not positive, the comparison does not hold this dataset, or a folder holds
        several.
    SpecError, StoreError
        If the dataset is not valid, or the run's folder cannot be read or lacks raw samples.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> with TemporaryDirectory() as folder:  # doctest: +SKIP
    ...     comparison = mor_bench.run(["beam-tiny"], ["linear-fem"], out=f"{folder}/run")
    ...     verdict = pick("beam-tiny", comparison=comparison, error=0.2, latency_ms=100.0)
    ...     [row.label for row in verdict.qualified]
    ['linear-fem']
    """
    given = {name: limit for name, limit in limits.items() if limit is not None}
    unknown = given.keys() - Requirements.__dataclass_fields__.keys()
    if unknown:
        names = ", ".join(Requirements.__dataclass_fields__)
        raise InvalidInputError(f"unknown limit `{min(unknown)}`; limits: {names}.")
    if (folder := run_folder(dataset, suite)) is not None:
        evidence, name = _stored(folder, comparison)
        requirements = Requirements(**{**needs_of(evidence, name).asked, **given})
    else:
        spec = load_dataset_spec(dataset, suite)
        name, needs = spec.name, {"error": spec.needs.error, "latency_ms": spec.needs.latency_ms}
        requirements = Requirements(**{**needs, **given})
        there = _given(comparison, spec) or newest_run(spec)
        evidence = there or run([dataset], cache=cache, suite=suite, listener=listener)
    evidence.check_samples(name)
    return verdict_on(told_at_most(evidence, told), name, requirements)


def run_folder(source: str | Path | Mapping[str, Any], suite: Path | None = None) -> Path | None:
    """Return the folder of a run, or of one in ``reports/runs``; None if a dataset is meant.

    A dataset of the suite goes before a folder of the same name.
    """
    if not isinstance(source, str | Path):
        return None
    own = list_suite("datasets", suite) if suite is not None else {}
    if str(source) in {**list_suite("datasets"), **own}:
        return None
    for folder in (Path(source), RUNS / source):
        with suppress(OSError):  # a name may be too long for a file
            if (folder / "results.json").is_file():
                return folder
    return None


def _stored(folder: Path, comparison: object) -> tuple[Comparison, str]:
    """Read a run, and name its only dataset."""
    if comparison is not None:
        raise InvalidInputError(
            f"{folder}: the folder of a run is the evidence itself; give the name of its dataset "
            "to use another run."
        )
    evidence = Comparison.read(folder)
    names = list(evidence.datasets)
    if len(names) != 1:
        held = ", ".join(names) or "no dataset"
        raise InvalidInputError(
            f"{folder} has results for {held}; name one: `mor-bench pick DATASET --run {folder}`."
        )
    return evidence, names[0]


def _given(comparison: Comparison | str | Path | None, spec: AnyDatasetSpec) -> Comparison | None:
    """Return the given comparison, which must hold this dataset; None if none is given."""
    if comparison is None:
        return None
    if not isinstance(comparison, Comparison | str | Path):
        raise InvalidInputError(
            "`comparison` must be a Comparison or the folder of a run; "
            f"got {type(comparison).__name__}."
        )
    evidence = comparison if isinstance(comparison, Comparison) else Comparison.read(comparison)
    _check_evidence(evidence, spec)
    return evidence


def _holds(comparison: Comparison, spec: AnyDatasetSpec) -> bool:
    """Return whether a comparison holds this dataset, whatever its title and needs."""
    held = comparison.datasets.get(spec.name)
    return held is not None and _decisive(held) == _decisive(spec.model_dump(mode="json"))


def _decisive(content: Mapping[str, Any]) -> dict[str, Any]:
    shown = {"title", "source", "needs"}
    return {name: value for name, value in content.items() if name not in shown}


def _check_evidence(comparison: Comparison, spec: AnyDatasetSpec) -> None:
    if spec.name not in comparison.datasets:
        held = ", ".join(comparison.datasets) or "nothing"
        raise InvalidInputError(
            f"{comparison.out} has no results for {spec.name}; it has results for {held}."
        )
    if not _holds(comparison, spec):
        raise InvalidInputError(
            f"{comparison.out} has results for another version of {spec.name}: the "
            "dataset's file has changed since the run."
        )


def newest_run(spec: AnyDatasetSpec, runs: Path = RUNS) -> Comparison | None:
    """Return the newest finished run of a dataset in a folder of runs.

    A run of all samples is preferred to others, and a full one to quick ones. comparison.json is
    written when a run ends.
    """
    found: list[tuple[tuple[bool, bool, float], Comparison]] = []
    for file in runs.glob("*/comparison.json"):
        try:
            comparison = Comparison.read(file.parent)
        except StoreError:  # damaged, or of another version
            continue
        ran = any(row.dataset == spec.name and row.ok for row in comparison.rows)
        if _holds(comparison, spec) and ran:
            settings = comparison.settings
            whole, full = settings.get("limit") is None, settings.get("profile") == "full"
            found.append(((whole, full, file.stat().st_mtime), comparison))
    return max(found, key=lambda item: item[0])[1] if found else None
