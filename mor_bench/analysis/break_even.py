"""Break-even number of queries of each method against the full-order model."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Any

from mor_bench.analysis.frontier import median_error, median_latency_ms
from mor_bench.results.row import Row

FULL_ORDER = "fem"
"""Method against which speed-ups and break-even counts are computed."""


def break_even(rows: Sequence[Row], at_error: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Count the queries after which the offline time of a method pays off, at each error.

    The count is the offline time (data and fit) divided by the time that a query saves. It compares
    two configurations: the method's fastest at that error, and the fastest full-order one that is
    at least as accurate.

    Parameters
    ----------
    rows : sequence of Row
    at_error : sequence of dict
        Records of time at error.

    Returns
    -------
    list of dict
        `queries`, or None with the `verdict` (``never``, ``not reached``, ``unknown``) and its
        `reason`; and the figures from which the count is computed.
    """
    ran = [row for row in rows if row.status == "ok"]
    return [_break_even(ran, record) for record in at_error if record["method"] != FULL_ORDER]


def _break_even(ran: Sequence[Row], record: dict[str, Any]) -> dict[str, Any]:
    dataset, best = record["dataset"], record["best"]
    out = {key: record[key] for key in ("dataset", "method", "target_rel_l2_median")}
    out |= dict.fromkeys(
        ("label", "latency_ms", "fem_label", "fem_latency_ms", "offline_s", "queries")
    )
    if best is None:
        return {**out, "verdict": "not reached", "reason": "no configuration is that accurate"}
    row = next(row for row in ran if (row.dataset, row.label) == (dataset, best["label"]))
    data, fit = (row.offline_s.data, row.offline_s.fit) if row.offline_s else (None, None)
    latency = best["latency_ms"]
    out |= {
        "label": row.label,
        "latency_ms": latency,
        "offline_s": {"data": data, "fit": fit},
    }
    full_order = [
        other
        for other in ran
        if (other.dataset, other.method) == (dataset, FULL_ORDER)
        and other.latency_ms
        and median_error(other) <= best["error"]
    ]
    if not full_order:
        reason = f"no configuration of {FULL_ORDER} is as accurate"
        return {**out, "verdict": "unknown", "reason": reason}
    fastest = min(full_order, key=median_latency_ms)
    full_order_ms = median_latency_ms(fastest)
    out |= {"fem_label": fastest.label, "fem_latency_ms": full_order_ms}
    if latency >= full_order_ms:
        return {**out, "verdict": "never", "reason": f"it is not faster than {FULL_ORDER}"}
    if data is None or fit is None:
        return {**out, "verdict": "unknown", "reason": "the time that its data took is not known"}
    queries = ceil((data + fit) / (1e-3 * (full_order_ms - latency)))
    return {**out, "verdict": "pays off", "reason": "", "queries": queries}
