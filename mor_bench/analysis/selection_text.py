"""Lines of text about limits and about the figures of a configuration."""

from __future__ import annotations

from math import ceil, floor, inf, log10

from mor_bench.results.row import ErrorSummary, Row, SetErrors

FIGURE_NAMES = {
    "error": "error",
    "latency_ms": "latency",
    "memory_bytes": "memory",
    "offline_s": "offline time",
}
"""Names of the figures that requirements limit."""

_UNITS = {
    "error": (100.0, " % (relative l2, median)"),
    "latency_ms": (1.0, " ms (median)"),
    "memory_bytes": (1e-6, " MB"),
    "offline_s": (1.0, " s"),
}


def limit_text(name: str, limit: float, round_up: bool = False) -> str:
    """Return a limit with its unit, such as "latency <= 3 ms (median)"."""
    scale, unit = _UNITS[name]
    value = _rounded_up(scale * limit) if round_up else f"{scale * limit:g}"
    return f"{FIGURE_NAMES[name]} <= {value}{unit}"


def _rounded_up(value: float, digits: int = 3) -> str:
    if not 0 < value < inf:
        return f"{value:g}"
    step = 10.0 ** (floor(log10(value)) - digits + 1)
    text = f"{ceil(value / step - 1e-9) * step:.{digits}g}"
    return text if float(text) >= value else f"{value:.17g}"


def evidence(row: Row) -> list[str]:
    """Return the figures of a configuration, one per indented line."""
    lines = [
        f"  {row.label}",
        f"    error    {_errors(row.error)} on {row.n_test} test loads",
    ]
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
    mesh = row.discretisation_rel_l2
    if mesh is not None:
        lines.append(
            f"    mesh     {100 * mesh:.3g} % median: the discretisation error; "
            "no method can be more accurate"
        )
    return lines


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
    fit = row.offline_s.fit if row.offline_s else None
    samples = f" of {row.n_train} samples" if data else ""
    return f"data {_seconds(data)}{samples}, fit {_seconds(fit)}"


def _seconds(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g} s"


def _size(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{value / 1e6:.3g} MB" if value >= 1e6 else f"{value / 1e3:.3g} kB"
