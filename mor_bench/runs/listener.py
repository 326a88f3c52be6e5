"""Callbacks that follow a run or a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mor_bench.results.row import Row


def _ignore(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Listener:
    """Callbacks for the progress of a run; each does nothing by default.

    Attributes
    ----------
    compiling : callable
        Called with (method, methods done, methods to compile) before each method, and at the end.
    generating : callable
        Called with (dataset, samples done, samples wanted).
    starting : callable
        Called with (dataset, label, number of the configuration, number of configurations).
    fitted : callable
        Called with a row that is scored but not yet timed.
    repeating : callable
        Called with (dataset, label, stage) before each further fit of a configuration, in the stage
        "other seeds" or "learning curve".
    timing : callable
        Called with (dataset, typical time of what is done, that of all), ms.
    finished : callable
        Called with a complete row.
    training : callable
        Called with (iterations done, all iterations, loss) during a single fit.
    """

    compiling: Callable[[str, int, int], None] = _ignore
    generating: Callable[[str, int, int], None] = _ignore
    starting: Callable[[str, str, int, int], None] = _ignore
    fitted: Callable[[Row], None] = _ignore
    repeating: Callable[[str, str, str], None] = _ignore
    timing: Callable[[str, int, int], None] = _ignore
    finished: Callable[[Row], None] = _ignore
    training: Callable[[int, int, float], None] = _ignore
