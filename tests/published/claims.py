"""Numbers in sentences: each is looked up in the evidence, or stated to be no measurement.

`reports/claims.toml` has two kinds of entries. A `[[claim]]` has the text of a page, with `{}` for
each number, and `values` that say where the numbers come from:

    file, key       the evidence, see `stored.look_up`
    over            key of a divisor in the same file
    reduce          "median", "min", "max", "len" or "sum" of a list
    scale           factor
    format          Python's format of the number, such as ".2g"

A `[[stated]]` has texts with numbers that are not measured, and the reason `why`. If a test asserts
the numbers, `by` names its file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tests.published.blocks import BLOCK
from tests.published.stored import ROOT, EvidenceError, content_of, look_up

CLAIMS = "reports/claims.toml"

EVERY_PAGE = "*"

REDUCE: dict[str, Callable[[Any], float]] = {
    "median": np.median,
    "min": np.min,
    "max": np.max,
    "len": len,
    "sum": np.sum,
}

WHYS = ("definition", "setting", "paper", "hardware", "tested")
"""Reasons why a number needs no measurement; `tested` needs `by`."""

_NUMBER = r"[-−]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?|[-−]?\.\d+"

_UNITS = (
    r"core-\w+|ms|µs|s|min|h|seconds?|minutes?|hours?|times|×|%|per cent|[kMG]i?B|bytes|m|cm|mm|"
    r"samples/s|samples per second"
)

_WORDS = (
    "two|three|four|five|six|seven|eight|nine|ten|twelve|fifteen|twenty|thirty|forty|fifty|sixty|"
    "hundred|thousand|half|a third|a quarter|a fifth|a tenth|two thirds|three quarters"
)

MEASURED = re.compile(
    rf"(?<![\w.])(?:(?:{_NUMBER})(?:[-–](?:{_NUMBER}))? ?(?:{_UNITS})(?![\w²³])"
    rf"|[-−]?\d*\.\d+(?:e[-+]?\d+)?|[-−]?\d+e[-+]?\d+|10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+"
    rf"|\d[\d,]* of (?:the )?\d[\d,]*"
    rf"|(?:{_WORDS})(?: \w+)? (?:times|seconds|minutes|hours|per cent)\b"
    rf"|factor of (?:about )?(?:{_WORDS}|\d+))"
)
"""A number that looks like a measurement."""

_NOT_PROSE = (
    re.compile(r"^ *```.*?^ *```", re.DOTALL | re.MULTILINE),
    re.compile(r"^ {4}.*$", re.MULTILINE),
    BLOCK,
    re.compile(r"<!--.*?-->", re.DOTALL),
    re.compile(r"`[^`\n]+`"),
    re.compile(r"\]\([^)]*\)"),
    re.compile(r"https?://\S+|arXiv \d+\.\d+"),
)


@dataclass(frozen=True)
class Statement:
    """An entry of claims.toml: a text with numbers, where these come from, and its page.

    The page `EVERY_PAGE` stands for any page, for terms such as "95 % interval".
    """

    page: str
    text: str
    values: Sequence[Mapping[str, Any]]

    def pattern(self) -> re.Pattern[str]:
        """Match the text, with any line breaks and with a group for each number."""
        words = [re.escape(word).replace(r"\{\}", f"({_NUMBER})") for word in self.text.split()]
        return re.compile(r"\s+(?:> )?".join(words))


def statements() -> list[Statement]:
    """Read claims.toml.

    Raises
    ------
    EvidenceError
        If an entry states no valid reason, or has another number of values than of gaps.
    """
    content = content_of(CLAIMS)
    found = []
    for entry in content.get("claim", ()):
        if entry["text"].count("{}") != len(entry["values"]):
            raise EvidenceError(f"{entry['text']}: {len(entry['values'])} values for its gaps.")
        found.append(Statement(entry["page"], entry["text"], entry["values"]))
    for entry in content.get("stated", ()):
        if entry["why"] not in WHYS or (entry["why"] == "tested") != ("by" in entry):
            raise EvidenceError(f"{entry['texts'][0]}: `why` must be one of {WHYS}.")
        if "by" in entry and not (ROOT / entry["by"]).is_file():
            raise EvidenceError(f"{entry['texts'][0]}: there is no {entry['by']}.")
        found += [Statement(entry["page"], text, ()) for text in entry["texts"]]
    return found


def formatted(value: Mapping[str, Any]) -> str:
    """Look a number up in the evidence and format it for its sentence."""
    content = content_of(value["file"])

    def measured(key: str) -> float:
        found = look_up(content, key)
        return float(REDUCE[value["reduce"]](found) if "reduce" in value else found)

    number = measured(value["key"]) * value.get("scale", 1.0)
    if "over" in value:
        number /= measured(value["over"])
    return format(number, value["format"]).replace("e-0", "e-")


def prose(text: str) -> str:
    """Return a page of the same length in which only prose and tables are left."""
    for kind in _NOT_PROSE:
        text = kind.sub(lambda match: re.sub(r"[^\n]", "\0", match.group()), text)
    return text


def without_evidence(page: str, text: str, known: Sequence[Statement]) -> Iterator[str]:
    """Yield each number of a page that no statement covers."""
    covered = np.zeros(len(text), dtype=bool)
    for statement in known:
        if statement.page in (page, EVERY_PAGE):
            for match in statement.pattern().finditer(text):
                covered[match.start() : match.end()] = True
    plain = prose(text)
    for match in MEASURED.finditer(plain):
        if not covered[match.start() : match.end()].all():
            line = plain.count("\n", 0, match.start())
            yield f"{page}:{line + 1}: {match.group()!r} in: {text.splitlines()[line].strip()}"


def wrong_numbers(page: str, text: str, known: Sequence[Statement]) -> Iterator[str]:
    """Yield each statement that is not in its page, and each number that the evidence refutes."""
    for statement in known:
        if statement.page != page:
            continue
        matches = list(statement.pattern().finditer(text))
        if not matches:
            yield f"{page}: does not contain: {statement.text}"
        expected = tuple(map(formatted, statement.values))
        for match in matches:
            if match.groups() != expected:
                yield f"{page}: {match.group()!r} should have {', '.join(expected)}"


def with_numbers(page: str, text: str, known: Sequence[Statement]) -> str:
    """Return a page whose sentences have the numbers of the evidence."""
    for statement in known:
        if statement.page == page and statement.values:
            numbers = [formatted(value) for value in statement.values]
            text = statement.pattern().sub(partial(_filled, numbers=numbers), text)
    return text


def _filled(match: re.Match[str], numbers: Sequence[str]) -> str:
    """Return the matched text with other numbers in its groups."""
    out, end = "", match.start()
    for i, number in enumerate(numbers, 1):
        out += match.string[end : match.start(i)] + number
        end = match.end(i)
    return out + match.string[end : match.end()]
