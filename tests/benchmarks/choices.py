"""Compare the fixed choices of methods with others, on validation and on test samples.

    python -m tests.benchmarks.choices --json choices.json

Every variant differs from a method by one choice: a parameter of its TOML file, or a constant of
its module. Validation samples decide. The test errors show which choice the test samples would
have made, and what it would have gained.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from time import process_time
from typing import Annotated, Any, Literal

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import track
from torch import nn

import mor_bench
from mor_bench.machine import pinned_threads
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.snapshots.dataset import Dataset, Snapshots

Parameters = dict[str, Any]

CHANNELS, ITERATIONS, BATCH = 8, 1000, 32
"""Size of the U-Meshes, number of iterations, and samples of a batch."""

PUBLISHED: Parameters = {"activation": "relu", "zero_at_rest": False, "loss": "absolute"}
"""Parameters in which `umesh-small` differs from the published network and its loss."""

BASE: Parameters = {**PUBLISHED, "channels": CHANNELS, "iterations": ITERATIONS}


@dataclass(frozen=True)
class Variant:
    """A method with one choice changed.

    Attributes
    ----------
    group, choice, value : str
        Table, row and value of the choice.
    method : str
    parameters : dict
        Parameters that differ from those of the method's file.
    constant : str
        "module:name" of a constant of the code that is replaced; empty for none.
    constant_value : object
    """

    group: Literal["open", "changes", "others"]
    choice: str
    value: str
    method: str
    parameters: Parameters = field(default_factory=dict)
    constant: str = ""
    constant_value: object = None


def weights_drawn(kind: str) -> Callable[[nn.Module, torch.Generator], nn.Module]:
    """Return a function like `draw_weights` of U-Mesh, with other initial weights."""
    draw: Any = {
        "He uniform": nn.init.kaiming_uniform_,
        "Glorot normal": nn.init.xavier_normal_,
    }[kind]

    def draw_weights(network: nn.Module, generator: torch.Generator) -> nn.Module:
        network.to_empty(device="cpu")
        for layer in network.modules():
            if isinstance(layer, nn.Conv3d | nn.ConvTranspose3d):
                draw(layer.weight, generator=generator)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)
        return network

    return draw_weights


UNSEEDED = ("local-pod", "pod")
"""Methods without a seed, which are fitted once."""


def open_choices() -> list[Variant]:
    """Return the choices that the U-Mesh paper leaves open; the first value is the file's."""
    values: dict[str, list[Any]] = {
        "learning_rate": [2.5e-3, 1.5e-3, 5e-3],
        "schedule": ["one-cycle", "constant"],
        "second_moment_decay": [0.95, 0.99, 0.999],
        "batch_size": [BATCH, BATCH // 2, BATCH // 4],
        "normalisation": ["rms", "max", "none"],
    }
    variants = [
        Variant("open", name, str(value), "umesh-small", _same_samples({**BASE, name: value}))
        for name, tried in values.items()
        for value in tried
    ]
    variants.append(Variant("open", "initial weights", "He normal", "umesh-small", dict(BASE)))
    for kind in ("He uniform", "Glorot normal"):
        constant = "mor_bench.surrogates.umesh.method:draw_weights"
        drawn = weights_drawn(kind)
        variants.append(
            Variant("open", "initial weights", kind, "umesh-small", BASE, constant, drawn)
        )
    return variants


def _same_samples(parameters: Parameters) -> Parameters:
    """Return parameters whose number of iterations shows as many samples for any batch size."""
    times = BATCH // parameters.get("batch_size", BATCH)
    return {**parameters, "iterations": parameters["iterations"] * times}


def changes() -> list[Variant]:
    """Return the steps from the published network to `umesh-linear`, each with those before it."""
    steps: list[tuple[str, Parameters]] = [
        ("force in, displacement out", {}),
        ("+ linear response in, remainder out", {"input": "linear-response"}),
        ("+ zero at rest", {"zero_at_rest": True}),
        ("+ SiLU", {"activation": "silu"}),
        ("+ errors relative to the remainder", {"loss": "relative"}),
        ("+ mirror images", {"mirrored": True}),
    ]
    variants, so_far = [], dict(BASE)
    for name, changed in steps:
        so_far |= changed
        variants.append(Variant("changes", name, "", "umesh-small", dict(so_far)))
    return variants


def other_choices() -> list[Variant]:
    """Return fixed choices of other methods; the first value is the one in use."""
    code = "mor_bench.surrogates"
    tried: list[tuple[str, str, Parameters, str, list[float]]] = [
        (
            "deeponet",
            "evenness of the input's coordinates",
            {"input": "linear-response", "iterations": 3000},
            f"{code}.deeponet:EVENNESS",
            [0.0, 0.5, 1.0],
        ),
        (
            "autoencoder",
            "weight of the latent distance",
            {"n_latent": 20},
            f"{code}.autoencoder:LATENT_WEIGHT",
            [0.01, 0.001, 0.1, 1.0],
        ),
        (
            "pod-nn-derivative",
            "weight of the derivatives",
            {"n_input_modes": 20, "iterations": 3000},
            f"{code}.pod_nn:DERIVATIVE_WEIGHT",
            [0.1, 0.01, 1.0],
        ),
    ]
    variants = [
        Variant("others", f"{method}: {choice}", f"{value:g}", method, parameters, constant, value)
        for method, choice, parameters, constant, values in tried
        for value in values
    ]
    for n in (64, 8, 16, 32):
        parameters = {"n_clusters": n, "n_modes": 10}
        variants.append(Variant("others", "local-pod: clusters", str(n), "local-pod", parameters))
    for n_modes, name in product((20, 40), ("euclidean", "stiffness")):
        given: Parameters = {"n_modes": n_modes, "inner_product": name}
        choice = f"pod, {n_modes} modes: inner product"
        variants.append(Variant("others", choice, name, "pod", given))
    return variants


@contextmanager
def replaced(variant: Variant) -> Iterator[None]:
    """Replace the constant of a variant for a while."""
    if not variant.constant:
        yield
        return
    module_name, name = variant.constant.split(":")
    module = importlib.import_module(module_name)
    before = getattr(module, name)
    setattr(module, name, variant.constant_value)
    try:
        yield
    finally:
        setattr(module, name, before)


def scored(method: mor_bench.Surrogate, samples: Snapshots) -> dict[str, float]:
    """Return mean error and median, 95th percentile and maximum of the relative l2 error."""
    predicted: NDArray[np.float64] = np.concatenate(
        [method.predict(samples[i : i + 128].forces) for i in range(0, len(samples), 128)]
    )
    found = summary(sample_errors(predicted, samples.displacements))
    return {
        name: float(found[name])
        for name in ("mean_dof_m", "rel_l2_median", "rel_l2_p95", "rel_l2_max")
    }


def fitted(data: Dataset, variant: Variant, seed: int) -> dict[str, Any]:
    """Fit one variant, and score it on the validation and the test samples."""
    with pinned_threads(1), replaced(variant):
        method = new_method(variant, seed)
        begun = process_time()
        method.fit(data.scene, data.train)
        return {
            "seed": seed,
            "core_s": process_time() - begun,
            "validation": scored(method, data.validation),
            "test": scored(method, data.test),
        }


def new_method(variant: Variant, seed: int) -> mor_bench.Surrogate:
    """Return the method of a variant; methods without a seed are the same for all."""
    seeded = {} if variant.method in UNSEEDED else {"seed": seed}
    return mor_bench.load_method(variant.method, **variant.parameters, **seeded)


def main(
    dataset: Annotated[str, typer.Option(help="Name or TOML file.")] = "beam-coarse",
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of every variant.")] = 3,
    limit: Annotated[int | None, typer.Option(min=1, help="Largest number of samples.")] = None,
    method: Annotated[str, typer.Option(help="Only this method; by default all.")] = "",
    report: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the errors here.")
    ] = None,
) -> None:
    """Compare the fixed choices of methods with others, on validation and on test samples."""
    data = mor_bench.load_dataset(dataset, limit=limit)
    known: dict[str, list[dict[str, Any]]] = {}
    rows = []
    variants = [*open_choices(), *changes(), *other_choices()]
    variants = [variant for variant in variants if method in ("", variant.method)]
    for first in {variant.method: variant for variant in reversed(variants)}.values():
        fitted(data, first, 0)  # compiles and loads what the first fit would pay for
    for variant in track(variants, description=dataset):
        # Variants with equal parameters and constants are trained once.
        key = f"{new_method(variant, 0)!r} {variant.constant and variant.value}"
        n = 1 if variant.method in UNSEEDED else seeds
        known[key] = known.get(key) or [fitted(data, variant, seed) for seed in range(n)]
        named = asdict(variant)
        del named["constant_value"]
        rows.append({**named, "trainings": known[key]})
        shown = np.median([t["validation"]["mean_dof_m"] for t in known[key]])
        print(f"{variant.choice} {variant.value}: {shown:.3g} m on validation samples", flush=True)
    content = {
        "dataset": dataset,
        **BASE,
        "seeds": seeds,
        "n_train": len(data.train),
        "n_validation": len(data.validation),
        "n_test": len(data.test),
        "rows": rows,
    }
    if report is not None:
        report.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
