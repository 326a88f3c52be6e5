"""Build the distributions, install the wheel into an empty environment, and use it there.

    python -m tests.installed_wheel

It builds the sdist, and the wheel from the sdist alone, and checks that the wheel holds every file
of the package and of the suite. Then a new environment gets the wheel with the pinned versions,
without torch. A folder without a checkout is the working folder of all commands. It needs the
package `build`, and an index or a cache of packages.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

INSTALLED_AS = {
    "mor_bench": "mor_bench",
    "datasets": "mor_bench/suite/datasets",
    "methods": "mor_bench/suite/methods",
    "trained": "mor_bench/suite/trained",
}
"""Folders of the checkout, and their places in the wheel."""

METHODS = ("fem", "linear-fem", "pod")


def expected_files(root: Path) -> set[str]:
    """Return the names in the wheel of every file of the package and of the suite."""
    return {
        f"{place}/{path.relative_to(root / folder).as_posix()}"
        for folder, place in INSTALLED_AS.items()
        for path in (root / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def missing_files(wheel: Path, root: Path = ROOT) -> list[str]:
    """Return the files of the package and of the suite that a wheel lacks."""
    with zipfile.ZipFile(wheel) as archive:
        return sorted(expected_files(root) - set(archive.namelist()))


class Installation:
    """An environment that holds only the wheel and its dependencies, and an empty folder."""

    def __init__(self, folder: Path) -> None:
        self.elsewhere = folder / "elsewhere"
        self.elsewhere.mkdir()
        self._scripts = folder / "environment" / ("Scripts" if os.name == "nt" else "bin")
        kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        self._variables = {**kept, "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONUTF8": "1"}
        # pip has its own place for downloads below the folder that was just replaced.
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        self._variables.setdefault("PIP_CACHE_DIR", str(home / "pip"))
        run([sys.executable, "-m", "venv", str(folder / "environment")])

    def python(self, *arguments: str) -> str:
        """Run the Python of the environment; return its standard output."""
        return self._run("python", *arguments)

    def mor_bench(self, *arguments: str) -> str:
        """Run `mor-bench`; return its standard output."""
        return self._run("mor-bench", *arguments)

    def _run(self, program: str, *arguments: str) -> str:
        command = [str(self._scripts / program), *arguments]
        return run(command, cwd=self.elsewhere, env=self._variables)


def run(command: list[str], **where: object) -> str:
    """Run a command and return its standard output; its failure ends this program."""
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, encoding="utf-8", **where)  # type: ignore[call-overload]
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}")
    return str(done.stdout)


def build(out: Path) -> Path:
    """Build the sdist, and from it the wheel; return the wheel."""
    run([sys.executable, "-m", "build", "--outdir", str(out), str(ROOT)])
    (wheel,) = out.glob("*.whl")
    return wheel


def problems(here: Installation, wheel: Path) -> Iterator[str]:
    """Use the installed wheel, and yield what is wrong."""
    place = here.python("-c", "import mor_bench; print(mor_bench.__file__)").strip()
    if Path(place).is_relative_to(ROOT):
        yield f"the package is imported from the checkout: {place}"
    version = here.mor_bench("--version").strip()
    if version != wheel.name.split("-")[1]:
        yield f"`mor-bench --version` prints {version}, but the wheel is {wheel.name}"
    listed = here.mor_bench("list")
    for kind in ("datasets", "methods"):
        for path in (ROOT / kind).glob("*.toml"):
            if path.stem not in listed:
                yield f"`mor-bench list` does not name {path.stem}"
    asked = [word for name in METHODS for word in ("-m", name)]
    here.mor_bench("run", "beam-tiny", *asked, "--quiet", "--out", "report")
    rows = json.loads((here.elsewhere / "report" / "results.json").read_text("utf-8"))["rows"]
    for name in METHODS:
        states = [row["status"] for row in rows if row["method"] == name]
        if not states or set(states) != {"ok"}:
            yield f"the rows of {name} have the status {states}; expected ok"
    if not list((here.elsewhere / "report").glob("*.html")):
        yield "the run wrote no report page"


def main() -> None:
    """Build, install and check; print the seconds of each step."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--dist", type=Path, help="folder that the distributions are kept in")
    out = parser.parse_args().dist
    began = time.perf_counter()

    def done(step: str) -> None:
        spent = os.times()  # of the processes that have ended; zero on Windows
        work = spent.children_user + spent.children_system
        print(f"{time.perf_counter() - began:6.1f} s, {work:6.1f} core-s  {step}", flush=True)

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        folder = Path(temporary).resolve()
        wheel = build(out.resolve() if out else folder / "dist")
        done(f"built {wheel.name}")
        wrong = [f"the wheel lacks {name}" for name in missing_files(wheel)]
        here = Installation(folder)
        pip = ("-m", "pip", "--disable-pip-version-check")
        constraints = str(ROOT / "constraints.txt")
        here.python(*pip, "install", "-q", "-c", constraints, str(wheel))
        here.python(*pip, "check")
        done("installed")
        wrong += problems(here, wheel)
        done("used")
    if wrong:
        raise SystemExit("\n".join(wrong))


if __name__ == "__main__":
    main()
