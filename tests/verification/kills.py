"""Kill runs, fits and generations at random moments; then check results, files and processes.

    python -m tests.verification.kills --kills 50

kills each command 50 times with each of SIGKILL, SIGTERM and SIGHUP, in about an hour. The command
is repeated until it ends, killed or not, and then starts over in an empty folder. It must give the
same bytes as an undisturbed one. One second after a kill no process of it may be left. After a
repetition that ended there must be the same files and folders as after an undisturbed one; after
SIGTERM and SIGHUP no temporary ones may be left.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]

MARK = "MOR_BENCH_KILL_TEST"
"""Environment variable by which all processes of a command are found."""

SIGNALS = ("SIGKILL", "SIGTERM", "SIGHUP")

KILLS = 50
"""Kills of each command by each signal."""

GRACE_S = 1.0
"""Time for which a process may outlive the command, s; longer if processes wait for a core."""

FIT = ["fit", "beam-tiny", "-m", "umesh-small", "--set", "iterations=150", "--limit", "200"]
FIT += ["--set", "inference=packed"]  # "auto" keeps times in the model
RUN = ["run", "beam-tiny", "--limit", "200"]
COMMANDS = {
    "generate": ["generate", "beam-tiny", "--workers", "2"],
    "fit": [*FIT, "--threads", "1", "--out", "net.safetensors"],
    "run": [*RUN, "-m", "linear-fem", "-m", "pod[n_modes=5]", "--out", "out"],
}

EXACT = ("*.safetensors", "shard-*.h5")
"""Files that must not depend on interruptions; results.json is compared without times."""


@dataclass(frozen=True)
class Undisturbed:
    """Results, files and seconds of a command that nothing disturbed."""

    command: str
    results: dict[str, str]
    files: set[str]
    seconds: float


@dataclass
class Outcome:
    """Number of kills that hit, and everything that was wrong."""

    kills: int = 0
    finished: int = 0
    wrong: list[str] = field(default_factory=list)


def result(folder: Path) -> dict[str, str]:
    """Return a digest of every result in a folder."""
    found = {
        path.name if path.parent == folder else f"{path.parent.name}/{path.name}": hashlib.sha256(
            path.read_bytes()
        ).hexdigest()
        for pattern in EXACT
        for path in folder.rglob(pattern)
        if not path.name.startswith(".")
    }
    for path in folder.glob("out/results.json"):
        rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
        found["rows"] = json.dumps(
            [[row[key] for key in ("label", "status", "error", "sizes", "cost")] for row in rows]
        )
    return found


def everything(folder: Path) -> set[str]:
    """Return all files and folders below a folder."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def leftovers(folder: Path) -> list[str]:
    """Return the temporary files and folders below a folder."""
    patterns = ("*.tmp", ".*.tmp", "tmp/mor-bench-*", ".running", ".*.checkpoint")
    return sorted({str(path) for pattern in patterns for path in folder.rglob(pattern)})


def outliving(folder: Path) -> list[str]:
    """Return the processes that outlive a command that was killed a moment ago."""
    time.sleep(GRACE_S * max(1.0, psutil.getloadavg()[0] / (os.cpu_count() or 1)))
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(MARK) == str(folder) and process.status() != "zombie":
                found.append(" ".join(["outlived:", *process.cmdline()[1:]]))
        except psutil.Error:
            continue
    return found


def start(command: str, folder: Path) -> subprocess.Popen[bytes]:
    (folder / "tmp").mkdir(parents=True, exist_ok=True)
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "TMPDIR": str(folder / "tmp"),
        MARK: str(folder),
    }
    with open(folder / "log.txt", "ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "mor_bench", *COMMANDS[command], "--cache", "cache"],
            cwd=folder,
            env=environment,
            stdout=log,
            stderr=log,
        )


def undisturbed(command: str, folder: Path) -> Undisturbed:
    """Run a command that nothing disturbs."""
    begun = time.monotonic()
    code = start(command, folder).wait()
    assert code == 0, (folder / "log.txt").read_text(encoding="utf-8")
    seconds = time.monotonic() - begun
    return Undisturbed(command, result(folder), everything(folder), seconds)


def kill_often(
    expected: Undisturbed, number: signal.Signals, kills: int, parent: Path, seed: int
) -> Outcome:
    """Kill a command many times and compare it with an undisturbed one."""
    draw, outcome, command = random.Random(seed), Outcome(), expected.command
    folder = parent / f"{command}-{number.name}-0"
    if number != signal.SIGKILL:  # `nohup` or a shell may have told this process to ignore it,
        signal.signal(number, signal.SIG_DFL)  # and so its children
    while outcome.kills < kills:
        process = start(command, folder)
        try:
            code = process.wait(draw.uniform(0.0, expected.seconds))
        except subprocess.TimeoutExpired:
            process.send_signal(number)
            code = process.wait()
        outcome.wrong += outliving(folder)
        if code == 0:
            _check_end(folder, expected, outcome)
            folder = folder.with_name(f"{command}-{number.name}-{outcome.finished}")
            continue
        outcome.kills += 1
        if code not in (-number, 128 + number):
            outcome.wrong.append(f"exit code {code}")
        if number != signal.SIGKILL and code != -number:
            outcome.wrong += leftovers_of_stopped(folder)
    code = start(command, folder).wait()
    if code:
        outcome.wrong.append(f"exit code {code} of the repetition")
    _check_end(folder, expected, outcome)
    return outcome


def leftovers_of_stopped(folder: Path) -> list[str]:
    """Return what a command that could clean up has left; it keeps a checkpoint."""
    return [f"left {path}" for path in leftovers(folder) if not path.endswith(".checkpoint")]


def _check_end(folder: Path, expected: Undisturbed, outcome: Outcome) -> None:
    outcome.finished += 1
    if result(folder) != expected.results:
        outcome.wrong.append(f"{folder.name}: another result than undisturbed")
    found = everything(folder)
    outcome.wrong += [f"left {folder.name}/{path}" for path in sorted(found - expected.files)]
    outcome.wrong += [f"lacks {folder.name}/{path}" for path in sorted(expected.files - found)]


def main() -> None:
    """Print a line per command and signal; exit with 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--commands", nargs="*", default=list(COMMANDS), choices=COMMANDS)
    parser.add_argument("--json", type=Path, help="file to write the outcomes to")
    given = parser.parse_args()
    wrong, rows = 0, []
    with tempfile.TemporaryDirectory() as parent:
        for command in given.commands:
            undisturbed(command, Path(parent) / f"{command}-first")  # compiles the kernels
            expected = undisturbed(command, Path(parent) / f"{command}-undisturbed")
            for name in SIGNALS:
                folder = Path(parent) / f"{command}-{name}"
                number = signal.Signals[name]
                found = kill_often(expected, number, given.kills, folder, given.seed)
                wrong += len(found.wrong)
                print(f"{command} {name}: {found.kills} kills, {found.finished} finished", end="")
                print(f", {len(found.wrong)} wrong {found.wrong[:5]}", flush=True)
                row = {"command": command, "signal": name, **asdict(found)}
                rows.append({**row, "wrong": len(found.wrong)})
                if given.json:
                    text = json.dumps({"seed": given.seed, "kills": rows}, indent=1)
                    given.json.write_text(text + "\n", encoding="utf-8")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
