"""Other codes solve the same problem, and one that solves another is refused."""

from __future__ import annotations

import pytest

import mor_bench
from mor_bench.scene.scene import Scene
from tests.benchmarks.contenders import MAX_DIFFERENCE, DisagreementError
from tests.benchmarks.peers import PEERS, Entry, Ours, compare, pick_loads


@pytest.mark.parametrize("entry", PEERS, ids=lambda entry: entry.label)
def test_every_peer_agrees_with_our_solution(entry: Entry, tiny_scene: Scene) -> None:
    if entry.missing:
        pytest.skip(f"not installed: {', '.join(entry.missing)}")
    _, forces = pick_loads(tiny_scene, 1)
    rows = compare(tiny_scene, forces, [Ours(tiny_scene, "auto"), entry.make(tiny_scene)], rounds=1)
    assert rows[0].name != rows[1].name == entry.label
    assert all(row.differences[0] <= MAX_DIFFERENCE and row.steps[0] >= 3 for row in rows)


def test_another_problem_is_refused(tiny_scene: Scene) -> None:
    spec = tiny_scene.spec.model_dump(mode="json")
    spec["material"]["young_pa"] *= 1.01
    _, forces = pick_loads(tiny_scene, 1)
    with pytest.raises(DisagreementError, match="another problem"):
        compare(tiny_scene, forces, [Ours(mor_bench.load_scene(spec), "auto")], rounds=1)
