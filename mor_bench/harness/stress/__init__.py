"""The hard cases: what the full-order model and every method do where simulations usually go wrong."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from math import isfinite
from pathlib import Path
from time import perf_counter
from typing import Any

from mor_bench import __version__
from mor_bench.errors import InvalidInputError, MissingDependencyError, UnsupportedSceneError
from mor_bench.harness.stress import mechanics, methods, reduction
from mor_bench.harness.stress.case import LONGEST, Case, Outcome, Scenes, Subject, Verdict, every
from mor_bench.harness.timing import describe_machine, pinned_threads
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import check_parameters, list_suite, load_method_spec

CASES: tuple[Case, ...] = (*mechanics.CASES, *reduction.CASES, *methods.CASES)
"""All of them, in the order in which they are tried."""

CASE_NAMES = tuple(dict.fromkeys(case.name for case in CASES))


@dataclass(frozen=True)
class Row:
    """A case tried on a method.

    Attributes
    ----------
    case, part : str
        The case, and which part of it, if it has several.
    method : str
    expected, happened : str
        The correct behaviour, and what was seen.
    verdict : {"pass", "fall short", "not applicable"}
    measured : dict
        The numbers behind it; one that is not finite is None.
    seconds : float
    """

    case: str
    part: str
    method: str
    expected: str
    happened: str
    verdict: Verdict
    measured: dict[str, Any]
    seconds: float


@dataclass(frozen=True)
class Stress:
    """What came of the hard cases.

    Attributes
    ----------
    rows : list of Row
    profile : str
    machine : dict
    """

    rows: list[Row]
    profile: str
    machine: dict[str, Any]

    def count(self, verdict: Verdict) -> int:
        """How many rows ended so."""
        return sum(row.verdict == verdict for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON can hold it."""
        return {
            "format": "mor-bench stress",
            "schema_version": 1,
            "version": __version__,
            "profile": self.profile,
            "machine": self.machine,
            "rows": [asdict(row) for row in self.rows],
        }

    def write(self, path: Path) -> None:
        """Write `as_dict` as JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, (json.dumps(self.as_dict(), indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode())


def stress(
    methods: Sequence[str | Path] | None = None,
    cases: Sequence[str] | None = None,
    profile: str = "quick",
    *,
    cache: Path | None = None,
    suite: Path | None = None,
    starting: Callable[[str, str, int, int], None] = lambda *_: None,
    finished: Callable[[Row], None] = lambda *_: None,
) -> Stress:
    """Try the hard cases on methods; each outcome is computed and judged, and a crash costs only its own row.

    Methods are tried on beam-tiny with the parameters of their files, none swept.

    Parameters
    ----------
    methods : sequence of names or paths of TOML files, optional
        All of the suite by default.
    cases : sequence of str, optional
        Of `CASE_NAMES`; all by default.
    profile : {"quick", "full"}
        Which parameters of the method files to use. `quick` also cuts trainings to `LONGEST` iterations.
    cache, suite : Path, optional
        Cache folder of datasets; folder with ``methods/``.
    starting : callable
        Told (case, method, number of the row, how many there are) before each row.
    finished : callable
        Told each row.

    Raises
    ------
    SpecError
        If a method or a parameter is not valid.
    InvalidInputError
        If an argument is not one of those allowed.
    StoreError, WorkerError
        If beam-tiny cannot be generated or read.
    """
    if profile not in LONGEST:
        raise InvalidInputError(f"`profile` must be {' or '.join(LONGEST)}; got {profile!r}.")
    for name in cases or ():
        if name not in CASE_NAMES:
            near = get_close_matches(name, CASE_NAMES, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            raise InvalidInputError(f"`cases` must be of {', '.join(CASE_NAMES)}; got {name!r}{hint}")
    scenes = Scenes(cache)
    _ = scenes.tiny  # what keeps it from being read is no method's fault
    wanted = [case for case in CASES if not cases or case.name in cases]
    specs = [load_method_spec(method, suite) for method in (list_suite("methods", suite) if methods is None else methods)]
    plan: list[tuple[Case, Subject, str | None]] = []
    for spec in specs:
        subject = Subject(spec, profile, scenes)
        try:
            check_parameters(spec.load_class(), spec.parameters_of(profile), f"method {spec.name}")
            method = subject.fresh()
        except MissingDependencyError as error:
            plan += [(case, subject, str(error)) for case in wanted if case.concerns is every]
            continue
        plan += [(case, subject, None) for case in wanted if case.concerns(method)]
    # One thread: on scenes as small as these the fastest, and answers do not depend on the number of cores.
    rows: list[Row] = []
    with pinned_threads(1):
        for number, (case, subject, missing) in enumerate(plan):
            starting(_label(case.name, case.part), subject.name, number + 1, len(plan))
            rows.append(_try(case, subject, missing))
            finished(rows[-1])
    return Stress(rows, profile, describe_machine())


def _label(name: str, part: str) -> str:
    return f"{name}: {part}" if part else name


def _try(case: Case, subject: Subject, missing: str | None) -> Row:
    """Try a case on a method, which ``missing`` may say that cannot be had."""
    begun = perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            reason = missing or subject.fresh().supports(subject.data.scene)
            outcome = Outcome("not applicable", reason) if reason else case.examine(subject)
        except (MissingDependencyError, UnsupportedSceneError) as error:
            outcome = Outcome("not applicable", str(error))
        except (Exception, SystemExit) as error:  # third parties' code runs here
            outcome = Outcome("fall short", f"crashed with {type(error).__name__}: {error}")
    measured = {name: _for_json(value) for name, value in outcome.measured.items()}
    return Row(case.name, case.part, subject.name, case.expected, outcome.happened, outcome.verdict, measured, perf_counter() - begun)


def _for_json(value: Any) -> Any:
    if isinstance(value, list):
        return [_for_json(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value
