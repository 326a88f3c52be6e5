"""The hard cases: what the full-order model and every method do where simulations usually go wrong."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from math import isfinite
from pathlib import Path
from time import perf_counter
from typing import Any

from mor_bench.errors import (
    InvalidInputError,
    MissingDependencyError,
    MorBenchError,
    OutOfTimeError,
    UnsupportedSceneError,
)
from mor_bench.hard_cases import mechanics_cases, method_cases, reduction_cases
from mor_bench.hard_cases.case import LONGEST, Case, Outcome, Scenes, Subject, Verdict, every
from mor_bench.machine import describe_machine, pinned_threads
from mor_bench.sandbox.process import Worker, default_memory_limit_bytes
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import MethodSpec, check_parameters, list_suite, load_method_spec
from mor_bench.version import __version__

CASES: tuple[Case, ...] = (*mechanics_cases.CASES, *reduction_cases.CASES, *method_cases.CASES)
"""All of them, in the order in which they are tried."""

CASE_NAMES = tuple(dict.fromkeys(case.name for case in CASES))


CASE_S = 300.0
"""Seconds that a third party's method may take for a case."""


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
        write_atomically(
            path,
            (
                json.dumps(self.as_dict(), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
            ).encode(),
        )


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

    A third party's method is tried in a process of its own, so that one that hangs or ends it costs its own rows only.

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
            raise InvalidInputError(
                f"`cases` must be of {', '.join(CASE_NAMES)}; got {name!r}{hint}"
            )
    if methods is not None and (isinstance(methods, str | Path) or not methods):
        raise InvalidInputError(
            f"`methods` must be a list of names or paths, not empty; got {methods!r}."
        )
    scenes = Scenes(cache)
    _ = scenes.tiny  # what keeps it from being read is no method's fault
    wanted = [case.name for case in CASES if not cases or case.name in cases]
    specs = [
        load_method_spec(method, suite)
        for method in (list_suite("methods", suite) if methods is None else methods)
    ]
    with ExitStack() as stack:
        tried = [
            _Here(spec, profile, wanted, scenes)
            if spec.folder is None
            else _Apart(spec, profile, wanted, cache)
            for spec in specs
        ]
        for trial in tried:
            stack.callback(trial.end)
        total = sum(len(trial.cases) for trial in tried)
        if total == 0:
            raise InvalidInputError(
                f"none of the cases {', '.join(cases or ())} concerns {', '.join(spec.name for spec in specs)}."
            )
        rows: list[Row] = []
        for trial in tried:
            for number, (name, part) in enumerate(trial.cases):
                starting(_label(name, part), trial.name, len(rows) + 1, total)
                rows.append(trial.row(number))
                finished(rows[-1])
            trial.end()
    return Stress(rows, profile, describe_machine())


def concerning(subject: Subject, names: Sequence[str]) -> list[tuple[Case, str | None]]:
    """The cases that concern a method, and what is missing to try it."""
    wanted = [case for case in CASES if case.name in names]
    try:
        method = subject.fresh()
    except MissingDependencyError as error:
        return [(case, str(error)) for case in wanted if case.concerns is every]
    return [(case, None) for case in wanted if case.concerns(method)]


class _Here:
    """A method of the suite, tried in this process."""

    def __init__(
        self, spec: MethodSpec, profile: str, names: Sequence[str], scenes: Scenes
    ) -> None:
        self.name = spec.name
        self._subject = Subject(spec, profile, scenes)
        with suppress(MissingDependencyError):
            check_parameters(spec.load_class(), spec.parameters_of(profile), f"method {spec.name}")
        self._concerning = concerning(self._subject, names)
        self.cases = [(case.name, case.part) for case, _ in self._concerning]

    def row(self, number: int) -> Row:
        case, missing = self._concerning[number]
        return attempt(case, self._subject, missing)

    def end(self) -> None:
        """Nothing is held."""


class _Apart:
    """A third party's method, tried in a process of its own, which is started again after a case that ended it."""

    def __init__(
        self, spec: MethodSpec, profile: str, names: Sequence[str], cache: Path | None
    ) -> None:
        self.name = spec.name
        self._spec, self._profile, self._names, self._cache = spec, profile, list(names), cache
        self._worker: Worker | None = None
        self.cases = self._start()

    def _start(self) -> list[tuple[str, str]]:
        self._worker = Worker(None, [], self._spec.folder, default_memory_limit_bytes())
        asked = {
            "method": self._spec,
            "profile": self._profile,
            "cases": self._names,
            "cache": self._cache,
        }
        where = f"method {self._spec.name}"
        self._worker.ask(
            "check",
            CASE_S,
            surrogate=self._spec.surrogate,
            configurations=[self._spec.parameters_of(self._profile)],
            where=where,
        )
        return [(name, part) for name, part in self._worker.ask("stress", CASE_S, **asked)["cases"]]

    def row(self, number: int) -> Row:
        begun = perf_counter()
        name, part = self.cases[number]
        case = next(case for case in CASES if (case.name, case.part) == (name, part))
        try:
            if self._worker is None:
                self._start()
            assert self._worker is not None
            return Row(**self._worker.ask("stress_case", CASE_S, number=number)["row"])
        except MorBenchError as error:
            self.end()
            return Row(
                name,
                part,
                self.name,
                case.expected,
                str(error),
                "fall short",
                {},
                perf_counter() - begun,
            )

    def end(self) -> None:
        """End the process."""
        if self._worker:
            self._worker.end()
            self._worker = None


def _label(name: str, part: str) -> str:
    return f"{name}: {part}" if part else name


def attempt(case: Case, subject: Subject, missing: str | None) -> Row:
    """Try a case on a method, which ``missing`` may say that cannot be had."""
    begun = perf_counter()
    # One thread: on scenes as small as these the fastest, and answers do not depend on the number of cores.
    with warnings.catch_warnings(), pinned_threads(1):
        warnings.simplefilter("ignore")
        try:
            reason = missing or subject.fresh().supports(subject.data.scene)
            outcome = Outcome("not applicable", reason) if reason else case.examine(subject)
        except (MissingDependencyError, UnsupportedSceneError, OutOfTimeError) as error:
            outcome = Outcome("not applicable", str(error))
        except (Exception, SystemExit) as error:  # third parties' code runs here
            outcome = Outcome("fall short", f"crashed with {type(error).__name__}: {error}")
    measured = {name: _for_json(value) for name, value in outcome.measured.items()}
    return Row(
        case.name,
        case.part,
        subject.name,
        case.expected,
        outcome.happened,
        outcome.verdict,
        measured,
        perf_counter() - begun,
    )


def _for_json(value: Any) -> Any:
    if isinstance(value, list):
        return [_for_json(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value
