"""Closed and full streams, plain terminals, signals, and a full disk, as a user meets them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.case_marks import nightly_but
from tests.small_runs import COMMAND

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")

ROOT = Path(__file__).parents[1]

MOR_BENCH = " ".join(COMMAND)


def shell(line: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a line of bash in which $M stands for mor-bench."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "M": MOR_BENCH, **variables}
    command = ["bash", "-o", "pipefail", "-c", line]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        "$M list >&-",
        "$M list >&- 2>&- <&-",
        "$M check $FILE >&-",
        "$M run beam-tiny -m linear-fem --dry-run --cache c --limit 60 >&-",
        "$M --help >&-",
    ],
)
def test_closed_streams_are_no_error(line: str, tmp_path: Path) -> None:
    done = shell(line, tmp_path, FILE=str(ROOT / "datasets" / "beam-tiny.toml"))
    assert (done.returncode, done.stdout) == (0, ""), done
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ["list", "list --json", "--help", "check"])
def test_a_pipe_that_closes_early_ends_the_command_quietly(arguments: str, tmp_path: Path) -> None:
    done = shell(f"$M {arguments} | (exec <&-; sleep 0.1)", tmp_path)
    assert done.returncode in (0, 1, 141)
    assert "Traceback" not in done.stderr
    assert "mor-bench: " not in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", ["list", "list --json", "--help"])
def test_a_full_disk_under_standard_output_is_one_line(arguments: str, tmp_path: Path) -> None:
    done = shell(f"$M {arguments} > /dev/full", tmp_path)
    words = "mor-bench: standard output or a temporary file: No space left on device\n"
    assert (done.returncode, done.stderr) == (2, words)


@pytest.mark.slow
@pytest.mark.parametrize("line", ["$M generate beam-tiny --cache d", "$M run beam-tiny --out d/o"])
def test_a_limit_on_written_bytes_is_one_line_that_names_the_file(
    line: str, tmp_path: Path
) -> None:
    methods = "-m linear-fem --cache c" if " run " in line else ""
    done = shell(f"ulimit -f 20; {line} {methods} --limit 60 --workers 1", tmp_path)
    assert done.returncode == 2, done
    assert done.stderr.splitlines()[-1].startswith("mor-bench: ")
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.slow
def test_plain_terminals_and_encodings_change_no_result(tmp_path: Path) -> None:
    """`test_cli` has a run whose streams are ASCII."""
    c = {"TERM": "dumb", "LANG": "C", "LC_ALL": "C", "PYTHONUTF8": "0"}
    run = "$M run beam-tiny -m linear-fem --cache c --limit 60 --out o && $M list"
    for line, variables in (
        (run, {**c, "PYTHONCOERCECLOCALE": "0"}),
        ("rm o/report.html && $M report o && $M list", {"PYTHONIOENCODING": "ascii"}),
    ):
        done = shell(line, tmp_path, **variables)
        assert done.returncode == 0, done.stderr
        assert "linear-fem" in done.stdout
        assert (tmp_path / "o" / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_a_signal_ends_a_command_with_one_line_and_leaves_nothing(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / "tmp").mkdir()
    number = getattr(signal, name)
    command = [*COMMAND, "run", "beam-tiny", "-m", "umesh-small", "--train", "--limit=60"]
    process = subprocess.Popen(
        [*command, "--cache=c", "--out=o"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path / "tmp")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell ignores the interrupt in what it starts in the background.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    training = tmp_path / "c" / "fits"
    while process.poll() is None and not list(training.glob("*/training")):
        time.sleep(0.05)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    by = "" if name == "SIGINT" else f" by {name}"
    assert said.splitlines()[-1].startswith(f"mor-bench: stopped{by}. Finished samples and rows")
    assert "Traceback" not in said
    assert not list((tmp_path / "tmp").glob("mor-bench-*"))


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_while_a_command_is_looked_up_ends_it_in_the_same_way(name: str) -> None:
    code = (
        "import os, signal\n"
        "from mor_bench.cli.app import LazyCommands, app\n"
        f"signal.signal(signal.{name}, signal.SIG_DFL)\n"
        f"LazyCommands.get_command = lambda *_: os.kill(os.getpid(), signal.{name})\n"
        "app(['list'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + getattr(signal, name)
    assert done.stderr.startswith(f"mor-bench: stopped by {name}. Finished samples and rows")


def test_a_signal_while_the_command_ends_is_one_line() -> None:
    code = (
        "import contextlib, os, signal\n"
        "from mor_bench.cli import app\n"
        "signal.signal(signal.SIGTERM, signal.SIG_DFL)\n"
        "known = contextlib._GeneratorContextManager.__exit__\n"
        "def ending(self, *raised):\n"
        "    if self.gen.gi_code is app.clear_errors.__wrapped__.__code__ and "
        "raised[0] is SystemExit:\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "    return known(self, *raised)\n"
        "contextlib._GeneratorContextManager.__exit__ = ending\n"
        "app.app(['--version'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGTERM
    assert done.stderr.startswith("mor-bench: stopped by SIGTERM. Finished samples and rows")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_in_a_finaliser_ends_a_command_all_the_same(name: str) -> None:
    code = (
        "import os, signal, time\n"
        "from mor_bench.cli.clear_errors import clear_errors\n"
        "class Held:\n"
        "    def __del__(self):\n"
        f"        os.kill(os.getpid(), signal.{name})\n"
        "        time.sleep(0.01)\n"
        f"signal.signal(signal.{name}, signal.SIG_DFL)\n"
        "with clear_errors():\n"
        "    Held()\n"
        "    time.sleep(30)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + getattr(signal, name)
    assert done.stderr.startswith(f"mor-bench: stopped by {name}. Finished samples and rows")
    assert len(done.stderr.splitlines()) == 1


def test_a_library_that_cannot_be_loaded_is_one_line() -> None:
    code = (
        "import sys\n"
        "from mor_bench.cli.app import app\n"
        "sys.modules['numpy'] = None\n"
        "app(['check'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("mor-bench: a library cannot be loaded: import of numpy")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_nohup_is_respected(tmp_path: Path) -> None:
    code = (
        "import os, signal\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from mor_bench.cli.clear_errors import clear_errors\n"
        "with clear_errors():\n    os.kill(os.getpid(), signal.SIGHUP)\nprint('alive')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "alive\n"


LARGE = {
    "cells": ("cells  = [6, 2, 2]", "cells  = [100, 100, 40]"),
    "samples": ("samples_per_patch = 10", "samples_per_patch = 476_190"),
}
"""Changes of beam-tiny that lie just below the limits: 400,000 cells, ten million samples."""

SILENT_S = 2.0
"""Time after which a command must have said something, s, beside its start."""

BEGUN = [
    "check $FILE",
    "run $FILE -m linear-fem --dry-run --cache c",
    "generate $FILE --cache c --workers 1 --limit 2",
    "fit $FILE -m linear-fem --cache c --out m --limit 2",
]


def first_word_s(line: str, folder: Path, file: Path) -> float:
    """Return the seconds until a command prints something, and end it then."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "FILE": str(file)}
    begun = time.monotonic()
    with subprocess.Popen(
        ["bash", "-c", f"exec {MOR_BENCH} {line}"],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    ) as process:
        assert process.stdout
        first = process.stdout.read(1)
        seconds = time.monotonic() - begun
        process.terminate()
        rest = process.stdout.read()
    assert first, "it ended without a word"
    assert b"Traceback" not in rest
    return seconds


@pytest.mark.slow
@pytest.mark.parametrize("what", LARGE)
@pytest.mark.parametrize("line", nightly_but(2, BEGUN))
def test_large_inputs_are_not_met_with_silence(what: str, line: str, tmp_path: Path) -> None:
    text = (ROOT / "datasets" / "beam-tiny.toml").read_text(encoding="utf-8")
    file = tmp_path / "large.toml"
    assert LARGE[what][0] in text
    file.write_text(text.replace(*LARGE[what]), encoding="utf-8")
    start_s = max(
        first_word_s(f"{line.split()[0]} --help", tmp_path, file),
        first_word_s("check $FILE", tmp_path, ROOT / "methods" / "pod.toml"),
    )
    # The shortest of three: other work of the machine may delay one of them, silence delays each.
    tries = (first_word_s(line, tmp_path, file) for _ in range(3))
    limit_s = SILENT_S + 1.5 * start_s
    assert any(seconds < limit_s for seconds in tries), f"silent for {limit_s:.3g} s, three times"
