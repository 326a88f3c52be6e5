"""What a comparison says, with the uncertainty of every figure: the content of comparison.json."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import ceil, inf, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.frontier import (
    EXACT,
    TARGET_ERRORS,
    TARGET_TIMES_MS,
    compare,
    frontier_draws,
    is_point,
)
from mor_bench.analysis.intervals import (
    LEVEL,
    clusters_of,
    intervals_of,
    latency_draws,
    n_processes_of,
    quantiles,
    resample_weights,
    spreads_of,
    verdict_of,
    weighted_means,
    weighted_medians,
    widened,
    widening,
)

if TYPE_CHECKING:
    from mor_bench.results.comparison import Comparison

FULL_ORDER = "fem"
"""The method that speed-ups and break-even counts are taken against."""

HIDDEN_WORSE = 1.2
"""The hidden test set is no cause for concern below this ratio to the shipped one, however sure the difference is."""

Row = dict[str, Any]


@dataclass(frozen=True)
class _Draws:
    """Resamples of the latencies and errors of the usable rows of a dataset.

    Attributes
    ----------
    rows : list of dict
        Those with a latency and an error.
    log_latencies, log_errors : (n_rows, n) float64
        Natural logarithms; resample i of all rows holds the same load regions and the same moments.
    intervals : dict
        By label, those of `rel_l2_median`, `mean_dof_m` and `latency_ms` where there are raw samples.
    clusters, timing : dict
        What was resampled; how processes scatter.
    """

    rows: list[Row]
    log_latencies: NDArray[np.float64]
    log_errors: NDArray[np.float64]
    intervals: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    clusters: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, Any] = field(default_factory=dict)


def analyse(comparison: Comparison, *, n_resamples: int = 2000, seed: int = 0) -> dict[str, Any]:
    """Everything that can be concluded from the rows and raw samples of a comparison.

    Intervals hold 95 %. Those of errors come from a bootstrap over the load regions of the test set, the same for all
    methods, and over training seeds where there are several; those of latencies from the spread between fresh processes,
    of which ratios feel only what the configurations do not share. Nothing is corrected for the number of comparisons: of
    twenty equal pairs one may be called different.

    Parameters
    ----------
    comparison : Comparison
    n_resamples : int
        Of the bootstrap.
    seed : int
        Of the bootstrap.

    Returns
    -------
    dict
        `rows`: value, low and high of the headlines of each configuration.
        `time_at_error`, `error_at_time`: those of `mor_bench.analysis.frontier.compare` with `exists` (whether a real
        configuration meets the target), `low`, `high` (None where not reached) and `not_reached`, the share of resamples in
        which the target is not reached.
        `pairwise`: for each ordered pair of methods and error the ratio of their times, and what is sure of the first.
        `break_even`: from how many queries on a method's offline time pays off.
        `profile`: Dolan and Moré's performance profile.
        `regimes`, `tuning`, `hidden`: see the functions of these names.
        `clusters`: what the bootstrap of each dataset resamples, and how many there are.
        `timing`: the processes of each dataset, and the relative standard deviations of what is specific to a configuration
        and what all share; None where a single process leaves only typical ones to be assumed.
    """
    analysis: dict[str, Any] = {
        "settings": {"n_resamples": n_resamples, "seed": seed, "level": LEVEL},
        **compare(comparison.rows),
        **{name: [] for name in ("rows", "pairwise", "break_even", "hidden", "clusters", "timing")},
    }
    for dataset in dict.fromkeys(row["dataset"] for row in comparison.rows):
        draws = _draws_of(comparison, dataset, n_resamples, np.random.default_rng(seed))
        mine = {
            kind: [record for record in analysis[kind] if record["dataset"] == dataset]
            for kind in ("time_at_error", "error_at_time")
        }
        analysis["rows"] += [
            _headlines(row, draws)
            for row in comparison.rows
            if row["dataset"] == dataset and row["status"] == "ok"
        ]
        analysis["pairwise"] += _with_intervals(mine, draws, needed_error(comparison, dataset))
        analysis["break_even"] += break_even(comparison.rows, mine["time_at_error"])
        analysis["hidden"] += hidden(comparison.rows, dataset, draws.intervals)
        for name, facts in (("clusters", draws.clusters), ("timing", draws.timing)):
            analysis[name] += [{"dataset": dataset, **facts}] if facts else []
    analysis["profile"] = profile(analysis["time_at_error"])
    analysis["regimes"] = regimes(comparison)
    analysis["tuning"] = tuning(comparison)
    return analysis


def needed_error(comparison: Comparison, dataset: str) -> float | None:
    """The relative l2 that a dataset's file asks for; None if it asks for none."""
    value = (comparison.datasets.get(dataset, {}).get("needs") or {}).get("error")
    return None if value is None else float(value)


