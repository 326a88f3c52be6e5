"""Plant known bugs in a copy of the package, one at a time, and record which tests notice.

Run ``python -m tests.verification.planted_bugs``, with ``--workers 2`` for two at once. It reads
`planted_bugs.toml`, writes `planted_bugs.json` and `PLANTED_BUGS.md` beside this file, and fails if
a bug goes unnoticed. Only the quick tests of this folder run, unless a bug says ``slow = true``.
``--again`` takes a fraction of the time: it runs the recorded tests until one notices the bug.
``--missing`` plants only bugs without a record. The record is written after every bug, so that the
same command continues after an interruption.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Lock

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
FOLDER = HERE.relative_to(ROOT)
RECORD, TABLE = HERE / "planted_bugs.json", HERE / "PLANTED_BUGS.md"
COPIED = ("mor_bench", "tests", "datasets", "methods")
LIMIT_S = 120.0
"""Default time limit for one bug's tests. A bug may make them hang; failures until then count."""

LONG = (
    "manufactured or elastica or cures or slender or felupe or arch or huge or nearly or conjugate "
    "or turned or solver or multigrid or among"
)
SELECTIONS = {
    "CORE": f"not ({LONG} or refused or warned or check)",
    "STATES": "taylor or rest or patch or homogeneous or hydrostatic or uniaxial or shear or least "
    "or symmetric or small or kernel or equal or free or rigid or without",
    "ALL": "not (manufactured and tetrahedron or 4999 or 0.49)",
}
"""Expressions of pytest's -k; compiling and a few tests take most of the time."""


@dataclass(frozen=True)
class Record:
    """Tests that notice a bug, as `file::function`."""

    tests: list[str]
    again: str = ""
    """The one that noticed it once more, after the run that recorded all; empty if none ran."""

    @classmethod
    def read(cls) -> dict[str, Record]:
        """Return the record of every bug by its name."""
        if not RECORD.exists():
            return {}
        content = json.loads(RECORD.read_text(encoding="utf-8"))
        return {bug: cls(**entry) for bug, entry in content.items()}


@dataclass(frozen=True)
class Bug:
    """A text of a source file, found in it exactly once, and its wrong replacement."""

    name: str
    file: str
    text: str
    wrong: str
    tests: str = "CORE"
    slow: bool = False

    @property
    def selection(self) -> str:
        """The tests to run, as an expression of pytest's -k."""
        return re.sub(r"[A-Z]{3,}", lambda name: f"({SELECTIONS[name[0]]})", self.tests)

    def sources(self, root: Path = ROOT) -> tuple[str, str]:
        """Return the file's text without and with the bug.

        Raises
        ------
        ValueError
            If the text to replace is not found exactly once.
        """
        text = (root / self.file).read_text(encoding="utf-8")
        found = text.count(self.text)
        if found != 1:
            raise ValueError(
                f"{self.name}: {self.text!r} must be found once in {self.file}; "
                f"found {found} times."
            )
        return text, text.replace(self.text, self.wrong)


def _read_bugs() -> tuple[Bug, ...]:
    content = tomllib.loads((HERE / "planted_bugs.toml").read_text(encoding="utf-8"))
    return tuple(Bug(**entry) for entry in content["bug"])


BUGS = _read_bugs()


def run(
    tree: Path, tests: str | list[str], limit_s: float, slow: bool = False
) -> tuple[list[str], bool]:
    """Return the failing test functions of a copy, in order, and whether any test ran.

    Tests are an expression of pytest's -k, or test functions that run until one fails.
    """
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tree / ".numba"),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONUNBUFFERED": "1",
        "PYTHONPATH": str(tree),
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", "pytest", "-v", "--tb=no", "-p", "no:cacheprovider"]
    if isinstance(tests, str):
        command += [str(FOLDER), "-k", tests, "--ignore", str(FOLDER / "test_planted_bugs.py")]
    else:
        command += ["-x", *(f"{FOLDER}/{test}" for test in tests)]
    command += ["-m", ""] if slow else []
    try:
        output = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=limit_s
        ).stdout
    except subprocess.TimeoutExpired as error:
        output = (error.stdout or b"").decode()
    failed = re.findall(rf"^{FOLDER}/(\w+\.py::\w+).* (?:FAILED|ERROR)", output, re.MULTILINE)
    return list(dict.fromkeys(failed)), " PASSED" in output or bool(failed)


def prepare(tree: Path, bugs: list[Bug], limit_s: float) -> list[str]:
    """Copy the package and compile its kernels; return the tests that fail without a bug.

    The quick tests of all bugs run.
    """
    for name in COPIED:
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tree)
    wanted = " or ".join(sorted({f"({bug.selection})" for bug in bugs}))
    failed, ran = run(tree, wanted, 10 * limit_s)
    shutil.copytree(tree / ".numba", tree / ".numba-clean")
    return failed if ran else ["no test ran"]


