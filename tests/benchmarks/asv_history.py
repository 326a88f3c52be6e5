"""Run the benchmarks of `tests/history` on commits of the past, with this interpreter.

    python -m tests.benchmarks.asv_history --list          # the commits that would be measured
    python -m tests.benchmarks.asv_history --minutes 50    # measure those without a result
    python -m tests.benchmarks.asv_history --commit HEAD   # add a commit

asv would build an environment per commit, which takes too long with torch. Here one git worktree
holds each commit in turn, and asv runs with `--set-commit-hash`. Results go to `reports/asv`, in
asv's format. A commit with a file there is skipped, so a run that was stopped goes on.

Of the commits on the first-parent line that changed `mor_bench/`, the newest fifty are measured,
and twelve that are spread evenly over those before.

Numba keeps compiled kernels between commits. It recompiles a function if its file has another time
of modification, but ignores the files which that file imports. So the time of each file is set to
a number that depends on its content and on every module of the package that it imports.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Set
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
CONFIGURATION = ROOT / "tests" / "history" / "asv.conf.json"
RESULTS = ROOT / "reports" / "asv"
MACHINE = "shared-2-cores"
"""Name of the machine in the stored results; a host's own name says nothing to a reader."""

ENVIRONMENT = "existing-py{}"
N_NEWEST, N_OLDER = 50, 12


def git(*arguments: str, folder: Path = ROOT) -> str:
    return subprocess.run(
        ["git", *arguments], cwd=folder, check=True, capture_output=True, text=True
    ).stdout.strip()


def candidates(tip: str = "HEAD") -> list[str]:
    """List the first-parent commits that changed the package, oldest first."""
    return git("rev-list", "--first-parent", "--reverse", tip, "--", "mor_bench").split()


def spread(commits: list[str], n: int) -> list[str]:
    """Choose `n` of the commits, evenly spread, with the first and the last."""
    if n >= len(commits):
        return commits
    if n == 1:
        return commits[-1:]
    return [commits[round(i * (len(commits) - 1) / (n - 1))] for i in range(n)]


def chosen(commits: list[str]) -> list[str]:
    """Choose the newest commits, and some spread over the older ones; oldest first."""
    return spread(commits[:-N_NEWEST], N_OLDER) + commits[-N_NEWEST:]


def farthest_first(commits: list[str], done: Set[str]) -> Iterator[str]:
    """Yield the commits that are not done, each the farthest from those before it.

    So a run that stops early has covered the whole history evenly. Of equals, the newest is first.
    """
    places = {i for i, commit in enumerate(commits) if commit in done}
    missing = sorted(set(range(len(commits))) - places, reverse=True)
    while missing:
        next_one = max(missing, key=lambda i: min((abs(i - j) for j in places), default=0))
        missing.remove(next_one)
        places.add(next_one)
        yield commits[next_one]


def result_file(commit: str) -> Path:
    name = ENVIRONMENT.format(".".join(map(str, sys.version_info[:2])))
    return RESULTS / MACHINE / f"{commit[:8]}-{name}.json"


