"""Samples are a data set of PyTorch: the same numbers, in batches, parts and worker processes."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.sampling import draw_loads
from tests.observed_scenes import scene_of

pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

import torch
from torch.utils.data import DataLoader, random_split

from mor_bench.adapters import TorchSnapshots


@pytest.fixture
def part(tiny: Dataset) -> Snapshots:
    return tiny.train[:20]


def collected(loader: Any) -> tuple[Any, Any]:
    forces, displacements = zip(*loader, strict=True)
    return torch.cat(forces).numpy(), torch.cat(displacements).numpy()


def test_samples_are_float32_tensors_of_forces_and_displacements(part: Snapshots) -> None:
    data = TorchSnapshots(part)
    assert isinstance(data, torch.utils.data.Dataset)
    assert len(data) == 20
    for number in (0, 7, 19, -1, -20):
        force, displacement = data[number]
        assert force.dtype == displacement.dtype == torch.float32
        np.testing.assert_array_equal(force, part.forces[number].astype(np.float32))
        np.testing.assert_array_equal(displacement, part.displacements[number].astype(np.float32))
    for number in (20, -21):
        with pytest.raises(IndexError, match=f"sample {number} of 20"):
            data[number]
    rows: Any = data
    assert len(list(rows)) == 20


def test_only_integers_number_samples(part: Snapshots) -> None:
    data: Any = TorchSnapshots(part)
    for number in (np.int32(7), torch.tensor(7)):
        np.testing.assert_array_equal(data[number][0], data[7][0])
        np.testing.assert_array_equal(data.__getitems__([number, 1])[0][0], data[7][0])
    for index in (1.5, slice(0, 3), "1", [1]):
        with pytest.raises(InvalidInputError, match="must be an integer; got"):
            data[index]
    with pytest.raises(InvalidInputError, match=r"must be integers; got \[0, 1.5\]"):
        data.__getitems__([0, 1.5])
    assert data.__getitems__([]) == []


@pytest.mark.parametrize("workers", [0, 2])
def test_a_loader_gives_all_samples_in_batches(part: Snapshots, workers: int) -> None:
    loader = DataLoader(TorchSnapshots(part), batch_size=6, num_workers=workers)
    assert [len(force) for force, _ in loader] == [6, 6, 6, 2]
    forces, displacements = collected(loader)
    np.testing.assert_array_equal(forces, part.forces.astype(np.float32))
    np.testing.assert_array_equal(displacements, part.displacements.astype(np.float32))


def test_parts_of_a_random_split_hold_each_sample_once(part: Snapshots) -> None:
    parts = random_split(TorchSnapshots(part), [0.7, 0.3], torch.Generator().manual_seed(0))
    assert [len(p) for p in parts] == [14, 6]
    loaders = [DataLoader(p, batch_size=4, shuffle=True) for p in parts]
    found = np.concatenate([collected(loader)[1] for loader in loaders])
    expected = part.displacements.astype(np.float32)
    order, known = (np.lexsort(a.reshape(20, -1).T) for a in (found, expected))
    np.testing.assert_array_equal(found[order], expected[known])


def test_a_batch_is_computed_at_once_and_nothing_is_kept(part: Snapshots) -> None:
    """The nodal forces of all samples are cached only if somebody asks the samples for them."""
    data = TorchSnapshots(part)
    calls: list[int] = []
    one = Snapshots.__getitem__

    def counting(self: Snapshots, index: Any) -> Snapshots:
        calls.append(len(index))
        return one(self, index)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Snapshots, "__getitem__", counting)
        for _ in DataLoader(data, batch_size=10):
            pass
    assert calls == [10, 10]
    assert not vars(part).keys() & {"forces", "displacements", "given"}


def test_a_tensor_may_be_changed_without_changing_the_samples(part: Snapshots) -> None:
    data = TorchSnapshots(part)
    force, displacement = data[0]
    force += 1.0
    displacement.zero_()
    np.testing.assert_array_equal(data[0][0], part.forces[0].astype(np.float32))
    assert data[0][1].abs().max() > 0


def test_it_can_be_sent_to_another_process(part: Snapshots) -> None:
    copied = pickle.loads(pickle.dumps(TorchSnapshots(part)))
    np.testing.assert_array_equal(copied[3][0], part.forces[3].astype(np.float32))


def test_observed_displacements_replace_the_forces(part: Snapshots) -> None:
    scene = scene_of({"region": "z-max"})
    seen = replace(part, scene=scene)
    given, displacement = TorchSnapshots(seen)[2]
    nodes = scene.observed_nodes
    assert nodes is not None
    hidden = np.setdiff1d(np.arange(scene.mesh.n_nodes), nodes)
    assert not given[hidden].any()
    np.testing.assert_array_equal(given[nodes], displacement[nodes])
    assert given.any()


def test_sampled_parameters_stand_between_forces_and_displacements() -> None:
    scene = mor_bench.load_scene("beam-stiffness")
    loads = draw_loads(scene, 0, 3)
    moved = np.random.default_rng(0).normal(size=(3, len(scene.free_dofs)))
    batch = next(iter(DataLoader(TorchSnapshots(Snapshots(scene, loads, moved, moved[:, 0])), 3)))
    assert [tuple(tensor.shape) for tensor in batch] == [
        (3, scene.mesh.n_nodes, 3),
        (3, len(scene.parameter_names)),
        (3, scene.mesh.n_nodes, 3),
    ]
    np.testing.assert_array_equal(batch[1], loads.parameters.astype(np.float32))


def test_anything_but_snapshots_is_refused(tiny: Dataset) -> None:
    wrong: Any = tiny
    with pytest.raises(InvalidInputError, match=r"must be Snapshots.*; got Dataset"):
        TorchSnapshots(wrong)
