"""Numbers in sentences: each has a source with which it is compared, or a reason to have none.

`reports/claims.toml` has two kinds of entries. A `[[claim]]` has the text of a page, with `{}` for
each number, and `values` that say where the numbers come from:

    file, key       evidence or TOML file, see `stored.look_up`; or a Python file and its text with
                    `{}` for the number, such as "MAX_CELLS = {}"
    over            key of a divisor in the same file
    reduce          "median", "mean", "min", "max", "len", "sum" or "prod" of a list
    scale           factor
    format          Python's format of the number, such as ".2g"; "word" for "ten". Default: ",g"

A `[[stated]]` has texts whose numbers need no source here, and the reason `why`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tests.published.stored import BLOCK, ROOT, EvidenceError, content_of, number_of

CLAIMS = "reports/claims.toml"

EVERY_PAGE = "*"

WHYS = ("paper", "equation", "format", "name", "version", "year", "tested")
"""Reasons why a number needs no source here.

It is a number of the paper, an equation's, or one that a file format or protocol fixes; it is part
of a name, of a version or of a citation; or the test `by`, FILE::FUNCTION, compares it.
"""

_NUMBER = r"[-−]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?|[-−]?\.\d+"

_WORDS = (
    "two|three|four|five|six|seven|eight|nine|ten|twelve|fifteen|sixteen|twenty|thirty|forty|fifty|"
    "sixty|hundreds?|thousands?|half|a third|a quarter|a fifth|a tenth|two thirds|three quarters"
)

_UNITS = "times|seconds|minutes|hours|per cent|percent|million"

_SHARES = "time|error|samples|memory|core|cores|loads|cells|queries|iterations"

NUMBER = re.compile(
    rf"10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+|(?<![\w.,])(?:{_NUMBER})"
    rf"|\b(?:{_WORDS})(?: \w+)? (?:{_UNITS})\b"
    rf"|\b(?:{_WORDS}) (?:of )?(?:the|all|a) (?:{_SHARES})\b"
    r"|\b(?:a|an|one|half an?) (?:minute|hour)\b|\b(?:than|about|most|least) (?:a|one) second\b"
    rf"|factor of (?:about )?(?:{_WORDS})|twice as"
)
"""A number, and words that look like a measurement."""

_DIGITS = re.compile(_NUMBER)

MEASURED = re.compile(
    rf"(?:{_NUMBER}) ?(?:ms|µs|s|min|h|seconds|minutes|hours|times|×|%|per cent|[kMG]i?B)(?!\w)"
    rf"|(?<![\w.])\d*\.\d+|\d+e[-+]?\d+|twice as"
)
"""A number with the unit of an error, a time or a ratio, or with decimals."""

_NOT_PROSE = (
    re.compile(r"^ *```.*?^ *```", re.DOTALL | re.MULTILINE),
    re.compile(r"^ {4}.*$", re.MULTILINE),
    BLOCK,
    re.compile(r"<!--.*?-->", re.DOTALL),
    re.compile(r"\$\$.*?\$\$", re.DOTALL),  # formulas
    re.compile(r"\$[^$\n]+\$"),
    re.compile(r"^:{3,}.*$", re.MULTILINE),  # directives of the site
    re.compile(r"`[^`\n]+`"),
    re.compile(r"\]\([^)]*\)"),
    re.compile(r'<img src="[^"]*" width="\d+"'),
    re.compile(r"https?://\S+|arXiv \d+\.\d+"),
)


IN_WORDS: dict[float, str] = {2: "two", 3: "three", 5: "five", 10: "ten"}


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
        words = [
            re.escape(word).replace(r"\{\}", f"({_NUMBER}|{_WORDS})") for word in self.text.split()
        ]
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
        if "by" in entry:
            file, _, test = entry["by"].partition("::")
            if f"def {test}(" not in content_of(file):
                raise EvidenceError(f"{entry['texts'][0]}: there is no test {entry['by']}.")
        found += [Statement(entry["page"], text, ()) for text in entry["texts"]]
    return found


def formatted(value: Mapping[str, Any]) -> str:
    """Look a number up in the evidence and format it for its sentence."""
    number = number_of(value)
    if value.get("format") == "word":
        return IN_WORDS[number]
    return re.sub(r"e([-+])0?", r"e\1", format(number, value.get("format", ",g"))).replace(
        "e+", "e"
    )


def prose(text: str) -> str:
    """Return a page of the same length in which only prose and tables are left."""
    for kind in _NOT_PROSE:
        text = kind.sub(lambda match: re.sub(r"[^\n]", "\0", match.group()), text)
    return text


def without_evidence(page: str, text: str, known: Sequence[Statement]) -> Iterator[str]:
    """Yield each number of a page that no gap of a claim and no stated text covers."""
    covered = np.zeros(len(text), dtype=bool)
    for statement in known:
        if statement.page in (page, EVERY_PAGE):
            for match in statement.pattern().finditer(text):
                gaps = range(1, len(statement.values) + 1) if statement.values else [0]
                for gap in gaps:
                    covered[match.start(gap) : match.end(gap)] = True
    plain = prose(text)
    for match in NUMBER.finditer(plain):
        named = _DIGITS.search(match.group()) or re.match(_WORDS, match.group())
        start, end = match.span() if named is None else np.add(match.start(), named.span())
        if not covered[start:end].all():
            line = plain.count("\n", 0, match.start())
            yield f"{page}:{line + 1}: {match.group()!r} in: {text.splitlines()[line].strip()}"


def measured_in_specification(page: str, known: Sequence[Statement]) -> Iterator[str]:
    """Yield the numbers in the texts and comments of a method's or dataset's file.

    A title or source may have numbers, but no measurement. The values of keys are settings.
    """
    content = dict(content_of(page))
    cited = f"{content.pop('title')}. {content.pop('source')}"
    for statement in known:
        if statement.page == page:
            cited = statement.pattern().sub("", cited)
    comments = re.findall(r"#.*", (ROOT / page).read_text(encoding="utf-8"))
    found = [(MEASURED, cited), *((NUMBER, text) for text in (*_texts(content), *comments))]
    for kind, text in found:
        yield from (f"{page}: {match.group()!r} in: {text}" for match in kind.finditer(text))


def _texts(content: Any) -> Iterator[str]:
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, list):
        for value in content:
            yield from _texts(value)
    elif isinstance(content, str):
        yield content


def wrong_numbers(page: str, text: str, known: Sequence[Statement]) -> Iterator[str]:
    """Yield each statement that is not in its page, and each number that the evidence refutes."""
    for statement in known:
        if statement.page not in (page, EVERY_PAGE):
            continue
        matches = list(statement.pattern().finditer(text))
        if not matches and statement.page == page:
            yield f"{page}: does not contain: {statement.text}"
        expected = tuple(map(formatted, statement.values))
        for match in matches:
            if match.groups() != expected:
                yield f"{page}: {match.group()!r} should have {', '.join(expected)}"


def with_numbers(page: str, text: str, known: Sequence[Statement]) -> str:
    """Return a page whose sentences have the numbers of the evidence."""
    for statement in known:
        if statement.page in (page, EVERY_PAGE) and statement.values:
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
