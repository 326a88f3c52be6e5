"""Honest comparison of model-order-reduction methods for real-time hyperelastic solids.

>>> import mor_bench
>>> scene = mor_bench.load_scene("beam-tiny")
>>> scene.mesh.points.shape
(63, 3)
>>> method = mor_bench.load_method("linear-fem").fit(scene, None)
>>> method.predict(scene.mesh.points * 0.0).shape
(63, 3)

The packages, from the ground up; each imports only from those before it:

`specs` and `options` define the input of users. `scene`, `mechanics`, `snapshots` and `reduction`
compute. `surrogate.py` is the interface of a method; `learning` and `surrogates` hold the methods.
`sandbox`, `measure`, `results`, `analysis` and `runs` make a comparison. `hard_cases` holds the
stress tests. `report`, `export` and `cli` show the results. `adapters` opens doors to other tools,
and nothing else imports it. Start reading with `surrogate.py`, then
`surrogates/pod.py`, then `runs/compare.py`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mor_bench.version import __version__ as __version__

if TYPE_CHECKING:
    from mor_bench.errors import MorBenchError as MorBenchError
    from mor_bench.measure.error_bounds import ErrorBound as ErrorBound
    from mor_bench.measure.error_bounds import error_bound as error_bound
    from mor_bench.mechanics.reactions import reaction_forces as reaction_forces
    from mor_bench.mechanics.reactions import tool_forces as tool_forces
    from mor_bench.mechanics.stresses import Stresses as Stresses
    from mor_bench.mechanics.stresses import stresses as stresses
    from mor_bench.method_loading import load_method as load_method
    from mor_bench.method_loading import load_surrogate as load_surrogate
    from mor_bench.reduction.greedy import choose_snapshots as choose_snapshots
    from mor_bench.report.notebook import Comparison as Comparison
    from mor_bench.report.notebook import run as run
    from mor_bench.runs.pick import Verdict as Verdict
    from mor_bench.runs.pick import pick as pick
    from mor_bench.runs.single_fit import Fit as Fit
    from mor_bench.runs.single_fit import fit as fit
    from mor_bench.scene.scene import Scene as Scene
    from mor_bench.scene.scene import load_scene as load_scene
    from mor_bench.snapshots.dataset import Dataset as Dataset
    from mor_bench.snapshots.dataset import Snapshots as Snapshots
    from mor_bench.snapshots.dataset import load_dataset as load_dataset
    from mor_bench.surrogate import Surrogate as Surrogate

_HOMES = {
    "Comparison": "mor_bench.report.notebook",
    "Dataset": "mor_bench.snapshots.dataset",
    "ErrorBound": "mor_bench.measure.error_bounds",
    "Fit": "mor_bench.runs.single_fit",
    "MorBenchError": "mor_bench.errors",
    "Scene": "mor_bench.scene.scene",
    "Snapshots": "mor_bench.snapshots.dataset",
    "Stresses": "mor_bench.mechanics.stresses",
    "Surrogate": "mor_bench.surrogate",
    "Verdict": "mor_bench.runs.pick",
    "choose_snapshots": "mor_bench.reduction.greedy",
    "error_bound": "mor_bench.measure.error_bounds",
    "fit": "mor_bench.runs.single_fit",
    "load_dataset": "mor_bench.snapshots.dataset",
    "load_method": "mor_bench.method_loading",
    "load_scene": "mor_bench.scene.scene",
    "load_surrogate": "mor_bench.method_loading",
    "pick": "mor_bench.runs.pick",
    "reaction_forces": "mor_bench.mechanics.reactions",
    "run": "mor_bench.report.notebook",
    "stresses": "mor_bench.mechanics.stresses",
    "tool_forces": "mor_bench.mechanics.reactions",
}


__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `import mor_bench` is fast."""
    if name not in _HOMES:
        raise AttributeError(f"module 'mor_bench' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