def _raw(comparison: Comparison, row: Row) -> dict[str, NDArray[Any]]:
    try:
        return comparison.samples(row)
    except (OSError, KeyError):
        return {}


def _number(value: Any) -> float:
    """A figure of a row; infinite where there is none."""
    return inf if value is None or np.isnan(float(value)) else float(value)


def _finite(value: float) -> float | None:
    return float(value) if isfinite(value) else None


def _draws_of(
    comparison: Comparison, dataset: str, n: int, generator: np.random.Generator
) -> _Draws:
    ran = [row for row in comparison.rows if row["dataset"] == dataset and row["status"] == "ok"]
    raw = {row["label"]: _raw(comparison, row) for row in ran}
    try:
        regions = comparison.dataset_arrays(dataset).get("test_regions")
    except OSError:
        regions = None
    resampled: dict[int, tuple[NDArray[np.int32], float]] = {}
    found: dict[str, Any] = {}
    intervals: dict[str, dict[str, tuple[float, float]]] = {row["label"]: {} for row in ran}
    errors: dict[str, NDArray[np.float64]] = {}
    for row in ran:
        samples, label = raw[row["label"]], row["label"]
        values = np.asarray(samples.get("relative_l2", ()), dtype=float)
        if len(values) < 2:
            continue
        if len(values) not in resampled:
            clusters = clusters_of(regions, len(values))
            count = int(clusters.max()) + 1
            resampled[len(values)] = resample_weights(clusters, n, generator), widening(count)
            of_samples = clusters.shape[1] == 1 and count == len(values)
            found = found or {"of": "test samples" if of_samples else "load regions", "n": count}
        drawn, factor = resampled[len(values)]
        errors[label] = _error_draws(samples, drawn, factor, generator)
        intervals[label]["rel_l2_median"] = quantiles(errors[label])
        if "mean_dof_m" in samples:
            e = np.asarray(samples["mean_dof_m"], dtype=float)
            intervals[label]["mean_dof_m"] = quantiles(
                widened(
                    weighted_means(e, drawn),
                    float(e.mean()),
                    factor,
                    (float(e.min()), float(e.max())),
                )
            )
    for label, interval in intervals_of(raw).items():
        intervals[label]["latency_ms"] = interval
    timed = [samples for samples in raw.values() if len(samples.get("latency_ms", ()))]
    timing: dict[str, Any] = {}
    if timed:
        spreads = spreads_of(timed)
        specific, common = (
            spread.sd if spread.df > 0 else None for spread in (spreads.specific, spreads.common)
        )
        timing = {
            "n_processes": max(map(n_processes_of, timed)),
            "specific": specific,
            "common": common,
        }
    usable = [row for row in ran if is_point(row)]
    medians = np.array([row["latency_ms"]["median"] for row in usable], dtype=float)
    latencies = latency_draws([raw[row["label"]] for row in usable], medians, n, generator)
    plain = [
        errors.get(row["label"], np.full(n, _number(row["error"]["rel_l2_median"])))
        for row in usable
    ]
    return _Draws(
        usable,
        latencies,
        np.log(np.maximum(np.array(plain).reshape(len(usable), n), EXACT)),
        intervals,
        found,
        timing,
    )


