"""Single samples as VTU files for ParaView."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import meshio
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.method_loading import load_surrogate
from mor_bench.scene.scene import Scene
from mor_bench.scratch import scratch_folder
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.store import write_atomically
from mor_bench.snapshots.test_sets import SET_NAMES, SetName
from mor_bench.surrogate import Surrogate

Part = Literal["train", "validation", "test"] | SetName

PARTS: tuple[Part, ...] = ("train", "validation", "test", *SET_NAMES)


def export_vtu(
    data: Dataset,
    sample: int,
    out: str | Path,
    *,
    part: Part = "test",
    models: Sequence[str | Path] = (),
) -> list[Path]:
    """Write a sample's reference and the models' predictions as VTU; return the files.

    Each file holds the mesh at rest with the point data `displacement`, m, and `force`, N. The file
    of a model also has `error`, m: its displacement minus the reference. ParaView's filter Warp By
    Vector shows the deformed body. In a scene with an embedded surface, a second file for each
    holds that surface.

    Parameters
    ----------
    data : Dataset
    sample : int
        Number of the sample in its part.
    out : path
        Folder; created if it does not exist.
    part : {"train", "validation", "test"} or the name of a test set
        The dataset must have been read with that test set.
    models : sequence of paths
        Fitted models, see `Surrogate.save`. Each file is named after its model's file.

    Raises
    ------
    InvalidInputError
        If the part or sample does not exist, a model belongs to another dataset, or two models have
        the same name.
    StoreError
        If a model is damaged.
    SolverError
        If a model finds no answer.
    """
    samples, out = samples_of(data, part), Path(out)
    if not 0 <= sample < len(samples):
        raise InvalidInputError(
            f"`sample` must be an integer in [0, {len(samples) - 1}], "
            f"the samples of part {part!r}; got {sample}."
        )
    names = ["reference", *(Path(model).stem for model in models)]
    if len(set(names)) < len(names):
        raise InvalidInputError(
            "models must have different names, and none may be called 'reference'; got "
            f"{', '.join(names[1:])}."
        )
    force, reference = samples.forces[sample], samples.displacements[sample]
    fields = [{"displacement": reference, "force": force}]
    for path in models:
        predicted = _model_of(data.scene, path).predict(samples.given[sample].query)
        fields.append({"displacement": predicted, "force": force, "error": predicted - reference})
    out.mkdir(parents=True, exist_ok=True)
    stems = [f"{data.scene.name}-{part}-{sample:05d}-{name}" for name in names]
    return [
        path
        for stem, found in zip(stems, fields, strict=True)
        for path in write_fields(data.scene, found, out, stem)
    ]


def samples_of(data: Dataset, part: Part) -> Snapshots:
    """Return a part of a dataset by name; `InvalidInputError` if it has no such part."""
    parts: dict[str, Snapshots] = {
        "train": data.train,
        "validation": data.validation,
        "test": data.test,
    }
    parts.update({str(name): samples for name, samples in data.tests.items()})
    if part not in parts:
        raise InvalidInputError(f"`part` must be {', '.join(parts)}; got {part!r}.")
    return parts[part]


def _model_of(scene: Scene, path: str | Path) -> Surrogate:
    """Load a model that was fitted to the same scene, with the same observed nodes."""
    model = load_surrogate(path)
    fitted = model.scene_
    if fitted.spec.physics() != scene.spec.physics() or _observed(fitted) != _observed(scene):
        raise InvalidInputError(
            f"{path}: the model was fitted to {fitted.name!r}, not to the current {scene.name!r}."
        )
    return model


def _observed(scene: Scene) -> list[int] | None:
    return None if scene.observed_nodes is None else scene.observed_nodes.tolist()


def write_fields(
    scene: Scene,
    fields: Mapping[str, NDArray[np.float64]],
    out: Path,
    stem: str,
    *,
    cell_fields: Mapping[str, NDArray[np.float64]] | None = None,
) -> list[Path]:
    """Write fields on the mesh at rest, and on the embedded surface if there is one.

    Parameters
    ----------
    scene : Scene
    fields : mapping of str to (n_nodes, 3) float64
        Point data; `force` stays at the nodes, because a sum over nodes cannot be interpolated.
    out : Path
        Existing folder of the files ``STEM.vtu`` and ``STEM-surface.vtu``.
    stem : str
    cell_fields : mapping of str to (n_cells,) float64, optional
        Cell data.
    """
    kind = {4: "tetra", 8: "hexahedron", 10: "tetra10"}[scene.mesh.cells.shape[1]]
    path, surface = out / f"{stem}.vtu", scene.embedded_surface
    in_cells = {name: [values] for name, values in (cell_fields or {}).items()}
    cells = [(kind, scene.mesh.cells)]
    _write_mesh(meshio.Mesh(scene.mesh.points, cells, dict(fields), in_cells), path)
    if surface is None:
        return [path]
    carried = {
        name: scene.to_surface @ values for name, values in fields.items() if name != "force"
    }
    skin = meshio.Mesh(surface.points, [("triangle", surface.facets)], point_data=carried)
    skin_path = out / f"{stem}-surface.vtu"
    _write_mesh(skin, skin_path)
    return [path, skin_path]


def _write_mesh(mesh: meshio.Mesh, path: Path) -> None:
    """Write a file whole or not at all; a link or pipe in its place is replaced."""
    with scratch_folder() as folder:
        mesh.write(folder / "mesh.vtu", binary=True)
        content = (folder / "mesh.vtu").read_bytes()
    write_atomically(path, content)
