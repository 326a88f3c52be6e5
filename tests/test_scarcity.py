"""Runs on a disk that is nearly full, with little memory, and under a clock that jumps.

Each either gives the same rows as an undisturbed run or ends with one line; with enough room, the
same command then gives these rows.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest

from mor_bench.cli.address_space import LEAST_ADDRESS_SPACE_BYTES
from mor_bench.machine import GROUPS, memory_limit_bytes
from mor_bench.results.comparison import Comparison
from mor_bench.sandbox.process import MEMORY_SHARE
from tests.small_runs import COMMAND, descent_file, method_file, wait_for
from tests.verification.kills import leftovers, result

ROOT = Path(__file__).parents[1]

RUN = " ".join([*COMMAND, "run beam-tiny -m linear-fem -m pod --limit 200"])

linux_only = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux")


def shell(line: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a line of a shell in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "ROOT": str(ROOT), **variables}
    return subprocess.run(
        ["sh", "-c", line], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def check_is_one_line(stderr: str) -> None:
    """Check that the last line is the message of mor-bench, and that there is no traceback."""
    assert "Traceback" not in stderr
    assert stderr.splitlines()[-1].startswith("mor-bench: "), stderr


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The rows of an undisturbed run, without times."""
    folder = tmp_path_factory.mktemp("undisturbed")
    done = shell(f"{RUN} --out out --cache cache", folder)
    assert done.returncode == 0, done.stderr
    return result(folder)


# A full disk

DISK_BYTES = 64_000_000

PLACES = {
    "out": "--out disk/out --cache cache",
    "cache": "--out out --cache disk/cache",
    "both": "--out disk/out --cache disk/cache",
}
"""Folders of the run on the full disk."""


@linux_only
@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "free_bytes"),
    [
        ("cache", 100_000),
        pytest.param("out", 0, marks=pytest.mark.nightly),
        pytest.param("tmp", 0, marks=pytest.mark.nightly),
        pytest.param("both", DISK_BYTES // 100, marks=pytest.mark.nightly),
    ],
)
def test_a_run_on_a_full_disk_ends_with_one_line_and_goes_on_with_room(
    place: str, free_bytes: int, undisturbed: dict[str, str], tmp_path: Path
) -> None:
    """A file system of its own leaves some bytes free, at first; 1 % is one of the cases."""
    if shell("unshare -rm true", tmp_path).returncode:
        pytest.skip("must not make a file system")
    (tmp_path / "disk").mkdir()
    folders = PLACES.get(place, "--out out --cache cache")
    temporary = "TMPDIR=$PWD/disk" if place == "tmp" else ""
    script = f"""
        mount -t tmpfs -o size={DISK_BYTES} tmpfs disk || exit 9
        head -c {DISK_BYTES - free_bytes} /dev/zero > disk/fill 2> /dev/null
        {temporary} {RUN} {folders} > first.txt 2> error.txt; echo $? > code
        find disk -name '*.tmp' -o -name 'mor-bench-*' > left
        test -e disk/out && cp -r disk/out kept
        rm disk/fill
        {temporary} {RUN} {folders} && cp -r disk/. whole
    """
    (tmp_path / "whole").mkdir()
    (tmp_path / "script").write_text(script)
    done = shell("unshare -rm sh script", tmp_path)
    assert done.returncode == 0, done.stderr
    code, stderr = int((tmp_path / "code").read_text()), (tmp_path / "error.txt").read_text()
    assert "Traceback" not in stderr
    assert not (tmp_path / "left").read_text()
    if code:
        assert code == 2
        check_is_one_line(stderr)
        assert "No space left on device" in stderr or place == "tmp", stderr
    else:
        check_rows(tmp_path / ("kept" if place in ("out", "both") else "out"), undisturbed)
    found = result(tmp_path / "whole") if place in ("out", "both") else result(tmp_path)
    assert found["rows"] == undisturbed["rows"]
    # Python passes over a full folder for temporary files and takes another one.
    assert free_bytes or place == "tmp" or code == 2, "the disk was not full"


