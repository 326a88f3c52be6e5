"""Try the hard cases on methods, and collect the results."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from pydantic import TypeAdapter

from mor_bench.analysis.told import class_of_method
from mor_bench.checked_files import read_json
from mor_bench.errors import (
    InvalidInputError,
    MissingDependencyError,
    MorBenchError,
    StoreError,
)
from mor_bench.hard_cases.case import LONGEST, Scenes, Subject, Verdict
from mor_bench.hard_cases.case_session import CaseSession
from mor_bench.hard_cases.catalogue import CASE_NAMES, CASES, CaseResult, attempt, cases_for
from mor_bench.machine import describe_machine
from mor_bench.sandbox.process import (
    SandboxedProcess,
    default_memory_limit_bytes,
)
from mor_bench.sandbox.seal import Restrictions
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import MethodSpec, list_suite, load_method_spec
from mor_bench.specs.one_line_errors import nearest_name
from mor_bench.version import __version__

CASE_S = 300.0
"""Time limit for a case of a third party's method, s."""


@dataclass(frozen=True)
class StressResults:
    """The results of the stress suite.

    Attributes
    ----------
    rows : list of CaseResult
    profile : str
    machine : dict
    told : dict
        The information that each method is given, in words; empty in files of earlier versions.
    """

    rows: list[CaseResult]
    profile: str
    machine: dict[str, Any]
    told: dict[str, str] = field(default_factory=dict)

    def count(self, verdict: Verdict) -> int:
        """Count the rows with a verdict."""
        return sum(row.verdict == verdict for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {
            "format": "mor-bench stress",
            "schema_version": 1,
            "version": __version__,
            "profile": self.profile,
            "machine": self.machine,
            "told": self.told,
            "rows": [asdict(row) for row in self.rows],
        }

    @classmethod
    def read(cls, path: Path) -> StressResults:
        """Read what `write` wrote.

        Raises
        ------
        StoreError
            If the file is damaged or something else.
        FileNotFoundError
            If it does not exist.
        """
        content = read_json(path)
        try:
            rows = _ROWS.validate_python(content["rows"])
            told = _TOLD.validate_python(content.get("told", {}))
            return cls(rows, str(content["profile"]), dict(content["machine"]), told)
        except (KeyError, TypeError, ValueError):
            raise StoreError(f"{path}: not written by `mor-bench stress --out`.") from None

    def write(self, path: Path) -> None:
        """Write `as_dict` as JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(self.as_dict(), indent=1, allow_nan=False, ensure_ascii=False)
        write_atomically(path, (text + "\n").encode())


_ROWS = TypeAdapter(list[CaseResult])
_TOLD = TypeAdapter(dict[str, str])


def stress(
    methods: Sequence[str | Path] | None = None,
    cases: Sequence[str] | None = None,
    profile: str = "quick",
    *,
    cache: Path | None = None,
    suite: Path | None = None,
    starting: Callable[[str, str, int, int], None] = lambda *_: None,
) -> StressResults:
    """Try the hard cases on methods. Each verdict is computed, and a crash costs only its own row.

    Methods are tried on beam-tiny with the parameters of their files, without sweeps. A third
    party's method runs in its own process. If it hangs or ends Python, only its own rows fail.

    Parameters
    ----------
    methods : sequence of names or paths of TOML files, optional
        By default all of the suite.
    cases : sequence of str, optional
        Names from `CASE_NAMES`; by default all.
    profile : {"quick", "full"}
        Which parameters of the method files to use; ``quick`` also cuts trainings to `LONGEST`
        iterations.
    cache, suite : Path, optional
        Cache folder of datasets; folder with ``methods/``.
    starting : callable
        Called before each row with (case, method, number of the row, number of rows).

    Raises
    ------
    SpecError
        If a method or a parameter is not valid.
    InvalidInputError
        If an argument is not one of those allowed, or no case concerns any of the methods.
    StoreError, WorkerError
        If beam-tiny cannot be generated or read.
    """
    _check_arguments(methods, cases, profile)
    scenes = Scenes(cache)
    names = [case.name for case in CASES if not cases or case.name in cases]
    specs = [
        load_method_spec(method, suite)
        for method in (list_suite("methods", suite) if methods is None else methods)
    ]
    with ExitStack() as stack:
        trials = [
            _Trial(Subject(spec, profile, scenes), names)
            if spec.folder is None
            else _SandboxedTrial(spec, profile, names, cache)
            for spec in specs
        ]
        for trial in trials:
            stack.callback(trial.end)
        total = sum(len(trial.cases) for trial in trials)
        if total == 0:
            raise InvalidInputError(
                f"none of the cases {', '.join(cases or ())} concerns "
                f"{', '.join(spec.name for spec in specs)}."
            )
        rows: list[CaseResult] = []
        for trial in trials:
            for number, (name, part) in enumerate(trial.cases):
                label = f"{name}: {part}" if part else name
                starting(label, trial.name, len(rows) + 1, total)
                rows.append(trial.result(number))
            trial.end()
    told = {spec.name: class_of_method(spec, profile) for spec in specs}
    return StressResults(rows, profile, describe_machine(), told)


def _check_arguments(
    methods: Sequence[str | Path] | None, cases: Sequence[str] | None, profile: str
) -> None:
    if profile not in LONGEST:
        raise InvalidInputError(f"`profile` must be {' or '.join(LONGEST)}; got {profile!r}.")
    for name in cases or ():
        if name not in CASE_NAMES:
            raise InvalidInputError(
                f"`cases` must be names of {', '.join(CASE_NAMES)}; got {name!r}"
                f"{nearest_name(name, CASE_NAMES)}"
            )
    if methods is not None and (isinstance(methods, str | Path) or not methods):
        raise InvalidInputError(
            f"`methods` must be a non-empty list of names or paths; got {methods!r}."
        )


class _Trial:
    """A method of the suite, tried in this process."""

    def __init__(self, subject: Subject, names: Sequence[str]) -> None:
        self.name = subject.name
        self._subject = subject
        with suppress(MissingDependencyError):
            subject.check_parameters()
        self._cases = cases_for(subject, names)
        self.cases = [(case.name, case.part) for case, _ in self._cases]

    def result(self, number: int) -> CaseResult:
        case, obstacle = self._cases[number]
        return attempt(case, self._subject, obstacle)

    def end(self) -> None:
        """Do nothing, because there is no process to end."""


class _SandboxedTrial:
    """A third party's method, tried in a process of its own.

    The process is restarted after a case that ended it.
    """

    def __init__(
        self, spec: MethodSpec, profile: str, names: Sequence[str], cache: Path | None
    ) -> None:
        self.name = spec.name
        self._spec, self._profile = spec, profile
        self._choice = {"method": spec, "profile": profile, "cases": list(names), "cache": cache}
        self._process: SandboxedProcess | None = None
        self.cases = self._start()

    def _start(self) -> list[tuple[str, str]]:
        """Start a process and return the names and parts of the cases that it will try."""
        restrictions = Restrictions(
            import_from=self._spec.folder, memory_bytes=default_memory_limit_bytes()
        )
        self._process = SandboxedProcess(CaseSession, restrictions)
        self._process.ask(
            "check",
            CASE_S,
            surrogate=self._spec.surrogate,
            configurations=[self._spec.parameters_of(self._profile)],
            where=f"method {self.name}",
        )
        chosen = self._process.ask("choose_cases", CASE_S, **self._choice)["cases"]
        return [(name, part) for name, part in chosen]

    def result(self, number: int) -> CaseResult:
        begun = perf_counter()
        try:
            if self._process is None:
                self._start()
            assert self._process is not None
            return CaseResult(**self._process.ask("attempt", CASE_S, number=number)["result"])
        except MorBenchError as error:
            self.end()
            name, part = self.cases[number]
            case = next(case for case in CASES if (case.name, case.part) == (name, part))
            seconds = perf_counter() - begun
            return CaseResult(
                name, part, self.name, case.expected, str(error), "fall short", {}, seconds
            )

    def end(self) -> None:
        """End the process."""
        if self._process:
            self._process.end()
            self._process = None
