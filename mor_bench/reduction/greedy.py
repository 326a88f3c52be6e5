"""Adaptive sampling: solve next for the training loads under which a method probably errs most.

This is the weak greedy algorithm of reduced basis methods: Binev et al., SIAM Journal on
Mathematical Analysis 43 (2011). The estimated error is the field of
`mor_bench.mechanics.indicator`, so any method can be asked and no candidate is solved for. A round
chooses several loads at once. Each has the largest estimated error that no error field chosen
before it in the round explains.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from time import process_time
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from mor_bench.errors import InvalidInputError, SolverError, UnsupportedSceneError, is_integer
from mor_bench.mechanics.indicator import ErrorIndicator
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import Solution
from mor_bench.mechanics.pressed import full_order_model
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import draw_loads, n_samples_of
from mor_bench.snapshots.split import split_samples
from mor_bench.specs import CONTACT, NO_FORCES, AnyDatasetSpec

Array = NDArray[np.float64]

FIRST = 10
"""Number of snapshots whose loads are drawn at random, before there is a method to ask."""
GROWTH = 4
"""Each round adds one snapshot for so many that are there, so that few fits are needed."""
CANDIDATES = 4
"""Default number of candidates for each load that is chosen."""
SEED = 0xADA7


class Learner(Protocol):
    """The part of `mor_bench.Surrogate` that the choice uses."""

    needs_snapshots: ClassVar[bool]

    def supports(self, scene: Scene) -> str | None: ...
    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Any: ...
    def predict(self, forces: ArrayLike) -> Array: ...


def choose_snapshots(
    method: Learner,
    source: str | Path | Mapping[str, Any] | AnyDatasetSpec,
    n: int,
    *,
    candidates: int = CANDIDATES,
    seed: int = 0,
) -> Snapshots:
    """Choose n training loads of a dataset for a method, and solve for these only.

    Use it where a solve is so expensive that the training loads of a dataset cannot all be solved
    for. The first loads are drawn at random. Then, in rounds, a copy of the method is fitted to the
    snapshots so far, and the loads are chosen whose estimated errors are largest.

    All candidates are training loads of the dataset's plan and split. Under a split by sample, they
    are those of `load_dataset` only if every load of the plan has an equilibrium.

    Parameters
    ----------
    method : Surrogate
        It is not changed. Fit it to the result.
    source : str, Path, dict or DatasetSpec
        Name of a dataset in the suite, path of a TOML, a dict with the same keys, or a spec.
    n : int
        Number of snapshots, at most the number of training loads.
    candidates : int
        Number of loads whose errors are estimated for each load that is chosen. An estimate costs a
        prediction and about one iteration of the full-order solve.
    seed : int
        Seed of the random draws.

    Returns
    -------
    Snapshots
        The solved loads in the order of their choice.

    Raises
    ------
    SpecError
        If the dataset is not valid.
    UnsupportedSceneError
        If the method cannot handle the scene, or errors cannot be estimated in it: its equations or
        forces are unknown, its parameters are sampled, its loads act in steps, or `needs.outputs`
        names a part of the nodes.
    InvalidInputError
        If a number is out of range, the method learns from no snapshots, or fewer than n training
        loads have an equilibrium.

    Examples
    --------
    >>> import mor_bench
    >>> method = mor_bench.load_method("pod", n_modes=10)
    >>> chosen = mor_bench.choose_snapshots(method, "beam-tiny", 20)
    >>> len(chosen)
    20
    >>> method.fit(chosen.scene, chosen).predict(chosen.forces[0]).shape
    (63, 3)
    """
    scene = load_scene(source)
    check_supported(method, scene)
    return GreedySampling(method, scene, training_loads(scene), candidates, seed).grow(n)


def training_loads(scene: Scene) -> PatchLoads:
    """Return the training loads of a scene's plan and split, without solving for any."""
    spec = scene.generated
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    parts = split_samples(drawn, len(scene.patch_nodes), spec.split, spec.load_plan.seed)
    return drawn[parts.train]


