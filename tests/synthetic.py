"""A comparison without a run: rows and raw samples as a run of several processes leaves them, with a truth that is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.measure.error_metrics import SampleErrors, summary
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import LearningPoint, Row, label_of
from mor_bench.scene.mesh import box_mesh
from mor_bench.specs import load_dataset_spec

N_PROCESSES, N_ROUNDS, N_QUERIES = 5, 4, 30
MESH = box_mesh((4.0, 1.0, 1.0), (15, 3, 3))

METHODS: dict[str, tuple[dict[str, Any], list[tuple[dict[str, Any], float, float]]]] = {
    "fem": (
        {},
        [
            ({"tolerance": 0.1}, 0.006, 0.55),
            ({"tolerance": 0.01}, 1e-3, 0.62),
            ({"tolerance": 1e-8}, 1e-9, 1.05),
        ],
    ),
    "pod": ({}, [({"n_modes": r}, 0.5 * r**-1.0, 0.2 * r**0.5) for r in (3, 10, 40, 80)]),
    "hpod": (
        {},
        [
            ({"n_modes": r, "cubature_tolerance": t}, 0.4 * r**-1.0 + t, 0.1 * r**0.5)
            for t in (0.005, 0.001)
            for r in (3, 10, 40)
        ],
    ),
    "pca-regression": (
        {},
        [({"n_input_modes": k}, 0.03 * (5 / k), 0.012 * k**0.3) for k in (5, 10, 20)],
    ),
    "linear-fem": ({}, [({}, 0.11, 0.02)]),
    "umesh": ({"channels": 16, "steps": 2}, [({}, 0.035, 3.1)]),
}
"""Fixed parameters, and of each configuration the swept ones, its relative l2 and its latency in ms."""

REGIMES = {
    "umesh": {
        "says": "20,000 samples or more, on a GPU",
        "min_dofs": 10_000,
        "min_train": 20_000,
        "gpu": True,
    },
    "hpod": {
        "says": "meshes of more than 500 unknowns",
        "min_dofs": 500,
        "min_train": None,
        "gpu": False,
    },
}


def region_errors(
    generator: np.random.Generator,
    regions: NDArray[np.int64],
    error: float,
    effects: NDArray[np.float64],
) -> SampleErrors:
    """Errors of samples with a median near `error`; each region has an effect of its own, the same for all methods."""
    relative = error * np.exp(
        effects[regions].sum(axis=1) + 0.5 * generator.normal(size=len(regions))
    )
    amplitude = generator.uniform(0.02, 0.7, len(regions))
    return SampleErrors(0.15 * relative * amplitude, relative, relative * amplitude, amplitude)


def timings(
    generator: np.random.Generator,
    speed: NDArray[np.float64],
    latency_ms: float,
    spread: float = 0.012,
) -> dict[str, NDArray[Any]]:
    """Raw latencies with the numbers of their processes and rounds, on a machine of a log speed (n_processes, n_rounds)."""
    process = spread * generator.normal(size=(len(speed), 1, 1))
    logs = process + speed[..., None] + 0.05 * generator.normal(size=(*speed.shape, N_QUERIES))
    logs += np.where(generator.random(logs.shape) < 0.03, generator.exponential(0.5, logs.shape), 0)
    numbers = np.indices(logs.shape)
    return {
        "latency_ms": latency_ms * np.exp(logs).ravel(),
        "process": numbers[0].ravel(),
        "round": numbers[1].ravel(),
    }


def add_configuration(
    comparison: Comparison,
    dataset: str,
    method: str,
    swept: dict[str, Any],
    errors: SampleErrors,
    timed: dict[str, NDArray[Any]],
    **more: Any,
) -> Row:
    """Add a row and its raw samples; `more` replaces entries of the row."""
    times, parameters = timed["latency_ms"], {**METHODS.get(method, ({},))[0], **swept}
    median = float(np.median(times))
    row: dict[str, Any] = {
        "dataset": dataset,
        "split": "region",
        "method": method,
        "label": label_of(method, swept),
        "parameters": parameters,
        "status": "ok",
        "reason": None,
        "n_train": 5120,
        "n_test": len(errors.relative_l2),
        "n_unused": 0,
        "n_failed": 0,
        "n_dofs": 768,
        "threads": 1,
        "error": summary(errors),
        "latency_ms": {
            "median": median,
            "p95": float(np.percentile(times, 95)),
            "p99": float(np.percentile(times, 99)),
            "low": None,
            "high": None,
            "gc": 0.002,
            "n_queries": len(times),
            "n_processes": N_PROCESSES,
            "stable": True,
            "unstable_because": [],
        },
        "all_threads_ms": {"median": 0.8 * median},
        "throughput": {"8": 1.5e3 / median, "64": 4e3 / median, "512": None},
        "offline_s": {
            "data": 0.0 if "fem" in method else 27.0,
            "fit": 600.0 if method == "umesh" else 0.4,
        },
        "memory_bytes": {"fit": 4e8, "predict": 1.8e8},
        "model_bytes": 123_456,
        "cost": {
            "factorisations": 0.0,
            "back_solves": 12.5,
            "element_evaluations": 1350.0,
            "multiply_adds": 2.1e6,
        },
        "sets": {
            name: {
                "n": 60,
                "n_failed": 0,
                "n_flagged": flagged,
                "mean_dof_m": 2e-4 * factor,
                "rel_l2_median": factor * summary(errors)["rel_l2_median"],
                "rel_l2_p95": 2.5 * factor * summary(errors)["rel_l2_median"],
                "rel_l2_max": 4 * factor * summary(errors)["rel_l2_median"],
            }
            for name, factor, flagged in (
                ("in-range", 1.0, 1),
                ("2x", 2.4, 25),
                ("unseen-regions", 3.1, None),
            )
        },
        "hidden": {
            "n": 400,
            "seed": 7,
            **{
                key: summary(errors)[key] * 1.05
                for key in ("mean_dof_m", "rel_l2_median", "rel_l2_p95", "rel_l2_max")
            },
        },
        "discretisation_error_m": 0.0092,
        "discretisation_rel_l2": 0.11,
        "warnings": [],
        **more,
    }
    generator = np.random.default_rng(len(comparison.rows))
    reference = 0.3 * MESH.points[:, [0]] ** 2 * np.array([0.01, 0.03, 0.1])
    forces = np.zeros_like(reference)
    forces[-1, 2] = 0.7
    samples = {
        **timed,
        "relative_l2": errors.relative_l2,
        "mean_dof_m": errors.mean_dof_m,
        "max_nodal_m": errors.max_nodal_m,
        "amplitude_m": errors.amplitude_m,
        "worst_reference": reference,
        "worst_forces": forces,
        "worst_prediction": reference
        * (1 + min(errors.relative_l2.max(), 1.0) * generator.random()),
    }
    made = Row.model_validate(row)
    comparison.put(made, samples)
    return made


def synthetic_comparison(
    out: Path,
    datasets: tuple[str, ...] = ("beam-coarse",),
    n_regions: int = 13,
    per_region: int = 40,
) -> Comparison:
    """All of `METHODS` on datasets of the suite, on a machine that drifts; errors of a second dataset are 1.5 times as large."""
    comparison = Comparison(
        out,
        {"processor": "synthetic", "cores": 2, "versions": {"numpy": "2"}},
        settings={"profile": "quick", "budget": {"configurations": 5, "seconds": 300.0}},
        methods={name: {"title": name, "regime": regime} for name, regime in REGIMES.items()},
    )
    for number, dataset in enumerate(datasets):
        generator = np.random.default_rng(number)
        regions = np.repeat(np.arange(n_regions) * 5, per_region)[:, None]
        effects = np.zeros(5 * n_regions)
        effects[::5] = 0.25 * generator.normal(size=n_regions)
        arrays = {
            "points": MESH.points,
            "cells": MESH.cells,
            "singular_values": 0.8 ** np.arange(90.0),
            "test_regions": regions,
        }
        comparison.add_dataset(dataset, load_dataset_spec(dataset).model_dump(mode="json"), arrays)
        speed = 0.02 * np.sin(np.arange(N_PROCESSES * N_ROUNDS) / 3).reshape(N_PROCESSES, N_ROUNDS)
        for method, (_, configurations) in METHODS.items():
            for swept, error, latency in configurations:
                errors = region_errors(generator, regions, error * (1 + 0.5 * number), effects)
                add_configuration(
                    comparison,
                    dataset,
                    method,
                    swept,
                    errors,
                    timings(generator, speed, latency * (1 + 3 * number)),
                )
        for method, error in (("umesh", 0.035), ("pca-regression", 0.02)):
            for n_train in (320, 1280, 5120):
                figures = {"rel_l2_median": error * (5120 / n_train) ** 0.4, "mean_dof_m": 1e-3}
                comparison.learning.append(
                    LearningPoint(
                        dataset=dataset,
                        method=method,
                        label=method,
                        n_train=n_train,
                        fit_s=1.0,
                        error=figures,
                        status="ok",
                        reason=None,
                    )
                )
    unsteady = next(row for row in comparison.rows if row["method"] == "linear-fem")
    latency = {**unsteady["latency_ms"], "stable": False}
    latency["unstable_because"] = ["processes differ by 14 %"]
    comparison.put(Row(**{**unsteady.as_dict(), "latency_ms": latency}))
    worse = next(row for row in comparison.rows if row["method"] == "pca-regression")
    hidden = {**worse["hidden"], "rel_l2_median": 4 * worse["hidden"]["rel_l2_median"]}
    comparison.put(Row(**{**worse.as_dict(), "hidden": hidden}))
    return comparison
