"""The experiment that shows how far timings can be trusted still runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from mor_bench.scene.scene import load_scene
from tests.verification.timing_trust import DATASET, pairs


@pytest.mark.slow
def test_a_pair_of_timings_gives_the_counts_of_the_matrix(tmp_path: Path) -> None:
    found = pairs(load_scene(DATASET), tmp_path, 1)
    assert found["of"] == 1
    for protocol in ("quick", "full"):
        assert set(found[protocol]) == {"identical_called_different", "slowed_found"}
        assert set(found[protocol].values()) <= {0, 1}