def check_supported(method: Learner, scene: Scene) -> None:
    """Raise an error unless snapshots can be chosen for a method; see `choose_snapshots`."""
    if isinstance(method, type) or not hasattr(method, "needs_snapshots"):
        raise InvalidInputError(
            "`method` must be a method, such as mor_bench.load_method('pod'); "
            f"got {type(method).__name__} {method!r}."
        )
    if not method.needs_snapshots:
        raise InvalidInputError(
            f"`method` must learn from snapshots; {type(method).__name__} learns from none."
        )
    if reason := _no_estimates(scene) or method.supports(scene):
        raise UnsupportedSceneError(f"{scene.name}: snapshots cannot be chosen: {reason}.")


def _no_estimates(scene: Scene) -> str | None:
    """Return why errors cannot be estimated in a scene; None if they can."""
    if reason := unknown_equations(scene, observed=True):
        return reason
    if scene.observed_nodes is not None:
        return CONTACT if scene.contact else NO_FORCES
    if scene.parameter_names:
        return "its bodies have sampled parameters"
    if scene.generated.load_plan.steps > 1:
        return "its loads act in steps"
    if len(scene.output_nodes) < scene.mesh.n_nodes:
        return "`needs.outputs` names a part of the nodes, and the estimate needs them all"
    return None


