"""What passes between a run and the processes of its methods, as plain NumPy files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.snapshots.sampling import PatchLoads
from mor_bench.surrogate import Surrogate


def arrays_of(snapshots: Snapshots) -> dict[str, NDArray[np.generic]]:
    """All that snapshots hold beside their scene."""
    loads = snapshots.loads
    forces = (
        {"forces": loads.forces} if isinstance(loads, NodalLoads) else {"vectors": loads.vectors}
    )
    return {
        "patches": loads.patches,
        **forces,
        "free_displacements": snapshots.free_displacements,
        "min_det_f": snapshots.min_det_f,
    }


def write_snapshots(folder: Path, snapshots: Snapshots) -> None:
    """Write snapshots to a new folder, a file per array."""
    folder.mkdir()
    for name, array in arrays_of(snapshots).items():
        np.save(folder / f"{name}.npy", array, allow_pickle=False)


def read_snapshots(folder: Path, scene: Scene) -> Snapshots:
    """Read what `write_snapshots` wrote; the arrays are read-only."""
    arrays = {
        path.stem: np.load(path, mmap_mode="r", allow_pickle=False) for path in folder.glob("*.npy")
    }
    patches = np.asarray(arrays["patches"])
    loads = (
        NodalLoads(arrays["forces"], patches)
        if "forces" in arrays
        else PatchLoads(patches, np.asarray(arrays["vectors"]))
    )
    return Snapshots(scene, loads, arrays["free_displacements"], arrays["min_det_f"])


def predict_all(method: Surrogate, forces: NDArray[np.float64]) -> NDArray[np.float64]:
    """Predictions (n, n_nodes, 3), m; NaN where the method found no equilibrium, which counts as an infinite error.

    Parameters
    ----------
    method : Surrogate
    forces : (n, n_nodes, 3) float64
        N.

    Raises
    ------
    InvalidInputError
        If the method answers with another shape or no floats.
    """
    try:
        # Copies: what a method does to its input must not reach the scoring.
        predicted = np.asarray(method.predict(forces.copy()))
    except SolverError:
        predicted = np.full(forces.shape, np.nan)
        for answer, force in zip(predicted, forces, strict=True):
            try:
                answer[:] = method.predict(force.copy())
            except SolverError:
                continue
    if predicted.shape != forces.shape or predicted.dtype.kind != "f":
        raise InvalidInputError(
            f"`predict` must return floats of shape {forces.shape}; it returned {predicted.dtype} of shape {predicted.shape}."
        )
    return predicted.astype(np.float64, copy=False)
