"""The verdict in words: one headline, what stands beside it, and the figures of the winner."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from math import ceil, floor, inf, isfinite, log10
from typing import Any

from mor_bench.analysis.frontier import median_error, median_latency_ms
from mor_bench.analysis.told import class_text, told_text
from mor_bench.analysis.verdict import CHANCE_S, RULE, Requirements, Verdict
from mor_bench.options import (
    DEFAULT_SEEDS,
    DEFAULT_TIME_LIMIT_S,
    FOLDERS,
    RunOptions,
    command_line,
)
from mor_bench.results.parts import ErrorSummary
from mor_bench.results.row import Row, SetErrors

FIGURE_NAMES = {
    "error": "error",
    "latency_ms": "latency",
    "memory_bytes": "memory",
    "offline_s": "offline cost",
}
"""Names of the figures that requirements limit."""

ERROR = "relative L2 error"
"""The one name of this error in sentences, on the page and in pictures."""

RUNNER_UP = "best other method"
"""What the second is: the fastest, or by offline cost the cheapest, of those that qualify. A
configuration of the winner's own method is none."""

NO_RUNNER_UP = "No other method that was tried qualifies."
"""What is said where there is no runner-up."""

_UNITS = {
    "error": (100.0, f" % ({ERROR}, median)"),
    "latency_ms": (1.0, " ms (median)"),
    "memory_bytes": (1e-6, " MB"),
    "offline_s": (1.0, " core-seconds"),
}


def limit_text(name: str, limit: float, round_up: bool = False) -> str:
    """Return a limit with its unit, such as "latency <= 3 ms (median)"."""
    scale, unit = _UNITS[name]
    value = _sufficient(scale * limit) if round_up else f"{scale * limit:g}"
    return f"{FIGURE_NAMES[name]} <= {value}{unit}"


def limits_missed(bounds: Mapping[str, float], needs: Requirements) -> list[tuple[str, str, str]]:
    """Return the name of each limit that upper bounds exceed, the bound and the limit in words."""
    out = []
    for name, limit in needs.asked.items():
        if bounds[name] > limit:
            scale, unit = _UNITS[name]
            said = unit.partition(" (")[0]
            value = bounds[name]
            bound = f"{_rounded_up(scale * value)}{said}" if value < inf else "unknown"
            out.append((FIGURE_NAMES[name], bound, f"{scale * limit:g}{said}"))
    return out


def _rounded_up(value: float) -> str:
    """Return a number that is rounded up to three digits, but for an excess of rounding errors."""
    if not 0 < value < inf:
        return f"{value:g}"
    step = 10.0 ** (floor(log10(value)) - 2)
    return f"{ceil(value / step - 1e-9) * step:.3g}"


def _sufficient(value: float) -> str:
    """Return a number that is rounded up and at least as large as the value."""
    text = _rounded_up(value)
    return text if float(text) >= value else f"{value:.17g}"


def worded(verdict: Verdict) -> Verdict:
    """Return the verdict with its sentences."""
    shown = verdict.choice or verdict.nearest
    source = filter(None, [str(verdict.run or ""), kind(verdict), timed_on(verdict)])
    return replace(
        verdict,
        headline=f"{verdict.dataset} needs {needs_text(verdict.requirements)}. {headline(verdict)}",
        beside=[*beside(verdict), f"Evidence: {', '.join(source)}."],
        evidence=evidence(verdict, shown) if shown else [],
    )


def needs_text(needs: Requirements) -> str:
    """State limits, such as "error <= 1 % (relative L2 error, median), memory <= 9 MB"."""
    limits = (limit_text(name, limit) for name, limit in needs.asked.items())
    return ", ".join(limits) or "nothing in particular"


def headline(verdict: Verdict) -> str:
    """Name the winner and its error on the test set, or the nearest without a winner."""
    tried = f"{len(verdict.rows)} configurations"
    row = verdict.choice
    if row is None:
        usable = [
            r for r in verdict.rows if r.ok and isfinite(median_error(r) + median_latency_ms(r))
        ]
        if not usable:
            return (
                f"No configuration gave a usable result: {len(verdict.rows)} tried, none has both "
                "a finite median error and a latency."
            )
        found = f"No configuration qualifies among {tried}."
        if verdict.nearest is None:
            return found
        return f"{found} The nearest is {_short(verdict.nearest)}, with {_misses(verdict)}."
    doubt = " (timing not stable)" if row.latency_ms and row.latency_ms.stable is False else ""
    rank = "the only one that qualifies"
    if len(verdict.qualified) > 1:
        rank = f"the fastest of {len(verdict.qualified)} that qualify"
    return (
        f"{_named(row)} wins: {rank} among {tried}, with a latency of "
        f"{median_latency_ms(row):.3g} ms{doubt}. {_confirmation(verdict, row)}"
    )