class GreedySampling:
    """Snapshots of chosen loads, which `grow` as long as there are loads.

    Parameters
    ----------
    method : Surrogate
        A copy of it is fitted in each round.
    scene : Scene
        A scene that passes `check_supported`.
    loads : PatchLoads
        All loads that may be chosen.
    candidates : int
        Number of loads whose errors are estimated for each load that is chosen.
    seed : int

    Attributes
    ----------
    method : Surrogate
        The copy.
    snapshots : Snapshots
        The solved loads in the order of their choice.
    n_refused : int
        Chosen loads without an equilibrium.
    core_s : dict of str to float
        Core-seconds of the solves ("solve"), of the fits between them ("fit"), and of predictions,
        estimates and choices ("choose"). The set-up of the full-order model is not included.

    Raises
    ------
    InvalidInputError
        If `candidates` is less than 1, or `seed` is negative.
    """

    def __init__(
        self,
        method: Learner,
        scene: Scene,
        loads: PatchLoads,
        candidates: int = CANDIDATES,
        seed: int = 0,
    ) -> None:
        if not is_integer(candidates) or candidates < 1:
            raise InvalidInputError(f"`candidates` must be an integer >= 1; got {candidates!r}.")
        if not is_integer(seed) or seed < 0:
            raise InvalidInputError(f"`seed` must be an integer >= 0; got {seed!r}.")
        self.method, self.scene, self.loads = copy(method), scene, loads
        self.random = np.random.default_rng([SEED, seed])
        self._candidates, self._left = candidates, self.random.permutation(len(loads))
        self.core_s = dict.fromkeys(("solve", "fit", "choose"), 0.0)
        self._model, self._indicator = full_order_model(scene), ErrorIndicator(scene)
        self._model.prepare()
        nothing = np.zeros((0, len(scene.free_dofs)))
        self.snapshots = Snapshots(scene, loads[:0], nothing, np.zeros(0))
        self.n_refused = 0

    def grow(self, n: int) -> Snapshots:
        """Choose and solve until there are n snapshots; return all of them.

        Raises
        ------
        InvalidInputError
            If n is no integer from 1 to the number of loads, or too few loads have an equilibrium.
        """
        if not is_integer(n) or not 1 <= n <= len(self.loads):
            raise InvalidInputError(
                f"`n` must be an integer in [1, {len(self.loads)}], the number of training loads; "
                f"got {n!r}."
            )
        while (have := len(self.snapshots)) < n:
            if have < FIRST:
                self._require_loads()
                self.add(self._take(np.arange(len(self._left))[: min(n, FIRST) - have]))
            else:
                self.add(self.choose(min(n - have, have // GROWTH)))
        return self.snapshots

    def _require_loads(self) -> None:
        if not len(self._left):
            raise InvalidInputError(
                f"`n` must be at most {len(self.snapshots)}: {self.n_refused} of the "
                f"{len(self.loads)} training loads have no equilibrium."
            )

    def _take(self, places: NDArray[np.int64]) -> PatchLoads:
        """Remove some of the loads that are left, and return them."""
        chosen = self.loads[self._left[places]]
        self._left = np.delete(self._left, places)
        return chosen

    def add(self, loads: PatchLoads) -> None:
        """Solve for loads, and add those with an equilibrium to the snapshots."""
        with self.timed("solve"):
            found = solved(self._model, loads)
        self.n_refused += len(loads) - len(found)
        before = self.snapshots
        both = PatchLoads(
            np.concatenate([before.loads.patches, found.loads.patches]),
            np.concatenate([before.loads.vectors, found.loads.vectors]),
        )
        self.snapshots = Snapshots(
            self.scene,
            both,
            np.concatenate([before.free_displacements, found.free_displacements]),
            np.concatenate([before.min_det_f, found.min_det_f]),
        )

    def choose(self, k: int) -> PatchLoads:
        """Fit to the snapshots, and remove and return up to k loads with large estimated errors."""
        self._require_loads()
        self.fit(self.snapshots)
        with self.timed("choose"):
            self._left = self.random.permutation(self._left)
            asked = self.loads[self._left[: k * self._candidates]]
            return self._take(worst(self.estimated_errors(asked), k))

    def fit(self, snapshots: Snapshots) -> None:
        """Fit the method, without its warnings; a fit to the result repeats them."""
        with self.timed("fit"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.method.fit(self.scene, snapshots)

    def estimated_errors(self, loads: PatchLoads) -> Array:
        """Return the fields of the estimated errors of the fitted method, (n, n_free).

        Each is relative to the norm of the prediction. It is not finite if there is no prediction.
        """
        forces = loads.nodal_forces(self.scene.patch_weights)
        predicted = self.predicted(forces)
        pulls, u = (
            self.scene.at_free_dofs(field.reshape(len(loads), -1)) for field in (forces, predicted)
        )
        sizes = np.linalg.norm(u, axis=1, keepdims=True)
        found = np.full(u.shape, np.nan)
        for row in np.flatnonzero(np.isfinite(sizes)):
            found[row] = self._indicator.correction(pulls[row], u[row])
        return found / np.where(sizes > 0, sizes, 1.0)

    def predicted(self, forces: Array) -> Array:
        """Return predictions of the fitted method, m, in the shape of the forces; NaN for none."""
        try:
            return self.method.predict(forces)
        except SolverError:
            found = np.full(forces.shape, np.nan)
            for row, force in zip(found, forces, strict=True):
                try:
                    row[:] = self.method.predict(force)
                except SolverError:
                    continue
            return found

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the core-seconds of a block to `core_s`."""
        begun = process_time()
        yield
        self.core_s[name] += process_time() - begun


def solved(model: FullOrderModel, loads: PatchLoads) -> Snapshots:
    """Return the snapshots of those loads that have a valid equilibrium."""
    scene = model.scene
    forces = loads.nodal_forces(scene.patch_weights).reshape(len(loads), -1)
    found = model.solve_many(scene.at_free_dofs(forces))
    rows = np.array([isinstance(one, Solution) for one in found], dtype=bool)
    solutions = [one for one in found if isinstance(one, Solution)]
    displacements = np.array([one.displacement for one in solutions])
    return Snapshots(
        scene,
        loads[np.flatnonzero(rows)],
        displacements.reshape(-1, len(scene.free_dofs)),
        np.array([one.min_det_f for one in solutions]),
    )


def worst(errors: Array, k: int) -> NDArray[np.int64]:
    """Return the numbers of up to k large and different error fields, the largest first.

    Fields that are not finite come first. Then each is the one with the largest part outside the
    span of those before it: the pivots of a QR decomposition with column pivoting.

    Parameters
    ----------
    errors : (n, n_free) float64
    k : int
    """
    finite = np.isfinite(errors).all(axis=1)
    rows = np.flatnonzero(finite)
    pivots = qr(errors[rows].T, mode="r", pivoting=True)[1] if len(rows) else rows
    return np.concatenate([np.flatnonzero(~finite), rows[pivots]])[:k]
