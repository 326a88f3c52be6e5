"""Methods without snapshots, fitted in each process that times them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mor_bench.measure.latency import TimedMethod
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.process import SandboxedProcess
from mor_bench.scene.scene import Scene


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
