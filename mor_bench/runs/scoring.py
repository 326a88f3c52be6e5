"""Score fitted configurations on test sets, reusing cached scores."""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from mor_bench.array_files import parse_npy
from mor_bench.checked_files import read_json, read_written
from mor_bench.errors import StoreError
from mor_bench.measure.error_metrics import ERRORS, SampleErrors, sample_errors
from mor_bench.measure.indicator_quality import Indicated
from mor_bench.runs.cached_fit import LOAD_LIMIT_S, CachedFit, FitRecord
from mor_bench.runs.code_digest import measuring_digest
from mor_bench.runs.fitting import fit_configuration
from mor_bench.runs.training_data import TestSet
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess
from mor_bench.snapshots.store import write_atomically

N_COUNTED = 32
"""Number of test loads over which the cost of a query is averaged."""

SCORE_CHUNK = 256
"""Number of samples in one request for predictions."""

Score = dict[str, NDArray[Any]]
"""Per-sample errors on a test set, range flags if any, and the worst and the middle sample."""


@dataclass(frozen=True)
class ScoredFit:
    """A fitted configuration and its scores.

    Attributes
    ----------
    record : FitRecord
    scores : dict of str to dict of arrays
        Scores of each test set.
    cost : dict or None
        Counted work per query on the main test set.
    """

    record: FitRecord
    scores: dict[str, Score]
    cost: dict[str, float] | None


class _Scorer:
    """Scores one configuration; its worker starts when it is first needed."""

    def __init__(self, cached: CachedFit, limit_s: float, stack: ExitStack) -> None:
        self.cached, self.limit_s, self._stack = cached, limit_s, stack

    @cached_property
    def worker(self) -> SandboxedProcess:
        worker = self.cached.open_worker(self.limit_s)
        self._stack.callback(worker.end)
        return worker

    def score(self, test: TestSet) -> Score:
        """Return the scores on a test set, from the cache if it has them."""
        name = f"score-{measuring_digest()}-{test.digest[:20]}"
        if self.cached.data.stress_errors:
            name += "-stress"
        found = self.cached.arrays(name)
        if found is None:
            found = self._measured(test)
            self.cached.keep_arrays(name, found)
        return found

    def _measured(self, test: TestSet) -> Score:
        errors: list[SampleErrors] = []
        derived: list[dict[str, NDArray[np.float64]]] = []
        flags: list[bool] | None = []
        spreads: list[float] | None = []
        data, worst = self.cached.data, _Worst(test)
        is_main = test is data.sets.get("test")
        indicated = Indicated(data.indicator if is_main else None, len(test.forces))
        until = monotonic() + self.limit_s
        with tempfile.TemporaryDirectory(dir=data.scratch) as folder:
            for start in range(0, len(test.forces), SCORE_CHUNK):
                chunk = slice(start, start + SCORE_CHUNK)
                forces = test.forces[chunk]
                left_s = max(1.0, until - monotonic())
                out = Path(folder) / "answers.npy"
                predicted = self._predictions(test, chunk, left_s, out)
                references = test.references[chunk]
                errors.append(sample_errors(predicted, references, test.nodes, test.fixed_nodes))
                bodies = test.queries(chunk)["parameters"]
                derived.append(data.derived_errors(predicted, references, bodies))
                worst.look_at(start, errors[-1].mean_dof_m, predicted)
                indicated.add(start, forces, predicted)
                found = self.worker.ask("flag", LOAD_LIMIT_S, **test.queries(chunk))["flagged"]
                flags = None if found is None or flags is None else flags + found
                if spreads is not None:
                    found = self.worker.ask("spread", left_s, **test.queries(chunk))["spread"]
                    spreads = None if found is None else spreads + found
            score: Score = {
                name: np.concatenate([getattr(part, name) for part in errors]) for name in ERRORS
            }
            score |= {name: np.concatenate([part[name] for part in derived]) for name in derived[0]}
            middle = _middle(score["amplitude_m"])
            left_s = max(1.0, until - monotonic())
            one = np.array([middle])
            again = self._predictions(test, one, left_s, Path(folder) / "answers.npy")[0]
        if flags is not None:
            score["flagged"] = np.asarray(flags, dtype=bool)
        if spreads is not None:
            if len(spreads) != len(test.forces):
                raise MethodFailedError(
                    f"the method gave {len(spreads)} spreads for {len(test.forces)} loads"
                )
            score["spread"] = np.asarray(spreads, dtype=np.float64)
        has_forces = data.scene.observed_nodes is None
        return {
            **score,
            **indicated.arrays,
            "worst_prediction": worst.prediction,
            "worst_reference": test.references[worst.number],
            "worst_forces": test.forces[worst.number] * has_forces,  # nothing to draw otherwise
            "middle_prediction": again,
            "middle_reference": test.references[middle],
            "middle_forces": test.forces[middle] * has_forces,
        }

    def _predictions(
        self, test: TestSet, chosen: NDArray[np.int64] | slice, limit_s: float, out: Path
    ) -> NDArray[np.float64]:
        """Let the worker predict; check what it wrote, since a third party's code ran there."""
        threads, forces = self.cached.environment.threads, test.forces[chosen]
        self.worker.ask("predict", limit_s, **test.queries(chosen), out=out, threads=threads)
        try:
            predicted = parse_npy(read_written(out, self.cached.data.scratch), str(out))
        except (OSError, StoreError) as error:
            raise MethodFailedError(f"the method's predictions cannot be read: {error}") from None
        if predicted.shape != forces.shape or predicted.dtype != np.float64:
            raise MethodFailedError(
                f"the method's predictions have shape {predicted.shape} and are "
                f"{predicted.dtype}; expected {forces.shape} and float64"
            )
        out.unlink()
        return predicted

    def cost(self) -> dict[str, float] | None:
        """Return the counted work per query, from the cache if it has it."""
        test = self.cached.data.sets["test"]
        path = self.cached.folder / f"cost-{measuring_digest()}-{test.digest[:20]}.json"
        with suppress(OSError, StoreError, ValidationError):
            return read_cost(path)
        chosen = np.linspace(0, len(test.forces) - 1, min(N_COUNTED, len(test.forces))).astype(int)
        answer = self.worker.ask("cost", LOAD_LIMIT_S, **test.queries(chosen))
        cost: dict[str, float] | None = answer["cost"]
        write_atomically(path, json.dumps(cost).encode())
        return cost


