"""Compare projection methods at equal sizes: errors, cells and points, and counted work.

    python -m tests.benchmarks.projections hyper --json hyper.json
    python -m tests.benchmarks.projections curved --json curved.json

`hyper` compares ways to evaluate the force of POD at equal numbers of modes, on scenes whose
reduced energy is no polynomial. `curved` compares curved manifolds with POD at equal latent sizes,
and also their reconstruction errors. Counted work does not depend on the machine.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time
from typing import Annotated, Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.optimize import least_squares

import mor_bench
from mor_bench.counting import counted
from mor_bench.errors import MorBenchError, SolverError
from mor_bench.machine import pinned_threads
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogates.curved_pod import CurvedPOD

Array = NDArray[np.float64]
Parameters = dict[str, Any]
ErrorsFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write the errors here.")
]

LAWS = ("beam-neo-hooke", "beam-mooney-rivlin", "beam-nearly-incompressible", "beam-tet")
"""Scenes of `hyper`: a law or element each."""
LIMIT = 1600
"""Largest number of samples of a scene."""
N_TEST = 160
"""Largest number of test samples, spread evenly."""
TOLERANCE = 1e-4
"""Tolerance of the reduced solves."""


@dataclass(frozen=True)
class Contender:
    """A configuration.

    Attributes
    ----------
    name : str
        Row of the table.
    size : int
        Number of modes, or of latent coordinates.
    method : str
    parameters : dict
        Parameters that differ from those of the method's file.
    """

    name: str
    size: int
    method: str
    parameters: Parameters


def hyper(size: int) -> list[Contender]:
    """Return plain POD and its hyper-reduced forms with as many modes.

    The tolerances of the cubatures are those of the quick sweeps. Interpolation has four force
    modes for each displacement mode. `local-pod` with one cluster is POD with static correction.
    """
    forms: dict[str, tuple[str, Parameters]] = {
        "pod": ("pod", {}),
        "pod, corrected": ("local-pod", {"n_clusters": 1}),
    }
    for matching in ("force", "energy"):
        cubatures: dict[str, tuple[str, Parameters]] = {
            "hpod, points": ("hpod", {"sampling": "points", "cubature_tolerance": 5e-3}),
            "hpod, points, corrected": (
                "hpod",
                {"sampling": "points", "cubature_tolerance": 5e-3, "static_correction": True},
            ),
            "hpod, moved": ("hpod", {"sampling": "moved", "cubature_tolerance": 5e-3}),
            "hpod, cells": ("hpod", {"sampling": "cells", "cubature_tolerance": 5e-3}),
            "ecm": ("ecm", {"cubature_tolerance": 1e-2}),
            "ecm, corrected": ("ecm", {"cubature_tolerance": 1e-2, "static_correction": True}),
        }
        forms |= {
            f"{name}, {matching}": (method, {**parameters, "matching": matching})
            for name, (method, parameters) in cubatures.items()
        }
    for sampling in ("dofs", "cell-dofs", "cells"):
        chosen = {"sampling": sampling, "n_force_modes": 4 * size}
        forms[f"deim, {sampling}"] = "deim", chosen
        forms[f"deim, {sampling}, corrected"] = "deim", {**chosen, "static_correction": True}
    common = {"n_modes": size, "tolerance": TOLERANCE}
    return [
        Contender(name, size, method, {**common, **parameters})
        for name, (method, parameters) in forms.items()
    ]


CURVED = ("quadratic-manifold-pod", "pod-ann", "latent-galerkin", "latent-lspg")


def curved(size: int) -> list[Contender]:
    """Return POD and curved manifolds of one size, with and without static correction.

    `local-pod` with one cluster is POD with static correction.
    """
    pod = {"n_modes": size, "tolerance": TOLERANCE}
    found = [
        Contender("pod", size, "pod", pod),
        Contender("pod, corrected", size, "local-pod", {**pod, "n_clusters": 1}),
    ]
    for method in CURVED:
        for corrected in (False, True):
            own = {"n_latent": size, "tolerance": TOLERANCE, "static_correction": corrected}
            name = f"{method}, corrected" if corrected else method
            found.append(Contender(name, size, method, {**own, "cubature_tolerance": 1e-2}))
    return found


def reconstruction(method: mor_bench.Surrogate, samples: Snapshots) -> Array | None:
    """Return the distances of displacements to what a method can represent, relative to them.

    The nearest displacement counts, by least squares over the coordinates. For a manifold with
    static correction, the correction under the sample's load is part of it. None for methods that
    have neither modes nor a manifold, and for modes with static correction.
    """
    u = samples.free_displacements
    if isinstance(method, CurvedPOD):
        rests = [_distance(method, own) for own in u - method.offsets(samples.free_forces)]
        return np.asarray(np.array(rests) / np.linalg.norm(u, axis=1))
    modes = getattr(method, "modes_", None)
    corrected = getattr(method, "static_correction", False)
    if corrected or not isinstance(modes, np.ndarray) or modes.ndim != 2:
        return None
    return np.asarray(np.linalg.norm(u - u @ modes @ modes.T, axis=1) / np.linalg.norm(u, axis=1))


def _distance(method: CurvedPOD, u: Array) -> float:
    """Return the distance of a displacement to the manifold; its modes are orthonormal."""
    coordinates, n = method.space_.T @ u, method.modes_.shape[1]
    rest = float(np.linalg.norm(u - method.space_ @ coordinates))
    size = float(np.linalg.norm(u))

    def apart(q: Array) -> Array:
        return np.asarray((method.curve_.at(q * size)[0] - coordinates) / size)

    def slopes(q: Array) -> Array:
        return method.curve_.at(q * size)[1]

    found = least_squares(apart, coordinates[:n] / size, jac=slopes)
    return float(np.hypot(size * np.linalg.norm(found.fun), rest))


def _relative(method: mor_bench.Surrogate, samples: Snapshots) -> Array:
    """Return relative l2 errors, (n,); infinite where there is no answer."""
    errors = np.full(len(samples), np.inf)
    for number, (force, u) in enumerate(zip(samples.forces, samples.displacements, strict=True)):
        try:
            errors[number] = np.linalg.norm(method.predict(force) - u) / np.linalg.norm(u)
        except SolverError:
            continue
    return errors


def spread_of(errors: Array) -> dict[str, float | None]:
    """Return median, 95th percentile and maximum; None for infinity."""
    figures = {
        "median": float(np.median(errors)),
        "p95": float(np.percentile(errors, 95, method="higher")),
        "max": float(errors.max()),
    }
    return {name: value if np.isfinite(value) else None for name, value in figures.items()}


def write_rows(report: Path | None, rows: list[dict[str, Any]]) -> None:
    """Write rows to a JSON file, if one is given."""
    if report is not None:
        report.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


def measured(contender: Contender, train: Snapshots, test: Snapshots) -> dict[str, Any]:
    """Fit one configuration and score it; a fit that fails gives its reason."""
    method = mor_bench.load_method(contender.method, **contender.parameters)
    begun = process_time()
    try:
        method.fit(train.scene, train)
    except MorBenchError as error:
        return {**asdict(contender), "reason": str(error)}
    fit_core_s = process_time() - begun
    with counted() as cost:
        errors = _relative(method, test)
    apart, points = reconstruction(method, test), getattr(method, "problem_", None)
    found = {
        **asdict(contender),
        "fit_core_s": fit_core_s,
        "n_cells": len(method.cells_) if hasattr(method, "cells_") else train.scene.mesh.n_cells,
        "n_points": getattr(getattr(points, "points", None), "n_points", None),
        "n_failed": int(np.isinf(errors).sum()),
        "error": spread_of(errors),
        "multiply_adds": cost.multiply_adds / len(test),
    }
    return found if apart is None else {**found, "reconstruction": spread_of(apart)}


def main(
    kind: Annotated[Literal["hyper", "curved"], typer.Argument(help="Methods to compare.")],
    dataset: Annotated[
        list[str] | None, typer.Option(help="Name or TOML file; repeat for more.")
    ] = None,
    size: Annotated[
        list[int] | None, typer.Option(min=1, help="Number of modes; repeat for more.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the results here.")
    ] = None,
) -> None:
    """Compare projection methods at equal sizes: errors, cells and points, and counted work."""
    names = dataset or (list(LAWS) if kind == "hyper" else ["beam-coarse"])
    sizes = size or ([10, 20] if kind == "hyper" else [5, 10, 20])
    contenders = [c for n in sizes for c in (hyper if kind == "hyper" else curved)(n)]
    content: dict[str, Any] = {}
    for name in names:
        data = mor_bench.load_dataset(name, limit=LIMIT)
        test = data.test[:: -(-len(data.test) // N_TEST)]
        rows = []
        with pinned_threads(1):
            for contender in contenders:
                rows.append(measured(contender, data.train, test))
                print(name, contender.name, contender.size, rows[-1].get("error"), flush=True)
        content[name] = {"n_train": len(data.train), "n_test": len(test), "rows": rows}
    if report is not None:
        report.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
