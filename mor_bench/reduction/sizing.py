"""Choose hyperparameters set to "auto" to meet the scene's need, by cross-validation.

A method lists the values that such a hyperparameter may take in its class attribute ``sized``, and
allows the word in the annotation: ``Annotated[int, Field(ge=1)] | Auto``. `mor_bench.Surrogate`
chooses before it learns, keeps the choice in ``sizes_`` and in the model file, and returns it as
``self.value("n_modes")``.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.counting import counted, uncounted
from mor_bench.errors import InvalidInputError, MorBenchError, SolverError
from mor_bench.reduction.basis import remembering
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots

Auto = Literal["auto"]
"""Value of a hyperparameter that requests an automatic choice."""

N_FOLDS = 5
"""Number of folds: parts of the load regions, each held out once."""
N_VALIDATION = 200
"""Approximate number of held-out samples in all folds together, spread evenly."""
HOPELESS = 4.0
"""A trial ends if its error on the first folds exceeds this multiple of the need."""
SEED = 0x512E
STRIDE = 4
"""Step of the search through the values of a hyperparameter, from cheap to accurate."""

MODES = tuple(sorted({round(1.12**k) for k in range(42)}))
"""Numbers of modes to choose from: 1 to 104, about 12 % apart."""
TOLERANCES = (1e-1, 3e-2, 1e-2, 1e-3, 1e-4)
"""Relative residuals of a reduced Newton iteration to choose from."""


class Sizeable(Protocol):
    """The part of `mor_bench.Surrogate` that the search uses."""

    @property
    def parameters(self) -> dict[str, Any]: ...
    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Any: ...
    def predict(self, forces: ArrayLike) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class Score:
    """Error and work of a configuration on held-out samples.

    Attributes
    ----------
    error : float
        Median relative l2 over all folds, or over the first ones if the trial ended early.
        Infinity if the method cannot be fitted.
    work : float
        Mean multiply-adds of one prediction.
    """

    error: float
    work: float


def validation_folds(snapshots: Snapshots) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return the rows to fit on and the rows to score on, for each fold of the load regions.

    A sample of several forces is scored if all of them belong to the fold, and fitted if none
    does. If there is only one region, or a part would be empty, samples form the folds instead.

    Raises
    ------
    InvalidInputError
        If there is only one sample.
    """
    n = len(snapshots)
    if n < 2:
        raise InvalidInputError(
            'a parameter set to "auto" needs at least two training samples, because some '
            "are held out."
        )
    generator = np.random.default_rng(SEED)
    ids, ranks = np.unique(snapshots.loads.patches, return_inverse=True)
    n_folds = min(N_FOLDS, len(ids))
    of_region = generator.permutation(len(ids)) % n_folds
    folds = of_region[ranks.reshape(snapshots.loads.patches.shape)]
    parts = [((folds != fold).all(axis=1), (folds == fold).all(axis=1)) for fold in range(n_folds)]
    if not all(fitted.any() and held.any() for fitted, held in parts):
        of_sample = generator.permutation(n) % min(N_FOLDS, n)
        parts = [(of_sample != fold, of_sample == fold) for fold in range(min(N_FOLDS, n))]
    out = []
    for fitted, held in parts:
        rows = np.flatnonzero(held)
        spread = np.unique(
            np.linspace(0, len(rows) - 1, -(-N_VALIDATION // len(parts))).astype(int)
        )
        out.append((np.flatnonzero(fitted), rows[spread]))
    return out


class Trials:
    """Cross-validated configurations of a method; each is tried once."""

    def __init__(self, method: Sizeable, scene: Scene, snapshots: Snapshots) -> None:
        self._method, self._scene, self._snapshots = method, scene, snapshots
        self._folds = validation_folds(snapshots)
        self.scores: dict[tuple[tuple[str, Any], ...], Score] = {}
        self.refusal: MorBenchError | None = None
        """Reason why the last failed candidate could not be fitted."""

    def whole_score(self, knobs: Mapping[str, Any]) -> Score:
        """Score a configuration on all folds, however large its error is."""
        return self.tried(knobs, np.inf)

    def score(self, knobs: Mapping[str, Any]) -> Score:
        """Score a configuration; stop early if it is hopeless."""
        key = tuple(sorted(knobs.items()))
        if key not in self.scores:
            self.scores[key] = self.tried(knobs)
        return self.scores[key]

    def tried(self, knobs: Mapping[str, Any], hopeless: float = HOPELESS) -> Score:
        make: Any = type(self._method)
        candidate: Sizeable = make(**{**self._method.parameters, **knobs})
        errors: list[float] = []
        with counted() as cost:
            for fitted, held in self._folds:
                try:
                    with uncounted(), warnings.catch_warnings():
                        warnings.simplefilter("ignore")  # the final fit warns
                        candidate.fit(self._scene, self._snapshots[fitted])
                except MorBenchError as error:
                    self.refusal = error
                    return Score(np.inf, np.inf)
                errors += _relative_errors(candidate, self._snapshots[held])
                if np.median(errors) > hopeless * self._scene.spec.needs.error:
                    break
        return Score(float(np.median(errors)), cost.multiply_adds / len(errors))


def _relative_errors(method: Sizeable, samples: Snapshots) -> list[float]:
    """Return the relative l2 of each sample; infinity where there is no prediction."""
    errors, nodes = [], samples.scene.output_nodes
    for i, reference in enumerate(samples.displacements[:, nodes]):
        try:
            predicted = method.predict(samples.given[i].query)
            difference = float(np.linalg.norm(predicted[nodes] - reference))
        except SolverError:
            difference = np.inf
        errors.append(
            difference / (float(np.linalg.norm(reference)) or 1.0)
            if np.isfinite(difference)
            else np.inf
        )
    return errors


def _first_that_meets(
    trials: Trials, ladder: Sequence[Mapping[str, Any]], need: float, start: int, most_work: float
) -> int | None:
    """Return the lowest rung that meets the need; None if none does below ``most_work``.

    The search assumes that error falls and work rises along a ladder, so that it tries few rungs.
    """
    low, high = start - 1, start
    while True:
        score = trials.score(ladder[high])
        if score.error <= need:
            break
        if high == len(ladder) - 1 or (np.isfinite(score.work) and score.work >= most_work):
            return None
        low, high = high, min(high + STRIDE, len(ladder) - 1)
    while high - low > 1:
        middle = (low + high) // 2
        if trials.score(ladder[middle]).error <= need:
            high = middle
        else:
            low = middle
    return high


def choose_sizes(
    method: Sizeable, scene: Scene, snapshots: Snapshots, rungs: Mapping[str, Sequence[Any]]
) -> dict[str, Any]:
    """Choose the hyperparameters set to "auto": the least work that meets the scene's need.

    Candidates are cross-validated: fitted without one fifth of the load regions and scored on it,
    for each fifth. The work of a prediction is counted (`mor_bench.counting`), not timed, so that
    the choice is the same on every machine. The first parameter of `rungs` is climbed from small
    to large for each combination of the others, the most accurate combination first. A looser
    combination starts where the previous climb ended, and is dropped if it takes more work than
    the best one found.

    Parameters
    ----------
    method : Surrogate
    scene : Scene
        Its need is ``scene.spec.needs.error``: the median relative l2.
    snapshots : Snapshots
        Training samples.
    rungs : dict of str to sequence
        Values that each hyperparameter may take, from cheap to accurate.

    Returns
    -------
    dict of str to Any
        The chosen values; empty if nothing is set to "auto".

    Warns
    -----
    UserWarning
        If no candidate meets the need. The most accurate one is chosen then.

    Raises
    ------
    InvalidInputError
        If there are too few samples to hold any out, or no candidate can be fitted.
    """
    open_rungs = {
        name: values for name, values in rungs.items() if method.parameters[name] == "auto"
    }
    if not open_rungs:
        return {}
    need = scene.spec.needs.error
    (climbed, values), *others = open_rungs.items()
    trials = Trials(method, scene, snapshots)
    best: dict[str, Any] | None = None
    start = 0
    with remembering():
        for rest in itertools.product(*(reversed(other) for _, other in others)):
            fixed = {name: value for (name, _), value in zip(others, rest, strict=True)}
            ladder = [{climbed: value, **fixed} for value in values]
            most_work = trials.score(best).work if best else np.inf
            found = _first_that_meets(trials, ladder, need, start, most_work)
            if found is None:
                if best is None:
                    break
                continue
            if best is None:
                start = found
            if trials.score(ladder[found]).work < most_work:
                best = ladder[found]
    if best is None:
        best = dict(min(trials.scores.items(), key=lambda item: item[1].error)[0])
        reached = trials.whole_score(best).error
        if not np.isfinite(reached):
            why = trials.refusal or "no candidate predicts half of the held-out samples."
            raise InvalidInputError(
                f"no {', '.join(open_rungs)} can be chosen automatically: {why}"
            )
        said = ", ".join(f"{name} = {value}" for name, value in best.items())
        warnings.warn(
            f"{scene.name} needs a median relative l2 error of {need:g}. The most accurate "
            f"candidate, {said}, reaches {reached:.3g} on held-out training samples.",
            stacklevel=3,
        )
    return best