def _confirmation(verdict: Verdict, row: Row) -> str:
    """State the winner's median error on the test set, and whether it meets the limit there."""
    error, limit = median_error(row), verdict.requirements.error
    interval = verdict.intervals.get(row.label, {}).get("rel_l2_median")
    high = error if interval is None else max(interval[1], error)
    shown = f"Its median error on the test set is {100 * error:.3g} %"
    if interval is not None:
        shown += f" [{100 * min(interval[0], error):.3g}, {100 * high:.3g}]"
    if row.validation is None:
        return f"{shown}; it was selected on the test set: optimistic."
    if limit is None:
        return f"{shown}."
    if error > limit:
        return f"{shown}: it does NOT meet the limit of {100 * limit:g} % there."
    doubt = "" if high <= limit else ", but its interval does not exclude a larger error"
    return f"{shown}: it meets the limit of {100 * limit:g} % there{doubt}."


def beside(verdict: Verdict) -> list[str]:
    """List what stands beside the headline, one sentence or two for each."""
    lines = [RULE]
    if verdict.choice is None:
        lines += _relaxation_lines(verdict)
    else:
        lines += _alternatives(verdict, verdict.choice)
    if verdict.n_without_answers:
        lines.append(
            f"{verdict.n_without_answers} of {len(verdict.rows)} configurations failed, were "
            "skipped or left loads without an answer."
        )
    return [*lines, *_mesh(verdict), *_stability(verdict)]


def _alternatives(verdict: Verdict, choice: Row) -> list[str]:
    other, cheapest = verdict.runner_up, verdict.cheapest
    undecided = ", ".join(_named(row) for row in verdict.undecided)
    lines = [f"{RUNNER_UP.capitalize()}: {_short(other)}." if other else NO_RUNNER_UP]
    if undecided:
        lines.append(f"Cannot be told apart from the winner in latency: {undecided}.")
    if cheapest is not None:
        name = "the winner itself" if cheapest == choice else _short(cheapest)
        cost = cheapest.offline_core_s
        chance = " Such costs count as equal, since repeated fits differ: the fastest is named."
        brief = cost is not None and cost < CHANCE_S
        lines.append(f"Cheapest offline: {name}, {_core_seconds(cost)}.{chance * brief}")
    for told, best in verdict.best_told.items():
        near = verdict.nearest_told.get(told)
        missed = f"none qualifies{f'; the nearest is {_short(near)}' if near else ''}"
        name = missed if best is None else _short(best)
        lines.append(f"Best when told {told_text(told, verdict.given)}: {name}.")
    return lines


def _relaxation_lines(verdict: Verdict) -> list[str]:
    lines = []
    relaxed = {item.name: item for item in verdict.relaxations}
    for name in verdict.requirements.asked:
        if name in verdict.unknown:
            lines.append(f"Not known of any configuration: {FIGURE_NAMES[name]}")
        elif name in relaxed:
            needed = limit_text(name, relaxed[name].needed, round_up=True)
            lines.append(f"Enough alone: {needed}, by {relaxed[name].row.label}")
        else:
            lines.append(f"Not enough alone: {FIGURE_NAMES[name]}, whatever the limit")
    return lines


def _misses(verdict: Verdict) -> str:
    assert verdict.nearest is not None
    bounds = verdict.figures[verdict.nearest.label]
    factors = {name: bounds[name] / limit for name, limit in verdict.requirements.asked.items()}
    return ", ".join(
        f"{FIGURE_NAMES[name]} {_rounded_up(factor)} times the limit"
        for name, factor in factors.items()
        if factor > 1
    )


def _mesh(verdict: Verdict) -> list[str]:
    found = ((row.discretisation_rel_l2, row.discretisation_at_least) for row in verdict.rows)
    mesh, at_least = next((pair for pair in found if pair[0] is not None), (None, False))
    if mesh is None:
        return ["The discretisation error of the mesh is not known."]
    least = "at least " if at_least else ""
    return [
        f"The discretisation error of the mesh is {least}{100 * mesh:.3g} % (median). Differences "
        "below it say nothing about the real body."
    ]


def _stability(verdict: Verdict) -> list[str]:
    timed = [row for row in verdict.rows if row.latency_ms and row.latency_ms.stable is not None]
    unstable = [row for row in timed if row.latency_ms and not row.latency_ms.stable]
    if not timed:
        return ["The stability of the timings was not checked."]
    if not unstable:
        return ["All timings were stable."]
    winners = ", the winner among them" if verdict.choice in unstable else ""
    were = "was" if len(unstable) == 1 else "were"
    return [
        f"{len(unstable)} of {len(timed)} timings {were} not stable{winners}. "
        f"Time again: {retime_command(verdict)}"
    ]