def read_cost(path: Path) -> dict[str, float] | None:
    """Read a counted cost; errors as in `read_json`, and `ValidationError` for odd content."""
    return _COST.validate_python(read_json(path))


_COST: TypeAdapter[dict[str, float] | None] = TypeAdapter(dict[str, float] | None)
"""The content of cost-SET.json."""


def _middle(amplitudes: NDArray[np.float64]) -> int:
    """Return the number of the sample with the median deformation, the same for all methods."""
    return int(np.argsort(amplitudes, kind="stable")[(len(amplitudes) - 1) // 2])


class _Worst:
    """The sample with the largest finite error."""

    def __init__(self, test: TestSet) -> None:
        self.error, self.number = -1.0, 0
        self.prediction = np.full(test.references.shape[1:], np.nan)

    def look_at(
        self, start: int, errors: NDArray[np.float64], predicted: NDArray[np.float64]
    ) -> None:
        """Update the worst sample from a chunk that begins at number `start`."""
        finite = np.where(np.isfinite(errors), errors, -1.0)
        if finite.max() > self.error:
            largest = int(finite.argmax())
            self.error, self.number = float(finite[largest]), start + largest
            self.prediction = predicted[largest].copy()


def score_fit(cached: CachedFit, limit_s: float, *, count: bool = True) -> ScoredFit:
    """Score a fitted configuration on all test sets, reusing cached scores.

    Parameters
    ----------
    cached : CachedFit
    limit_s : float
        Time limit of the predictions on a test set, s.
    count : bool
        Whether to count the cost of a query.

    Raises
    ------
    MethodFailedError, MorBenchError
        As `mor_bench.runs.fitting.fit_configuration`.
    """
    with ExitStack() as stack:
        stack.callback(cached.release)
        scorer = _Scorer(cached, limit_s, stack)
        scores = {name: scorer.score(test) for name, test in cached.data.sets.items()}
        return ScoredFit(cached.fitted, scores, scorer.cost() if count else None)


def fit_and_score(cached: CachedFit, limit_s: float) -> ScoredFit:
    """Fit and score a configuration, without counting the cost of a query."""
    fit_configuration(cached, limit_s)
    return score_fit(cached, limit_s, count=False)
