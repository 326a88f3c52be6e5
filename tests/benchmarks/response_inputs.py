"""Errors of regressions on the linear response, and on starts that know more of the equations.

    python -m tests.benchmarks.response_inputs --json response-inputs.json

A regression learns what its start lacks, u = s(f) + Φ g(z), with z principal coordinates of s. The
linear response comes from stored columns of K₀⁻¹; the others add back-solves and forces to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray

import mor_bench
from mor_bench.machine import pinned_threads
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import error_weights, input_axes
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.surrogates.coordinate_regression import CoordinateRegression, CoordinateSamples
from tests.benchmarks.projections import ErrorsFile, spread_of, write_rows

Array = NDArray[np.float64]

SCENES = ("beam-fine", "liver-hex")
LIMIT = 2000
"""Largest number of samples of a scene."""
REGRESSIONS = ("pca-regression-linear", "pca-kernel-ridge")
N_MODES = 60
"""Size of the basis of what the start lacks."""
N_TIMED = 200
"""Timed starts."""


@dataclass(frozen=True)
class Body:
    """A full-order model, and its stored responses at rest to unit forces."""

    model: FullOrderModel
    compliance: Compliance


def linear(body: Body, load: Array) -> Array:
    """Return K₀⁻¹f, the start of the suite's regressions."""
    return body.compliance.solve(load)


def bent(body: Body, load: Array) -> Array:
    """Return the linear response with true rotations, see `mor_bench.mechanics.warping`."""
    found = body.model.turned_rest.bent(linear(body, load))
    assert found is not None
    return found


def second_order(body: Body, load: Array) -> Array:
    """Return u + K₀⁻¹(f - f_int(u)) at the linear response u.

    Up to terms of third order in the load, this is the response with the modal derivative along u.
    """
    u = linear(body, load)
    return u + body.model.rest_factor.solve(load - body.model.force(u).force)


def turned_step(body: Body, load: Array) -> Array:
    """Return u + R K₀⁻¹ Rᵀ(f - f_int(u)) at the bent response u, a step of the full solve."""
    u = bent(body, load)
    return u + body.model.turned_rest.at(u).solve(load - body.model.force(u).force)


Start = Callable[[Body, Array], Array]

STARTS: dict[str, Start] = {
    "linear response": linear,
    "bent response": bent,
    "second-order response": second_order,
    "bent response, one turned step": turned_step,
}


def started(body: Body, start: Start, samples: Snapshots) -> Array:
    """Return the starts (n, n_free) of samples, m."""
    return np.array([start(body, load) for load in samples.free_forces])


def latency_ms(body: Body, start: Start, samples: Snapshots) -> float:
    """Return the median time of a start."""
    seconds = []
    for load in samples.free_forces[:N_TIMED]:
        begun = perf_counter()
        start(body, load)
        seconds.append(perf_counter() - begun)
    return 1e3 * median(seconds)


def relative(found: Array, samples: Snapshots) -> dict[str, float | None]:
    """Return median, p95 and maximum of the relative l2 errors of displacements (n, n_free)."""
    u = samples.free_displacements
    moved = u.any(axis=1)
    errors = np.linalg.norm(found - u, axis=1)[moved] / np.linalg.norm(u[moved], axis=1)
    return spread_of(errors)


def learned(name: str, data: Dataset, before: Array, test_before: Array) -> Array:
    """Return answers (n_test, n_free), m, of a regression of what the start lacks."""
    u = data.train.free_displacements
    method = mor_bench.load_method(name)
    assert isinstance(method, CoordinateRegression)
    n_inputs = method.n_input_modes or method.usual_inputs["linear-response"]
    method.ends_ = np.zeros((2, 0))
    method.axes_ = input_axes(before, n_inputs, method.evenness)
    method.modes_ = pod(u - before, N_MODES).modes
    values, weights = (u - before) @ method.modes_, error_weights(u)[:, None]
    method.take(method.regress(CoordinateSamples(before @ method.axes_, values, weights)))
    return test_before + method.coefficients(test_before @ method.axes_) @ method.modes_.T


def measured(scene: str) -> list[dict[str, Any]]:
    """Return the errors of each start of a scene, alone and with each regression."""
    data = mor_bench.load_dataset(scene, limit=LIMIT)
    model, rows = FullOrderModel(data.scene), []
    body = Body(model, Compliance(model))
    for label, start in STARTS.items():
        train, test = (started(body, start, part) for part in (data.train, data.test))
        row: dict[str, Any] = {"dataset": scene, "start": label}
        row |= {"start_ms": latency_ms(body, start, data.test), "n_train": len(train)}
        row |= {"alone": relative(test, data.test)}
        row |= {name: relative(learned(name, data, train, test), data.test) for name in REGRESSIONS}
        rows.append(row)
        print(row, flush=True)
    return rows


def main(report: ErrorsFile = None) -> None:
    """Compare starts of regressions on the linear response."""
    with pinned_threads(1):
        rows = [row for scene in SCENES for row in measured(scene)]
    write_rows(report, rows)


if __name__ == "__main__":
    typer.run(main)
