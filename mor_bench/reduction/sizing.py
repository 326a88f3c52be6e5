"""Sizes of reduced models from what the scene needs: knobs set to ``"auto"``, chosen by cross-validation on the training samples.

A method whose knobs may be ``"auto"`` adds two lines to `fit`, and uses what they give in place of the knobs:

    snapshots = self._checked_snapshots(snapshots)
    knobs = size_to_needs(self, scene, snapshots, {"n_modes": MODES, "tolerance": TOLERANCES})
    basis = pod(snapshots.free_displacements, knobs["n_modes"])

The annotation of such a knob allows the word, ``Annotated[int, Field(ge=1)] | Auto``. Knobs with another value keep it. What was
chosen is in ``sizes_`` of the fitted method, and is saved and loaded with it; what `predict` needs of it, `_restore` takes from
``self._sized("tolerance")``.
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
"""Value of a knob that is to be chosen."""

N_FOLDS = 5
"""Parts of the load regions, each held out once: errors differ up to threefold between parts of beam-coarse's."""
N_VALIDATION = 200
"""At most about so many samples of these, spread evenly."""
HOPELESS = 4.0
"""An error this many times the need on the first folds ends a trial."""
SEED = 0x512E
STRIDE = 4
"""Rungs that a climb takes at once before it looks between them."""

MODES = tuple(sorted({round(1.12**k) for k in range(42)}))
"""Numbers of modes to choose from: 1 to 104, some 12 % apart."""
TOLERANCES = (1e-1, 3e-2, 1e-2, 1e-3, 1e-4)
"""Relative residuals at which a reduced Newton iteration may stop, to choose from."""


class Sizeable(Protocol):
    """What the search needs of a `mor_bench.Surrogate`."""

    sizes_: dict[str, Any]

    @property
    def parameters(self) -> dict[str, Any]: ...
    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Any: ...
    def predict(self, forces: ArrayLike) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class Score:
    """What a configuration shows on the samples held out.

    Attributes
    ----------
    error : float
        Relative l2, median over the samples of all folds, or of the first ones where these show enough; infinity where the
        method cannot be fitted.
    work : float
        Multiply-adds of one prediction, mean.
    """

    error: float
    work: float


def validation_folds(snapshots: Snapshots) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Row numbers to fit candidates on and to score them on, for each fold of the training samples' load regions.

    A sample of several forces is scored on where all of them are of the fold, and fitted on where none is. With one region
    only, or where a fold would leave a part empty, the samples are dealt out instead.

    Raises
    ------
    InvalidInputError
        If there is but one sample.
    """
    n = len(snapshots)
    if n < 2:
        raise InvalidInputError(
            'a knob set to "auto" needs at least two training samples, of which some are held out.'
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
    """Configurations of a method, each fitted to all folds of the training samples but one and scored on that one, once."""

    def __init__(self, method: Sizeable, scene: Scene, snapshots: Snapshots) -> None:
        self._method, self._scene, self._snapshots = method, scene, snapshots
        self._folds = validation_folds(snapshots)
        self.scores: dict[tuple[tuple[str, Any], ...], Score] = {}
        self.refusal: MorBenchError | None = None
        """Why a candidate could not be fitted, of the last one."""

    def whole_score(self, knobs: Mapping[str, Any]) -> Score:
        """On all folds, however far from the need."""
        return self._tried(knobs, np.inf)

    def score(self, knobs: Mapping[str, Any]) -> Score:
        key = tuple(sorted(knobs.items()))
        if key not in self.scores:
            self.scores[key] = self._tried(knobs)
        return self.scores[key]

    def _tried(self, knobs: Mapping[str, Any], hopeless: float = HOPELESS) -> Score:
        make: Any = type(self._method)
        candidate: Sizeable = make(**{**self._method.parameters, **knobs})
        errors: list[float] = []
        with counted() as cost:
            for fitted, held in self._folds:
                try:
                    with uncounted(), warnings.catch_warnings():
                        warnings.simplefilter(
                            "ignore"
                        )  # what concerns the fit to all samples is said there
                        candidate.fit(self._scene, self._snapshots[fitted])
                except MorBenchError as error:
                    self.refusal = error
                    return Score(np.inf, np.inf)
                errors += _relative_errors(candidate, self._snapshots[held])
                if np.median(errors) > hopeless * self._scene.spec.needs.error:
                    break
        return Score(float(np.median(errors)), cost.multiply_adds / len(errors))


def _relative_errors(method: Sizeable, samples: Snapshots) -> list[float]:
    """Relative l2 of each sample; infinity where there is no prediction."""
    errors, nodes = [], samples.scene.output_nodes
    for force, reference in zip(samples.forces, samples.displacements[:, nodes], strict=True):
        try:
            difference = float(np.linalg.norm(method.predict(force)[nodes] - reference))
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
    """Number of the least rung that meets the need; None if none does for less work than ``most_work``.

    Error is taken to fall and work to rise along a ladder, so that few rungs are tried.
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


def size_to_needs(
    method: Sizeable, scene: Scene, snapshots: Snapshots, rungs: Mapping[str, Sequence[Any]]
) -> dict[str, Any]:
    """As `choose_sizes`, for methods that are not written as `learn` and `prepare` yet."""
    if sizes := choose_sizes(method, scene, snapshots, rungs):
        method.sizes_ = sizes
    return {**method.parameters, **sizes}


def choose_sizes(
    method: Sizeable, scene: Scene, snapshots: Snapshots, rungs: Mapping[str, Sequence[Any]]
) -> dict[str, Any]:
    """The knobs of a method, those set to ``"auto"`` at the least work that meets the scene's need.

    Candidates are cross-validated: fitted to the training samples but for a fifth of the load regions, scored on these, and so
    for each fifth; the final fit, by the method itself, is to all samples. The work of a prediction is counted
    (`mor_bench.counting`), never timed, so that the choice is the same on every machine. The first knob of `rungs` is climbed
    from small to large, once for each combination of the others, with the most accurate one first; a looser one begins where
    that ended, and is given up where it takes more work than the best found.

    What is held out meets the need; a test set does so nearly: on beam-coarse, which needs 0.01, 27 modes of `pod` have an
    error of 0.0094 on what is held out and of 0.0102 on the test set, on beam-fine (6,720 samples) 19 modes 0.0088 and 0.0114,
    and on l-shape (1,280 samples) 12 modes 0.0077 and 0.0065. It costs some ten candidates, each of five fits and 200
    predictions: seconds on beam-coarse, minutes on beam-fine.

    Parameters
    ----------
    method : Surrogate
        Within its `fit`; its ``sizes_`` are set.
    scene : Scene
        Its need is ``scene.spec.needs.error``: relative l2, median.
    snapshots : Snapshots
        Training samples.
    rungs : dict of str to sequence
        Values that each knob may take, from cheap to accurate.

    Returns
    -------
    dict of str to Any
        All knobs of the method.

    Warns
    -----
    UserWarning
        If no candidate meets the need; then the most accurate one of those tried is taken.

    Raises
    ------
    InvalidInputError
        If there are too few samples to hold any out, or no candidate can be fitted at all.
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
            why = trials.refusal or "no candidate predicts half of the samples held out."
            raise InvalidInputError(f"no {', '.join(open_rungs)} could be chosen: {why}")
        said = ", ".join(f"{name} = {value}" for name, value in best.items())
        warnings.warn(
            f"{scene.name} needs a relative l2 of {need:g} (median); the most accurate candidate, {said}, reaches {reached:.3g} on the "
            "training samples held out.",
            stacklevel=3,
        )
    return best