def plant(bug: Bug, tree: Path, tests: list[str], limit_s: float) -> list[str]:
    """Return the tests that notice a bug in a copy, and restore the copy.

    Where tests are given, they run until one notices it, instead of the bug's own selection.

    Numba finds compiled kernels by the path and content of the source, so the copy is reused.
    """
    before, planted = bug.sources(tree)
    (tree / bug.file).write_text(planted, encoding="utf-8")
    failed, _ = run(tree, tests or bug.selection, limit_s, bug.slow)
    (tree / bug.file).write_text(before, encoding="utf-8")
    shutil.rmtree(tree / ".numba")
    shutil.copytree(tree / ".numba-clean", tree / ".numba")
    print(f"{bug.name}: noticed by {len(failed)} tests", flush=True)
    return failed


def plant_all(
    bugs: list[Bug],
    workers: int,
    limit_s: float,
    known: dict[str, Record],
    record: Callable[[str, list[str]], None],
) -> bool:
    """Record the tests that notice each bug in a copy; return False if tests fail without a bug.

    The known tests of a bug run until one notices it; a bug without any has its own selection.
    """
    recording = Lock()
    with (
        tempfile.TemporaryDirectory(prefix="planted-") as folder,
        ThreadPoolExecutor(workers) as pool,
    ):
        trees = [Path(folder) / str(number) for number in range(workers)]
        prepared = pool.map(lambda tree: prepare(tree, bugs, limit_s), trees)
        failed = {test for tests in prepared for test in tests}
        if failed:
            print(f"fail without a bug: {sorted(failed)}")
            return False
        free: SimpleQueue[Path] = SimpleQueue()
        for tree in trees:
            free.put(tree)

        def plant_somewhere(bug: Bug) -> None:
            tree = free.get()
            try:
                before = known[bug.name].tests if bug.name in known else []
                tests = plant(bug, tree, before, limit_s)
            finally:
                free.put(tree)
            with recording:
                record(bug.name, tests)

        list(pool.map(plant_somewhere, bugs))
        return True


def write(records: dict[str, Record]) -> None:
    """Write the record and the table for readers, in the order of the list of bugs."""
    content = {bug.name: asdict(records[bug.name]) for bug in BUGS if bug.name in records}
    RECORD.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    lines = [
        "# Planted bugs",
        "",
        "Each bug is planted alone in a copy of the package, and some tests run. The test that",
        "notices it first names the broken law. All tests per bug are in `planted_bugs.json`.",
        "Both are written by `python -m tests.verification.planted_bugs`.",
        "",
        "*Again* names the test that noticed the bug once more in a later and shorter run, of the",
        "recorded tests until one fails (`--again`). The column *tests* is then older; it counts",
        "only tests that still exist. Tests belong to the quick suite unless marked slow.",
        "",
        "| bug | file | broken law | tests | again |",
        "|---|---|---|---|---|",
    ]
    for bug in BUGS:
        record = records.get(bug.name)
        if record is None:
            continue
        law = _law(record.tests[0]) if record.tests else "**unnoticed**"
        again = _law(record.again) if record.again else "not run"
        again += ", slow" * (bug.slow and bool(record.again))
        file = bug.file.removeprefix("mor_bench/")
        lines.append(f"| {bug.name} | `{file}` | {law} | {len(record.tests)} | {again} |")
    waiting = [bug.name for bug in BUGS if bug.name not in records]
    if waiting:
        lines += ["", "Not planted yet (`--missing`):", "", *(f"- {name}" for name in waiting)]
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _law(test: str) -> str:
    return test.split("::test_")[1].replace("_", " ")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=1, help="number of copies used at once")
    parser.add_argument(
        "--limit-s",
        type=float,
        default=LIMIT_S,
        help="time limit for the tests of one bug, in seconds; more on a busy machine",
    )
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        help="plant only bugs whose name contains one of these texts; keep the record of others",
    )
    parser.add_argument(
        "--again",
        action="store_true",
        help="run only the tests on record, until one notices the bug; keep the record of others",
    )
    parser.add_argument(
        "--missing",
        action="store_true",
        help="plant only bugs that no test on record notices; keep the record of others",
    )
    arguments = parser.parse_args()
    records = Record.read()
    wanted = arguments.only or [""]
    bugs = [bug for bug in BUGS if any(text in bug.name for text in wanted)]
    if arguments.missing:
        bugs = [bug for bug in bugs if bug.name not in records or not records[bug.name].tests]
    for bug in bugs:
        bug.sources()

    def record(name: str, tests: list[str]) -> None:
        if arguments.again and tests:
            known = records.get(name, Record([])).tests
            records[name] = Record(known or tests, tests[0])
        else:
            records[name] = Record(tests)
        write(records)

    known = dict(records) if arguments.again else {}
    if not plant_all(bugs, arguments.workers, arguments.limit_s, known, record):
        return 1
    unnoticed = [bug.name for bug in BUGS if not records.get(bug.name, Record([])).tests]
    for name in unnoticed:
        print(f"unnoticed: {name}")
    return int(bool(unnoticed))


if __name__ == "__main__":
    sys.exit(main())
