"""Hand snapshots over to sandboxed processes as NumPy files, one per array."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mor_bench.array_files import read_npy
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.snapshots.patch_loads import PatchLoads


def arrays_of(snapshots: Snapshots) -> dict[str, NDArray[np.generic]]:
    """Return every array of some snapshots, by name; the scene is left out."""
    loads = snapshots.loads
    forces = (
        {"forces": loads.forces} if isinstance(loads, NodalLoads) else {"vectors": loads.vectors}
    )
    if snapshots.scene.parameter_names:
        forces["parameters"] = snapshots.parameters
    return {
        "patches": loads.patches,
        **forces,
        "free_displacements": snapshots.free_displacements,
        "min_det_f": snapshots.min_det_f,
    }


def write_snapshots(folder: Path, snapshots: Snapshots) -> None:
    """Write the arrays of snapshots to a new folder."""
    write_arrays(folder, arrays_of(snapshots))


def write_arrays(folder: Path, arrays: Mapping[str, NDArray[np.generic]]) -> None:
    """Write arrays to a new folder, one file each."""
    folder.mkdir()
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array, allow_pickle=False)


def read_snapshots(folder: Path, scene: Scene) -> Snapshots:
    """Read what `write_snapshots` wrote. The large arrays are memory-mapped and read-only."""
    arrays = {path.stem: read_npy(path) for path in folder.glob("*.npy")}
    patches = arrays["patches"]
    loads = (
        NodalLoads(arrays["forces"], patches)
        if "forces" in arrays
        else PatchLoads(patches, arrays["vectors"], arrays.get("parameters"))
    )
    return Snapshots(scene, loads, arrays["free_displacements"], arrays["min_det_f"])
