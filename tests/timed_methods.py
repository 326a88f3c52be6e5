"""Methods that can be timed: fitted in each process that times them, or loaded there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mor_bench.measure.latency import TimedMethod
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.method_loading import make_surrogate
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.process import SandboxedProcess
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import load_class


def timed_method(
    scene: Scene, folder: Path, surrogate: str, parameters: dict[str, Any]
) -> TimedMethod:
    """Return a configuration that can be timed.

    Parameters
    ----------
    folder : Path
        Where the model is saved.
    surrogate : str
        The class, ``package.module:Class``.
    """
    request = FitRequest(surrogate, parameters, folder, folder / "model.safetensors", 1, 60.0)

    def opened(server: ForkServer | None) -> SandboxedProcess:
        process = SandboxedProcess(MethodSession, fork_server=server, scene=scene)
        process.ask("fit", request.limit_s, request=request)
        return process

    return TimedMethod(opened, 1e8)


def fitted_method(
    scene: Scene, model: Path, surrogate: str, parameters: dict[str, Any], samples: Snapshots
) -> TimedMethod:
    """Fit a configuration here and save it as `model`, which each process that times it loads."""
    make_surrogate(load_class(surrogate), parameters).fit(scene, samples).save(model)

    def opened(server: ForkServer | None) -> SandboxedProcess:
        process = SandboxedProcess(MethodSession, fork_server=server, scene=scene)
        process.ask("load", 60.0, surrogate=surrogate, model=model)
        return process

    return TimedMethod(opened, 1e8)
