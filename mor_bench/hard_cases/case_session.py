"""The session in which a third party's method is tried on hard cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

from mor_bench.hard_cases.case import Scenes, Subject
from mor_bench.hard_cases.catalogue import CaseResult, attempt, cases_for
from mor_bench.measure.method_session import MethodSession
from mor_bench.sandbox.session import Answer
from mor_bench.specs import MethodSpec


class _Chosen(Answer):
    cases: list[tuple[str, str]]


class _Attempted(Answer):
    result: CaseResult


class CaseSession(MethodSession):
    """A method and the hard cases that concern it."""

    activities: ClassVar[Mapping[str, str]] = {
        **MethodSession.activities,
        "choose_cases": "importing it",
        "attempt": "the case",
    }
    answers: ClassVar[Mapping[str, type[Answer]]] = {
        **MethodSession.answers,
        "choose_cases": _Chosen,
        "attempt": _Attempted,
    }

    def choose_cases(
        self, method: MethodSpec, profile: str, cases: Sequence[str], cache: Path | None
    ) -> dict[str, Any]:
        """Return the names and parts of the cases that concern a method."""
        self._subject = Subject(method, profile, Scenes(cache))
        self._cases = cases_for(self._subject, cases)
        return {"cases": [[case.name, case.part] for case, _ in self._cases]}

    def attempt(self, number: int) -> dict[str, Any]:
        """Try one of the chosen cases, by its place in the list."""
        case, obstacle = self._cases[number]
        return {"result": asdict(attempt(case, self._subject, obstacle))}