def check_rows(out: Path, undisturbed: dict[str, str]) -> None:
    """Check that each row is that of an undisturbed run, or failed for want of room."""
    expected = {row[0]: row for row in json.loads(undisturbed["rows"])}
    for row in json.loads((out / "results.json").read_text(encoding="utf-8"))["rows"]:
        if row["status"] == "failed":
            assert "No space left on device" in row["reason"] or "requested" in row["reason"]
        else:
            assert [row["label"], row["status"], row["error"]] == expected[row["label"]][:3]


# Little memory


def test_the_memory_limit_of_a_container_counts(tmp_path: Path) -> None:
    total = float(psutil.virtual_memory().total)
    membership, groups = tmp_path / "cgroup", tmp_path / "groups"
    limit = partial(memory_limit_bytes, membership, groups)
    assert limit() == total  # as on other systems, where no such file exists
    membership.write_text("4:memory:/outer/inner\n3:cpuset:/\n")
    outer = groups / "memory" / "outer"
    (outer / "inner").mkdir(parents=True)
    (outer / "inner" / "memory.limit_in_bytes").write_text("9223372036854771712\n")
    assert limit() == total
    (outer / "memory.limit_in_bytes").write_text("3000000\n")
    assert limit() == 3e6
    membership.write_text("0::/slice\n")
    (groups / "slice").mkdir()
    (groups / "slice" / "memory.max").write_text("max\n")
    assert limit() == total
    (groups / "slice" / "memory.max").write_text("2000000\n")
    assert limit() == 2e6