def _error_draws(
    samples: dict[str, NDArray[Any]],
    weights: NDArray[np.int32],
    factor: float,
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Medians of relative l2 over resampled load regions; where other training seeds were tried, each of a random one of them.

    Another seed moves the error by as much as its median differs from the geometric mean of all seeds' medians.
    """
    values = np.asarray(samples["relative_l2"], dtype=float)
    bounds = float(values.min()), float(values.max())
    draws = widened(weighted_medians(values, weights), float(np.median(values)), factor, bounds)
    others = np.asarray(samples.get("seeds_relative_l2", np.zeros((0, len(values)))), dtype=float)
    if not len(others):
        return draws
    medians = np.median(np.concatenate([values[None], others]), axis=1)
    if not (np.isfinite(medians) & (medians > 0)).all():
        return draws
    moved = np.exp(np.log(medians) - np.log(medians).mean()) ** np.sqrt(
        len(medians) / (len(medians) - 1)
    )
    return np.asarray(draws * generator.choice(moved, draws.size))


def _headlines(row: Row, draws: _Draws) -> Row:
    mine = draws.intervals[row["label"]]
    out: Row = {"dataset": row["dataset"], "label": row["label"]}
    for name, group, key in (
        ("rel_l2_median", "error", "rel_l2_median"),
        ("mean_dof_m", "error", "mean_dof_m"),
        ("latency_ms", "latency_ms", "median"),
    ):
        figures = row[group] or {}
        value = _number(figures.get(key))
        low, high = mine.get(name, (inf, inf))
        if (
            name == "latency_ms"
            and figures.get("low") is not None
            and figures.get("high") is not None
        ):
            low, high = float(figures["low"]), float(figures["high"])
        out[name] = {
            "value": _finite(value),
            "low": _finite(min(low, value) if isfinite(low) else low),
            "high": _finite(max(high, value)),
        }
    return out


def _with_intervals(
    records: dict[str, list[Row]], draws: _Draws, needed: float | None
) -> list[Row]:
    """Add intervals to the records of a dataset; return those of its pairs of methods."""
    targets = sorted(
        {*TARGET_ERRORS, *([needed] if needed and isfinite(needed) and needed > 0 else [])},
        reverse=True,
    )
    times: dict[str, dict[float, NDArray[np.float64]]] = {}
    for method in dict.fromkeys(record["method"] for record in records["time_at_error"]):
        mine = [i for i, row in enumerate(draws.rows) if row["method"] == method]
        if not mine:
            at_error = np.full((len(targets), draws.log_latencies.shape[1]), inf)
            at_time = np.full((len(TARGET_TIMES_MS), draws.log_latencies.shape[1]), inf)
        else:
            at_error, at_time = frontier_draws(
                draws.log_latencies[mine], draws.log_errors[mine], targets, TARGET_TIMES_MS
            )
        times[method] = dict(zip(targets, at_error, strict=True))
        for record in records["time_at_error"]:
            if record["method"] == method:
                _add_interval(record, "latency_ms", times[method][record["target_rel_l2_median"]])
        for record in records["error_at_time"]:
            if record["method"] == method:
                _add_interval(
                    record, "error", at_time[TARGET_TIMES_MS.index(record["target_latency_ms"])]
                )
    values = _point_times(draws.rows, targets)
    dataset = records["time_at_error"][0]["dataset"] if records["time_at_error"] else ""
    return [
        {
            "dataset": dataset,
            "target_rel_l2_median": target,
            "a": a,
            "b": b,
            **_pair(values, times, a, b, target),
        }
        for target in targets
        for a in times
        for b in times
        if a != b
    ]


def _add_interval(record: Row, key: str, draws: NDArray[np.float64]) -> None:
    low, high = (np.exp(end) for end in quantiles(draws))
    value = record[key]
    if value is not None:  # a median of few samples can lie outside the quantiles of its resamples
        low, high = min(low, value), max(high, value)
    if key == "error":  # draws of an error of zero stand at the round-off
        low, high = (0.0 if end <= EXACT else end for end in (low, high))
    record.update(exists=record["best"] is not None, low=_finite(low), high=_finite(high))
    record["not_reached"] = float(np.mean(~np.isfinite(draws)))


def _point_times(rows: Sequence[Row], targets: Sequence[float]) -> dict[tuple[str, float], float]:
    """Log latency of each method at each error, without resampling; infinite where not reached."""
    out: dict[tuple[str, float], float] = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        latencies = np.log([[row["latency_ms"]["median"]] for row in mine])
        errors = np.log(
            np.maximum([[_number(row["error"]["rel_l2_median"])] for row in mine], EXACT)
        )
        at_error, _ = frontier_draws(latencies, errors, targets, ())
        out.update(
            {
                (method, target): float(value)
                for target, value in zip(targets, at_error[:, 0], strict=True)
            }
        )
    return out


def _pair(
    values: dict[tuple[str, float], float],
    times: dict[str, dict[float, NDArray[np.float64]]],
    a: str,
    b: str,
    target: float,
) -> Row:
    """Ratio of the times of a and b at an error; an end of None: one of them may not reach it."""
    here = values.get((a, target), inf), values.get((b, target), inf)
    if not all(map(isfinite, here)):
        missing = [name for name, value in zip((a, b), here, strict=True) if not isfinite(value)]
        return {"verdict": "not reached", "by": missing, "ratio": None, "low": None, "high": None}
    first, second = times[a][target], times[b][target]
    neither = ~np.isfinite(first) & ~np.isfinite(second)
    with np.errstate(invalid="ignore"):
        ratios = first - second
    low, high = (
        quantiles(np.where(neither, -inf, ratios))[0],
        quantiles(np.where(neither, inf, ratios))[1],
    )
    low, high = min(low, here[0] - here[1]), max(high, here[0] - here[1])
    return {
        "verdict": verdict_of(low, high),
        "by": [],
        "ratio": float(np.exp(here[0] - here[1])),
        "low": float(np.exp(low)) if isfinite(low) else None,
        "high": float(np.exp(high)) if isfinite(high) else None,
    }


def break_even(rows: Sequence[Row], at_error: Sequence[Row]) -> list[Row]:
    """From how many queries on the offline time of a method pays off, at each error.

    Offline time (data and fit) over the time that a query saves against the fastest full-order configuration that is at
    least as accurate as the method's fastest real configuration at that error.

    Parameters
    ----------
    rows : sequence of dict
        Results rows.
    at_error : sequence of dict
        Records of time at error.

    Returns
    -------
    list of dict
        `queries`, or None with the `verdict` why: ``never``, ``not reached``, ``unknown``; and what it follows from.
    """
    by_label = {(row["dataset"], row["label"]): row for row in rows if row["status"] == "ok"}
    return [_break_even(by_label, record) for record in at_error if record["method"] != FULL_ORDER]


def _break_even(by_label: dict[tuple[str, str], Row], record: Row) -> Row:
    out: Row = {key: record[key] for key in ("dataset", "method", "target_rel_l2_median")}
    out |= {
        "label": None,
        "latency_ms": None,
        "fem_label": None,
        "fem_latency_ms": None,
        "offline_s": None,
        "queries": None,
    }
    if record["best"] is None:
        return {**out, "verdict": "not reached", "reason": "no configuration is that accurate"}
    row = by_label[record["dataset"], record["best"]["label"]]
    latency, error, offline = (
        record["best"]["latency_ms"],
        record["best"]["error"],
        row["offline_s"] or {},
    )
    out |= {
        "label": row["label"],
        "latency_ms": latency,
        "offline_s": {key: offline.get(key) for key in ("data", "fit")},
    }
    full = [
        other
        for (dataset, _), other in by_label.items()
        if (dataset, other["method"]) == (record["dataset"], FULL_ORDER)
        and other["latency_ms"]
        and _number((other["error"] or {}).get("rel_l2_median")) <= error
    ]
    if not full:
        return {
            **out,
            "verdict": "unknown",
            "reason": f"no configuration of {FULL_ORDER} is as accurate",
        }
    fastest = min(full, key=lambda other: float(other["latency_ms"]["median"]))
    full_order_ms = float(fastest["latency_ms"]["median"])
    out |= {"fem_label": fastest["label"], "fem_latency_ms": full_order_ms}
    if latency >= full_order_ms:
        return {**out, "verdict": "never", "reason": f"it is not faster than {FULL_ORDER}"}
    if None in (offline.get("data"), offline.get("fit")):
        return {**out, "verdict": "unknown", "reason": "the time that its data took is not known"}
    queries = ceil((offline["data"] + offline["fit"]) / (1e-3 * (full_order_ms - latency)))
    return {**out, "verdict": "pays off", "reason": "", "queries": queries}


def hidden(
    rows: Iterable[Row], dataset: str, intervals: dict[str, dict[str, tuple[float, float]]]
) -> list[Row]:
    """How much worse each configuration is on the hidden test set than on the one that everybody knows.

    `worse` where the ratio of the medians is beyond what the sizes of both sets explain: the half-width of the shipped
    set's interval on the log scale, times sqrt(1 + n shipped / n hidden), but at least `HIDDEN_WORSE`.
    """
    out = []
    for row in rows:
        if (
            row["dataset"] != dataset
            or row["status"] != "ok"
            or not row.get("hidden")
            or not row["error"]
        ):
            continue
        shipped, fresh = (
            _number(row["error"]["rel_l2_median"]),
            _number(row["hidden"].get("rel_l2_median")),
        )
        ratio = (
            fresh / shipped
            if shipped > EXACT and isfinite(shipped)
            else 1.0
            if fresh <= max(shipped, EXACT)
            else inf
        )
        high = intervals.get(row["label"], {}).get("rel_l2_median", (inf, inf))[1]
        room = max(high / shipped, 1.0) if isfinite(high) and EXACT < shipped < inf else 1.0
        limit = max(
            HIDDEN_WORSE, room ** np.sqrt(1 + row["n_test"] / max(row["hidden"].get("n") or 1, 1))
        )
        out.append(
            {
                "dataset": dataset,
                "label": row["label"],
                "ratio": _finite(ratio),
                "limit": float(limit),
                "worse": bool(ratio > limit),
            }
        )
    return out


def profile(at_error: Sequence[Row]) -> Row:
    """Performance profile over problems, each a dataset at an error: within which factor of the fastest method each one solves how many.

    Dolan, Moré 2002: Benchmarking optimization software with performance profiles. Problems that no method solves are
    left out and counted. Only who is first, and who solves most, can be read from it: the order of the others depends on
    which methods take part (Gould, Scott 2016).

    Parameters
    ----------
    at_error : sequence of dict
        Records of time at error.

    Returns
    -------
    dict
        `problems`, (dataset, error) of each; `n_unsolved`; `n_datasets`; `factors`, by method the factor of each problem,
        None where not solved.
    """
    times: dict[tuple[str, float], dict[str, float]] = {}
    for record in at_error:
        solved = times.setdefault((record["dataset"], record["target_rel_l2_median"]), {})
        if record["latency_ms"] is not None:
            solved[record["method"]] = record["latency_ms"]
    problems = [problem for problem, solved in times.items() if solved]
    methods = dict.fromkeys(record["method"] for record in at_error)
    factors = {
        method: [
            times[problem][method] / min(times[problem].values())
            if method in times[problem]
            else None
            for problem in problems
        ]
        for method in methods
    }
    return {
        "problems": [list(problem) for problem in problems],
        "n_unsolved": len(times) - len(problems),
        "n_datasets": len({dataset for dataset, _ in times}),
        "factors": factors,
    }


def share_within(factors: Sequence[float | None], tau: float) -> float:
    """Share of problems that a method solves within a factor of the fastest."""
    return (
        sum(factor is not None and factor <= tau for factor in factors) / len(factors)
        if factors
        else 0.0
    )


def regimes(comparison: Comparison) -> list[Row]:
    """Whether each method was tested where its file says that it belongs, and what was missing if not."""
    out: list[Row] = []
    if not any((method or {}).get("regime") for method in comparison.methods.values()):
        return out
    device = str(comparison.settings.get("device") or "cpu")
    for method in dict.fromkeys(row["method"] for row in comparison.rows):
        regime = (comparison.methods.get(method) or {}).get("regime")
        if not regime:
            out.append(
                {
                    "method": method,
                    "says": "",
                    "in_regime": None,
                    "verdict": "its file names no regime",
                }
            )
            continue
        missing = [
            _outside(row, regime, device)
            for row in comparison.rows
            if row["method"] == method and row["status"] == "ok"
        ]
        least = min(missing, key=len, default=["no configuration ran"])
        says = str(regime.get("says") or "")
        verdict = (
            "not tested in its regime" + f" ({', '.join(least)}): {says}"
            if least
            else "in its regime"
        )
        out.append({"method": method, "says": says, "in_regime": not least, "verdict": verdict})
    return out


def _outside(row: Row, regime: Row, device: str) -> list[str]:
    """What a row lacks of a regime."""
    missing = []
    for name, what in (
        ("min_dofs", "degrees of freedom"),
        ("min_train", "training samples"),
        ("min_iterations", "iterations"),
    ):
        least = regime.get(name)
        iterations = (row.get("training") or {}).get("iterations") or row["parameters"].get(
            "iterations"
        )
        has = {
            "min_dofs": row.get("n_dofs"),
            "min_train": row.get("n_train"),
            "min_iterations": iterations,
        }[name] or 0
        if least and has < least:
            missing.append(f"{has:,} of {least:,} {what}")
    if regime.get("split") and row.get("split") != regime["split"]:
        missing.append(f"split by {row.get('split')}")
    if regime.get("gpu") and device == "cpu":
        missing.append("no graphics processor")
    return missing


def tuning(comparison: Comparison) -> list[Row]:
    """What each method was allowed to try on each dataset, and what it did; seconds are of fitting, failed fits included."""
    budget = comparison.settings.get("budget") or {}
    out = []
    for dataset, method in dict.fromkeys(
        (row["dataset"], row["method"]) for row in comparison.rows
    ):
        tried = [
            row
            for row in comparison.rows
            if (row["dataset"], row["method"]) == (dataset, method) and row["status"] != "skipped"
        ]
        seconds = sum(
            row.get("tuning_s") or (row["offline_s"] or {}).get("fit") or 0.0 for row in tried
        )
        seeds = max(((row.get("seeds") or {}).get("n", 1) for row in tried), default=0)
        allowed = {
            "configurations_allowed": budget.get("configurations"),
            "seconds_allowed": budget.get("seconds"),
        }
        out.append(
            {
                "dataset": dataset,
                "method": method,
                "configurations": len(tried),
                "seconds": seconds,
                "seeds": seeds,
                **allowed,
            }
        )
    return out
