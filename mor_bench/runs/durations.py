"""Expected durations of the parts of a run, from stated times and this machine's measured speed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from glob import escape
from math import sqrt
from pathlib import Path
from statistics import median
from time import perf_counter

from mor_bench.errors import StoreError
from mor_bench.machine import usable_cores
from mor_bench.measure.latency import (
    BATCH_S,
    MOST_BATCH_S,
    MOST_TURN_S,
    OPEN_S,
    PROTOCOLS,
    SERVER_S,
    TURN_S,
)
from mor_bench.measure.machine_speed import MachineSpeed, recorded_machines
from mor_bench.measure.method_session import SETTLE_QUERIES
from mor_bench.measure.timing import BATCHES
from mor_bench.mechanics.moved_bodies import generator_of
from mor_bench.runs.cached_fit import FitRecord, read_fit_record
from mor_bench.runs.compilation import uncompiled
from mor_bench.runs.configurations import OWN, Configuration, may_train
from mor_bench.runs.run_context import RunContext
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import AnyDatasetSpec, DatasetSpec

REFERENCE_DOFS, REFERENCE_TRAINING = 768, 5120
"""Problem size for which method files state `fit_s`: beam-coarse, with its former training part."""

QUERY_S = 3e-4
"""Typical time of a query on the reference machine and problem, s."""

START_S, TORCH_S, REPORT_S = 0.3, 2.0, 12.0
"""Times on the reference machine: to start a process, to import PyTorch, and to write tables,
figures and report, s."""

KERNELS_S, METHOD_S = 6.0, 1.0
"""Times to compile the full-order model, and a method that states no `compile_s`, s."""

PROBED = 8
"""Number of samples that are solved to measure the time per sample."""


@dataclass(frozen=True)
class Pace:
    """Times on this machine over times on the reference machine.

    Attributes
    ----------
    interpreter : float
        Ratio for Python code and compilation.
    solver : float
        Ratio for residuals and back-solves.
    training : float
        Ratio for trainings, which use all cores.
    """

    interpreter: float
    solver: float
    training: float

    @classmethod
    def measured(cls, networks: bool) -> Pace:
        """Measure this machine; without `networks`, trainings count as on the reference machine."""
        reference = recorded_machines()[0]
        here, there = MachineSpeed.measure(networks), reference.speed
        training = 1.0
        if here.convolution_ms and there.convolution_ms:
            cores = reference.cores / usable_cores()
            training = here.convolution_ms / there.convolution_ms * cores
        return cls(
            here.interpreter_ms / there.interpreter_ms,
            sqrt(
                (here.residual_us * here.back_solve_us) / (there.residual_us * there.back_solve_us)
            ),
            training,
        )

    def of(self, configuration: Configuration) -> float:
        """Return the factor for a fit."""
        return self.training if may_train(configuration.method) else self.solver


def sample_seconds(spec: DatasetSpec) -> float:
    """Measure the seconds of one full-order solution among several."""
    scene = load_scene(spec)
    model, loads = generator_of(scene), draw_loads(scene, 0, PROBED)
    forces = loads.nodal_forces(scene.patch_weights)
    free_forces = scene.at_free_dofs(forces.reshape(PROBED, -1))
    model.solve_many(free_forces[:1], loads.parameters[:1])
    start = perf_counter()
    model.solve_many(free_forces, loads.parameters)
    return (perf_counter() - start) / PROBED


def compile_seconds(
    spec: AnyDatasetSpec, configurations: Sequence[Configuration], pace: Pace
) -> float:
    """Estimate the seconds of compiling what is not compiled yet, as `compile_kernels` does it."""
    each = [
        (group.method.compile_s or METHOD_S) + (TORCH_S if may_train(group.method) else START_S)
        for group in uncompiled(spec, configurations)
    ]
    if not each:
        return 0.0
    first, *others = each
    side_by_side = max(sum(others) / usable_cores(), max(others, default=0.0))
    return pace.interpreter * (KERNELS_S + first + side_by_side)


ALIKE = 2.0
"""Largest ratio of unknowns, or of samples, to an earlier fit whose time can be scaled.

A small fit mostly takes a fixed time, which does not grow.
"""


def fit_seconds(
    configuration: Configuration, context: RunContext, size: tuple[int, int], pace: Pace
) -> float | None:
    """Scale the time of a fit from earlier fits of about its size, or from the method's file.

    The time of an iteration is assumed not to depend on the number of training samples.
    """
    n_dofs, n_train = size
    iterates = "iterations" in configuration.parameters
    training = configuration.training
    if iterates and training and training.fit_seconds:
        return training.fit_seconds
    near: list[float] = []
    far: list[float] = []
    for record in _earlier_fits(context.cache, configuration):
        with suppress(ZeroDivisionError):
            grows = record.needs_snapshots and not iterates
            factors = n_dofs / record.n_dofs, n_train / record.n_train if grows else 1.0
            alike = all(1 / ALIKE <= factor <= ALIKE for factor in factors)
            (near if alike else far).append(record.fit_s * factors[0] * factors[1])
    if near:
        return median(near)
    stated = configuration.method.fit_seconds(context.options.profile)
    if stated is None:
        return median(far) if far else None
    samples = 1.0 if iterates else n_train / REFERENCE_TRAINING
    return stated * pace.of(configuration) * n_dofs / REFERENCE_DOFS * samples


def _earlier_fits(cache: Path, configuration: Configuration) -> list[FitRecord]:
    """Return records of earlier fits of a method, with the same parameters if there are any."""
    records, name = [], configuration.method.name
    for path in (cache / "fits").glob(f"{escape(name)}-*/fit.json"):
        with suppress(OSError, StoreError):
            record = read_fit_record(path)
            # The pattern for `pod` also matches the folders of `pod-tensor`.
            if record.method == name and record.trained_elsewhere is None:
                records.append(record)
    wanted = configuration.parameters.items()
    same = [record for record in records if record.parameters.items() >= wanted]
    return same or records


def scoring_seconds(
    configuration: Configuration, n_scored: int, query_s: float, pace: Pace
) -> float:
    """Estimate the seconds of scoring a configuration, with its processes' starts."""
    start = 2 * START_S + (2 * TORCH_S if needs_torch(configuration) else 0.0)
    return pace.interpreter * start + n_scored * query_s


def timing_seconds(
    configurations: Sequence[Configuration], context: RunContext, query_s: float, pace: Pace
) -> float:
    """Estimate the seconds of timing configurations, each as fast as a typical query."""
    protocol, cores = PROTOCOLS[context.options.profile], usable_cores()
    turn = min(MOST_TURN_S, max(TURN_S, (protocol.queries + SETTLE_QUERIES) * query_s))
    batches = [max(BATCH_S, n * query_s) for n in BATCHES if n * query_s <= MOST_BATCH_S]
    turns = protocol.processes * (protocol.rounds + 1) * turn + sum(batches)
    opened = protocol.processes * (SERVER_S + OPEN_S * len(configurations) / cores)
    return len(configurations) * turns + pace.interpreter * opened


def query_seconds(n_dofs: int, pace: Pace) -> float:
    """Return the time of a typical query on a mesh, s."""
    return QUERY_S * pace.solver * n_dofs / REFERENCE_DOFS


def needs_torch(configuration: Configuration) -> bool:
    """Return whether a configuration is a network of this package."""
    return configuration.method.surrogate.startswith(OWN) and may_train(configuration.method)