@linux_only
@pytest.mark.slow
def test_two_gigabytes_of_address_space_change_no_row(
    undisturbed: dict[str, str], tmp_path: Path
) -> None:
    kib = LEAST_ADDRESS_SPACE_BYTES // 1024
    done = shell(f"ulimit -v {kib}; {RUN} --out out --cache cache", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert result(tmp_path) == undisturbed


@linux_only
@pytest.mark.parametrize("kib", [LEAST_ADDRESS_SPACE_BYTES // 1024 - 1, 1_000_000, 500_000])
def test_less_address_space_is_refused(kib: int, tmp_path: Path) -> None:
    done = shell(f"ulimit -v {kib}; {RUN} --out out --cache cache", tmp_path)
    assert done.returncode == 2, done
    check_is_one_line(done.stderr)
    assert "the address space must be at least 2 GB" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.fixture
def group() -> Iterator[Path]:
    """A control group with 2 GB of memory."""
    limit_file = {GROUPS / "memory": "memory.limit_in_bytes", GROUPS: "memory.max"}
    for top, name in limit_file.items():
        made = top / f"mor-bench-test-{os.getpid()}"
        try:
            made.mkdir()
        except OSError:
            continue
        try:
            (made / name).write_text("2000000000")
            yield made
            return
        except OSError:
            continue
        finally:
            made.rmdir()
    pytest.skip("must not make a control group")


@linux_only
@pytest.mark.slow
def test_a_run_in_a_container_of_2_gb_fails_only_what_needs_more(
    group: Path, undisturbed: dict[str, str], tmp_path: Path
) -> None:
    hungry = method_file(tmp_path, "hungry", "tests.third_party:Broken", how="memory")
    enter = f"echo $$ > {group}/cgroup.procs"
    done = shell(f"{enter} && {RUN} -m {hungry} --out out --cache cache", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    rows = {row.method: row for row in Comparison.read(tmp_path / "out").rows}
    assert rows["hungry"].status == "failed"
    share = f"of {MEMORY_SHARE * 2:.3g} GB"
    assert "fitting took more memory than the limit" in str(rows["hungry"].reason)
    assert str(rows["hungry"].reason).endswith(share), rows["hungry"].reason
    others = [row for row in json.loads(result(tmp_path)["rows"]) if row[0] != "hungry"]
    assert others == json.loads(undisturbed["rows"])


# A clock that jumps

CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>

/* Every quarter of a second the system clock jumps by a day, forwards or backwards. */
int clock_gettime(clockid_t id, struct timespec *now)
{
    static int (*real)(clockid_t, struct timespec *);
    struct timespec steady;
    int code;
    if (!real)
        real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    code = real(id, now);
    if (!code && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE)) {
        real(CLOCK_MONOTONIC, &steady);
        now->tv_sec += 86400 * ((4 * steady.tv_sec + steady.tv_nsec / 250000000) % 3 - 1);
    }
    return code;
}

int gettimeofday(struct timeval *now, void *zone)
{
    struct timespec time;
    int code = clock_gettime(CLOCK_REALTIME, &time);
    now->tv_sec = time.tv_sec;
    now->tv_usec = time.tv_nsec / 1000;
    return code;
}

time_t time(time_t *now)
{
    struct timespec time;
    clock_gettime(CLOCK_REALTIME, &time);
    if (now)
        *now = time.tv_sec;
    return time.tv_sec;
}
"""

JUMPS = """
import time
days = {int(time.sleep(0.1) or time.time() / 86400) for _ in range(12)}
assert len(days) == 3, days
"""

A_DAY_S = 86_400.0


@pytest.fixture(scope="module")
def jumping(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment variables under which the system clock jumps."""
    folder = tmp_path_factory.mktemp("clock")
    (folder / "clock.c").write_text(CLOCK)
    made = shell("cc -shared -fPIC -o clock.so clock.c -ldl", folder)
    if made.returncode:
        pytest.skip("there is no compiler of C")
    variables = {"LD_PRELOAD": str(folder / "clock.so")}
    checked = shell(f"{sys.executable} -c '{JUMPS}'", folder, **variables)
    assert checked.returncode == 0, checked.stderr
    return variables


def check_times(comparison: Comparison) -> None:
    """Check that no time of a run contains a jump of the clock."""
    for row in comparison.rows:
        assert row.latency_ms is not None
        assert row.offline_s is not None
        times_ms = comparison.samples(row)["latency_ms"]
        assert 0 < times_ms.min() <= times_ms.max() < 1e3 * A_DAY_S / 10
        parts = [getattr(row.offline_s, name) for name in type(row.offline_s).model_fields]
        assert all(0 <= part < A_DAY_S / 10 for part in parts if isinstance(part, float))
        assert 0 <= (row.tuning_s or 0.0) < A_DAY_S / 10


@linux_only
@pytest.mark.slow
def test_a_jumping_clock_changes_no_row(
    jumping: dict[str, str], undisturbed: dict[str, str], tmp_path: Path
) -> None:
    done = shell(f"{RUN} --out out --cache cache --workers 2", tmp_path, **jumping)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert result(tmp_path) == undisturbed
    check_times(Comparison.read(tmp_path / "out"))
    assert not leftovers(tmp_path)


@linux_only
@pytest.mark.nightly
def test_a_jumping_clock_takes_nothing_from_a_training_that_resumes(
    jumping: dict[str, str], tmp_path: Path
) -> None:
    path = descent_file(tmp_path, iterations=300)
    command = [*COMMAND, "run", "beam-tiny", "-m", str(path), "--limit=60", "--cache=c", "--out=o"]
    environment: dict[str, Any] = {**os.environ, "PYTHONPATH": str(ROOT), **jumping}
    begun = subprocess.Popen(
        command,
        cwd=tmp_path,
        env={**environment, "DESCENT_NAP_S": "0.05"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for(lambda: list(tmp_path.glob("c/fits/*/training.json")), begun)
    begun.send_signal(signal.SIGTERM)
    begun.communicate(timeout=60)
    again = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert again.returncode == 0, again.stderr
    found = Comparison.read(tmp_path / "o")
    assert found.rows[0].warnings[0].startswith("goes on from iteration ")
    check_times(found)


def test_only_ages_of_files_are_read_from_the_system_clock() -> None:
    """Durations must come from a steady clock. Dates are for names and for people."""
    clock = r"\btime\.time\(|from time import (\w+, )*time\b|\bdatetime\.now\("
    readers = {
        path.relative_to(ROOT / "mor_bench").as_posix()
        for path in (ROOT / "mor_bench").rglob("*.py")
        if re.search(clock, path.read_text(encoding="utf-8"))
    }
    dated = {"runs/run_folder.py", "measure/discretisation_error.py"}
    assert readers == {"snapshots/store.py", *dated}
