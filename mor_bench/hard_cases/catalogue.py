"""All hard cases, which of them concern a method, and one case tried on one method."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from time import perf_counter
from typing import Any

from mor_bench.errors import MissingDependencyError, OutOfTimeError, UnsupportedSceneError
from mor_bench.hard_cases import mechanics_cases, method_cases, reduction_cases
from mor_bench.hard_cases.case import Case, Outcome, Subject, Verdict, every
from mor_bench.machine import pinned_threads

CASES: tuple[Case, ...] = (*mechanics_cases.CASES, *reduction_cases.CASES, *method_cases.CASES)
"""Every case, in the order in which they are tried."""

CASE_NAMES = tuple(dict.fromkeys(case.name for case in CASES))


@dataclass(frozen=True)
class CaseResult:
    """A case tried on a method.

    Attributes
    ----------
    case, part : str
        The case, and its part if it has several.
    method : str
    expected, happened : str
        The correct behaviour, and what was observed.
    verdict : {"pass", "fall short", "not applicable"}
    measured : dict
        The numbers behind the verdict; None stands for one that is not finite.
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


def cases_for(subject: Subject, names: Sequence[str]) -> list[tuple[Case, str | None]]:
    """Return the named cases that concern a method.

    Each comes with the reason why it cannot be tried, or None.
    """
    wanted = [case for case in CASES if case.name in names]
    try:
        method = subject.fresh()
    except MissingDependencyError as error:
        return [(case, str(error)) for case in wanted if case.concerns is every]
    return [(case, None) for case in wanted if case.concerns(method)]


def attempt(case: Case, subject: Subject, obstacle: str | None) -> CaseResult:
    """Try a case on a method; an exception becomes a verdict.

    Parameters
    ----------
    case : Case
    subject : Subject
    obstacle : str or None
        Why the case cannot be tried, from `cases_for`.
    """
    begun = perf_counter()
    # On one thread answers do not depend on the number of cores, and small scenes are fastest.
    with warnings.catch_warnings(), pinned_threads(1):
        warnings.simplefilter("ignore")
        try:
            reason = obstacle or subject.fresh().supports(subject.data.scene)
            outcome = Outcome("not applicable", reason) if reason else case.examine(subject)
        except (MissingDependencyError, UnsupportedSceneError, OutOfTimeError) as error:
            outcome = Outcome("not applicable", str(error))
        except (Exception, SystemExit) as error:  # foreign code runs here
            outcome = Outcome("fall short", f"crashed with {type(error).__name__}: {error}")
    return CaseResult(
        case.name,
        case.part,
        subject.name,
        case.expected,
        outcome.happened,
        outcome.verdict,
        {name: _for_json(value) for name, value in outcome.measured.items()},
        perf_counter() - begun,
    )


def _for_json(value: Any) -> Any:
    if isinstance(value, list):
        return [_for_json(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value
