"""Detection of large errors by the flags of `Surrogate.out_of_range`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

IN_RANGE = ("in-range", "test")
"""Test sets of loads like those of training; the first that was scored defines the usual error."""

USUAL = 95
"""Percentile of the errors in range; a larger error is unusual."""


@dataclass(frozen=True)
class Flags:
    """The usual error in the training range, and the false alarms there.

    Attributes
    ----------
    in_range : str
        The test set with which both were measured.
    usual_rel_l2 : float
        95th percentile of the relative l2 error; infinite if more than 5 % have no prediction.
    n, n_flagged : int
        Samples of that test set, and false alarms among them.
    """

    in_range: str
    usual_rel_l2: float
    n: int
    n_flagged: int

    def of(self, score: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        """Count a test set's unusual errors and the flagged ones; `recall` is the flagged share."""
        unusual = score["relative_l2"] > self.usual_rel_l2
        n, found = int(unusual.sum()), int((unusual & score["flagged"]).sum())
        return {"n_unusual": n, "n_unusual_flagged": found, "recall": found / n if n else None}

    def as_dict(self, main: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        """Return the figures of a results row, given the scores of the main test set."""
        test = {"n": len(main["flagged"]), "n_flagged": int(main["flagged"].sum()), **self.of(main)}
        usual = {
            "in_range": self.in_range,
            "usual_rel_l2": self.usual_rel_l2,
            "n": self.n,
            "n_flagged": self.n_flagged,
        }
        return {**usual, "false_alarms": self.n_flagged / self.n, "test": test}


def flags_of(scores: Mapping[str, Mapping[str, NDArray[Any]]]) -> Flags | None:
    """Find the usual error from the scores of all test sets; None if the method has no flags."""
    if any("flagged" not in score for score in scores.values()):
        return None
    name = next(name for name in IN_RANGE if name in scores)
    usual = float(np.percentile(scores[name]["relative_l2"], USUAL, method="higher"))
    return Flags(name, usual, len(scores[name]["flagged"]), int(scores[name]["flagged"].sum()))