class _Imports(ast.NodeVisitor):
    """Collect the modules that a file may import when it runs."""

    def __init__(self) -> None:
        self.names: set[str] = set()

    def visit_If(self, node: ast.If) -> None:
        if not (isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
            self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        self.names.update(alias.name for alias in node.names)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        if node.module:
            self.names.add(node.module)
            self.names.update(f"{node.module}.{alias.name}" for alias in node.names)


def import_digests(tree: Path) -> dict[Path, str]:
    """Return a digest of every module of the package, with all modules that it imports."""
    paths = sorted((tree / "mor_bench").rglob("*.py"))
    modules = {
        ".".join(path.relative_to(tree).with_suffix("").parts).removesuffix(".__init__"): path
        for path in paths
    }
    direct: dict[Path, set[Path]] = {}
    for path in paths:
        imports = _Imports()
        imports.visit(ast.parse(path.read_text(encoding="utf-8")))
        direct[path] = {modules[name] for name in imports.names if name in modules}
    own = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    digests = {}
    for path in paths:
        seen, waiting = {path}, [path]
        while waiting:
            new = direct[waiting.pop()] - seen
            seen |= new
            waiting += new
        text = "".join(own[each] for each in sorted(seen))
        digests[path] = hashlib.sha256(text.encode()).hexdigest()
    return digests


def set_times(tree: Path) -> None:
    """Set the time of modification of every module to a number from its digest."""
    for path, digest in import_digests(tree).items():
        seconds = int(digest[:12], 16) % 10**9
        os.utime(path, (seconds, seconds))


def check_out(commit: str, tree: Path) -> None:
    """Check a commit out in the worktree of the runner."""
    if not tree.exists():
        git("worktree", "prune")
        git("worktree", "add", "--detach", "--force", str(tree), commit)
    git("checkout", "--detach", "--force", "--quiet", commit, folder=tree)
    git("clean", "-dfxq", folder=tree)
    set_times(tree)


def environment(tree: Path, work: Path) -> dict[str, str]:
    """Return the variables under which asv measures: one thread, own caches, the commit's code."""
    return {
        **os.environ,
        **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
        "MOR_BENCH_TREE": str(tree),
        "NUMBA_CACHE_DIR": str(work / "numba"),
        "XDG_CACHE_HOME": str(work / "cache"),
        "HOME": str(work),  # where asv describes the machine
    }


def measure(commit: str, work: Path) -> bool:
    """Run asv on a commit and store its result without the paths of this machine."""
    from mor_bench.export.asv_files import VERSION, describe_for_asv
    from mor_bench.machine import describe_machine

    tree = work / "tree"
    check_out(commit, tree)
    asv = [sys.executable, "-m", "asv"]
    options = {"cwd": ROOT, "env": environment(tree, work), "check": False}
    about = {MACHINE: describe_for_asv(describe_machine(), MACHINE), "version": VERSION["machine"]}
    (work / ".asv-machine.json").write_text(json.dumps(about))
    before = set(RESULTS.rglob("*.json"))
    run = f"run --config {CONFIGURATION} --machine {MACHINE} --set-commit-hash {commit}".split()
    subprocess.run([*asv, *run, "-E", f"existing:{sys.executable}"], **options)  # type: ignore[call-overload]
    new = [path for path in set(RESULTS.rglob("*.json")) - before if path.name[:8] == commit[:8]]
    for path in new:
        content = without_paths(json.loads(path.read_text(encoding="utf-8")))
        path.unlink()
        result_file(commit).write_text(json.dumps(content, separators=(",", ":")) + "\n")
    return bool(new)


def without_paths(content: dict[str, Any]) -> dict[str, Any]:
    """Name the environment of a result by its version of Python instead of a path."""
    version = ".".join(map(str, sys.version_info[:2]))
    content["env_name"] = ENVIRONMENT.format(version)
    content["python"] = content["params"]["python"] = version
    return content


def wanted(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the commits to measure: those given, or the chosen ones without a result."""
    if arguments.commit:
        yield from (git("rev-parse", f"{name}^{{commit}}") for name in arguments.commit)
        return
    commits = chosen(candidates())
    done = {commit for commit in commits if result_file(commit).exists()}
    yield from farthest_first(commits, done)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--commit", action="append", help="measure this commit; may be repeated")
    parser.add_argument("--minutes", type=float, default=60.0, help="start no commit after this")
    parser.add_argument("--work", type=Path, default=ROOT / ".asv" / "history-work")
    parser.add_argument("--list", action="store_true", help="list the commits and stop")
    arguments = parser.parse_args()
    if arguments.list:
        print(*wanted(arguments), sep="\n")
        return
    work = arguments.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    for commit in wanted(arguments):
        if time.monotonic() - start > 60 * arguments.minutes:
            break
        begun = time.monotonic()
        stored = measure(commit, work)
        print(
            f"{commit[:8]} {'stored' if stored else 'FAILED'}, {time.monotonic() - begun:.0f} s",
            flush=True,
        )
    git("worktree", "prune")


if __name__ == "__main__":
    main()
