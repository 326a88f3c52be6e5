"""Whether a method says so where its errors are large: the flags of `Surrogate.out_of_range` beside measured errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

IN_RANGE = ("in-range", "test")
"""Test sets of loads like those of training; the first that was scored tells what errors are usual."""

USUAL = 95
"""Percentile of the errors in range above which an error is unusual."""


@dataclass(frozen=True)
class Flags:
    """What is usual in the training range.

    Attributes
    ----------
    in_range : str
        The test set that it was measured on.
    usual_rel_l2 : float
        95th percentile of the relative l2 there; infinite if more than one in twenty has no
        prediction.
    n, n_flagged : int
        Loads there, and those that are flagged all the same: false alarms.
    """

    in_range: str
    usual_rel_l2: float
    n: int
    n_flagged: int

    def of(self, score: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        """Of a test set: `n_unusual` errors beyond the usual, how many of these are flagged, and their share, the `recall`; None without any."""
        unusual = score["relative_l2"] > self.usual_rel_l2
        n, found = int(unusual.sum()), int((unusual & score["flagged"]).sum())
        return {"n_unusual": n, "n_unusual_flagged": found, "recall": found / n if n else None}

    def as_dict(self, main: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        """For a row, with the figures of the main test set."""
        test = {"n": len(main["flagged"]), "n_flagged": int(main["flagged"].sum()), **self.of(main)}
        usual = {
            "in_range": self.in_range,
            "usual_rel_l2": self.usual_rel_l2,
            "n": self.n,
            "n_flagged": self.n_flagged,
        }
        return {**usual, "false_alarms": self.n_flagged / self.n, "test": test}


def flags_of(scores: Mapping[str, Mapping[str, NDArray[Any]]]) -> Flags | None:
    """What is usual in range, by the scores of the test sets; None if the method does not know its range."""
    if any("flagged" not in score for score in scores.values()):
        return None
    name = next(name for name in IN_RANGE if name in scores)
    usual = float(np.percentile(scores[name]["relative_l2"], USUAL, method="higher"))
    return Flags(name, usual, len(scores[name]["flagged"]), int(scores[name]["flagged"].sum()))
