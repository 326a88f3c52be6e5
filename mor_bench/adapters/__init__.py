"""Doors to other tools: classes of other libraries, and files in other formats.

Here: objects and files that another tool takes or made, such as estimators of scikit-learn, data
sets of PyTorch, models of pyMOR and the layout of The Well. Not here: methods of the suite
(`surrogates`), this package's own files (`snapshots`, `results`), and files that are only looked
at (`export`). Nothing in the package imports this one. Each class is imported on first use, so that
it needs only its own library. Start with `sklearn_regressor.py`, then `pymor_model.py`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mor_bench.errors import MissingDependencyError

if TYPE_CHECKING:
    from mor_bench.adapters.sklearn_regressor import SurrogateRegressor as SurrogateRegressor
    from mor_bench.adapters.torch_snapshots import TorchSnapshots as TorchSnapshots

_HOMES = {
    "SurrogateRegressor": ("sklearn_regressor", "sklearn", "scikit-learn"),
    "TorchSnapshots": ("torch_snapshots", "torch", "'mor-bench[learn]'"),
}
"""For each public name: its module, the library that it needs, and what to install."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use.

    Raises
    ------
    MissingDependencyError
        If its library is not installed.
    """
    if name not in _HOMES:
        raise AttributeError(f"module 'mor_bench.adapters' has no attribute {name!r}")
    from importlib import import_module

    home, library, installed = _HOMES[name]
    try:
        return getattr(import_module(f"mor_bench.adapters.{home}"), name)
    except ModuleNotFoundError as error:
        if error.name != library:
            raise
        raise MissingDependencyError(f"{name} needs {library}: pip install {installed}") from error


def __dir__() -> list[str]:
    return __all__