def retime_command(verdict: Verdict) -> str:
    """Return the command that repeats the timings of the verdict's run."""
    settings = {"datasets": [verdict.dataset], **verdict.settings}
    return f"{run_command(settings)} {shlex.join(['--out', str(verdict.run), '--retime'])}"


def run_command(asked: Mapping[str, Any]) -> str:
    """Return the command of a run with these settings, datasets and methods."""
    settings = dict(asked)
    budget, folders = settings.pop("budget", None) or {}, settings.pop(FOLDERS, None) or {}
    profile = settings.get("profile") or RunOptions().profile
    given = {**folders, **settings, "time_limit_s": budget.get("seconds")}
    usual = {"seeds": DEFAULT_SEEDS[profile], "time_limit_s": DEFAULT_TIME_LIMIT_S[profile]}
    files = folders.get("datasets", {})
    words = ["mor-bench", "run", *(files.get(name, name) for name in settings["datasets"])]
    words += [word for name in settings.get("methods", ()) for word in ("-m", name)]
    for name, field, line in command_line(RunOptions):
        value = given.get(name)
        if value is not None and value != usual.get(name, field.default):
            shown = f"{value:.15g}" if isinstance(value, float) else str(value)
            words += [line.flag] if value is True else [line.flag, shown]
    return shlex.join(words)


def kind(verdict: Verdict) -> str:
    """Return profile, split and number of samples of the run."""
    settings: Mapping[str, Any] = verdict.settings
    parts = [f"profile {settings.get('profile')}"]
    if settings.get("split"):
        parts.append(f"split by {settings['split']}")
    if settings.get("limit"):
        parts.append(f"first {settings['limit']:,} samples")
    return ", ".join(parts)


def timed_on(verdict: Verdict) -> str:
    """Return the processor of the timings in words; empty if unknown."""
    processor = verdict.machine.get("processor")
    return f"timed on {processor}" if processor else ""


def _named(row: Row) -> str:
    return f"{row.label} (reference)" if row.reference else row.label


def _short(row: Row) -> str:
    return f"{_named(row)}, {median_latency_ms(row):.3g} ms at {100 * median_error(row):.3g} %"


def evidence(verdict: Verdict, row: Row) -> list[str]:
    """Return the figures of a configuration, one per indented line."""
    lines = [
        f"  {row.label} ({class_text(row, verdict.given)})",
        f"    error    {_errors(row.error)} on {row.n_test} test loads",
    ]
    if row.validation:
        n = row.n_validation
        lines.append(f"    selected {_errors(row.validation)} on {n} validation loads")
    if row.hidden:
        lines.append(f"    fresh    {_errors(row.hidden)} on {row.hidden.n} freshly drawn loads")
    predict = row.memory_bytes.predict if row.memory_bytes else None
    lines += [
        f"    latency  {_latency(row)}",
        f"    memory   {_size(predict)} to predict, model {_size(row.model_bytes)}",
        f"    offline  {_offline(row)}",
    ]
    for name, found in row.sets.items():
        missing = f", {found.n_failed} without an answer" if found.n_failed else ""
        lines.append(f"    {name:<8} {_errors(found)} on {found.n} loads{missing}")
    return lines


def _core_seconds(value: float | None) -> str:
    if value is None:
        return "offline cost unknown"
    if value < CHANCE_S:
        return "less than one core-second of data and fit"
    return f"{value:.3g} core-seconds of data and fit"


def _errors(found: ErrorSummary | SetErrors | None) -> str:
    if found is None:
        return "unknown"
    median, p95, largest = found.rel_l2_median, found.rel_l2_p95, found.rel_l2_max
    return f"{100 * median:.3g} % median, {100 * p95:.3g} % p95, {100 * largest:.3g} % max"


def _latency(row: Row) -> str:
    latency = row.latency_ms
    if latency is None:
        return "unknown"
    interval = ""
    if latency.low is not None and latency.high is not None:
        interval = f" [{latency.low:.3g}, {latency.high:.3g}]"
    unstable = ""
    if latency.stable is False:
        unstable = f"; unstable: {'; '.join(latency.unstable_because) or 'no reason given'}"
    threads = f"{row.threads} thread{'s' * (row.threads != 1)}"
    return f"{latency.median:.3g} ms median{interval}, {latency.p95:.3g} p95, {threads}{unstable}"


def _offline(row: Row) -> str:
    data = row.offline_s.data if row.offline_s else None
    samples = f" of {row.n_train + (row.n_validation or 0)} samples" if data else ""
    return f"data {_core_s(data)}{samples}, fit {_core_s(row.fit_core_s)}"


def _core_s(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g} core-s"


def _size(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{value / 1e6:.3g} MB" if value >= 1e6 else f"{value / 1e3:.3g} kB"
