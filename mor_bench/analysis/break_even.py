"""Break-even number of queries of each method against the full-order model, in core-seconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil
from typing import Any

from mor_bench.analysis.frontier import median_latency_ms
from mor_bench.results.row import Row

Record = dict[str, Any]

FULL_ORDER = "fem"
"""Method against which speed-ups and break-even counts are computed."""


def break_even(
    rows: Sequence[Row], at_error: Sequence[Record], bounds: Mapping[str, float]
) -> list[Record]:
    """Count the queries after which the offline cost of a method pays off, at each error.

    The count is the offline cost (data and fit) beyond the preparation of the full-order model,
    divided by what a query saves, both in core-seconds. A query uses its latency times its threads.
    The count compares two configurations that meet the same error by the errors that select: the
    fastest of the method and the fastest full-order one. So all methods compare with the same one.

    Parameters
    ----------
    rows : sequence of Row
        Those of one dataset.
    at_error : sequence of dict
        Records of time at error; `best` is the selected configuration of the method.
    bounds : dict
        The error that selects each row that ran, by label.

    Returns
    -------
    list of dict
        `queries` for the fit of this configuration alone, and `queries_with_tuning` for the fits of
        all configurations of the method that were tried. Both are None with the `verdict`
        (``never``, ``not reached``, ``unknown``) and its `reason`. The other figures are those from
        which the counts are computed: `offline_core_s`, of data, fit and all fits.
    """
    others = [record for record in at_error if record["method"] != FULL_ORDER]
    return [_break_even(rows, record, bounds) for record in others]


def _break_even(rows: Sequence[Row], record: Record, bounds: Mapping[str, float]) -> Record:
    ran, best = [row for row in rows if row.ok], record["best"]
    out = {key: record[key] for key in ("dataset", "method", "target_rel_l2_median")}
    out |= dict.fromkeys(("label", "latency_ms", "fem_label", "fem_latency_ms", "offline_core_s"))
    out |= {"queries": None, "queries_with_tuning": None}
    if best is None:
        return {**out, "verdict": "not reached", "reason": "no configuration is that accurate"}
    row = next(row for row in ran if row.label == best["label"])
    latency, data = best["latency_ms"], row.offline_s.data if row.offline_s else None
    fit, all_fits = row.fit_core_s, _all_fits_core_s(rows, row.method)
    offline = {"data": data, "fit": fit, "all_fits": all_fits}
    out |= {"label": row.label, "latency_ms": latency, "offline_core_s": offline}
    full_order = [
        other
        for other in ran
        if other.method == FULL_ORDER
        and other.latency_ms
        and bounds[other.label] <= record["target_rel_l2_median"]
    ]
    if not full_order:
        reason = f"no configuration of {FULL_ORDER} is that accurate"
        return {**out, "verdict": "unknown", "reason": reason}
    fastest = min(full_order, key=median_latency_ms)
    full_order_ms = median_latency_ms(fastest)
    out |= {"fem_label": fastest.label, "fem_latency_ms": full_order_ms}
    saved_s = 1e-3 * (full_order_ms * fastest.threads - latency * row.threads)
    if saved_s <= 0:
        return {**out, "verdict": "never", "reason": f"it is not faster than {FULL_ORDER}"}
    if data is None or fit is None:
        missing = "its data" if data is None else "its fit"
        return {**out, "verdict": "unknown", "reason": f"the cost of {missing} is not known"}
    prepared = fastest.fit_core_s or 0.0
    queries = [
        None if fits is None else max(0, ceil((data + fits - prepared) / saved_s))
        for fits in (fit, all_fits)
    ]
    out |= {"verdict": "pays off", "reason": "", "queries": queries[0]}
    out["queries_with_tuning"] = queries[1]
    return out


def _all_fits_core_s(rows: Sequence[Row], method: str) -> float | None:
    """Core-seconds of all fits of a method; None if those of a fit are unknown.

    A failed fit has only a wall time. It is taken to have used as many cores as the others.
    """
    tried = [row for row in rows if row.method == method and row.status != "skipped"]
    fits = [(row.offline_s.fit, row.fit_core_s) for row in tried if row.offline_s]
    known = [core_s for _, core_s in fits if core_s is not None]
    if len(known) < len(fits) or not fits:
        return None
    wall_s, core_s = sum(wall for wall, _ in fits), sum(known)
    failed_s = sum(row.tuning_s or 0.0 for row in tried if row.offline_s is None)
    return core_s + failed_s * (core_s / wall_s if wall_s else 1.0)
