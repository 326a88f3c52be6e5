"""Compare methods as they were at an earlier commit with the same methods today, on one machine.

    python -m tests.benchmarks.fronts 012668a --json fronts.json

Each version runs its own `mor-bench run` on the same scenes and the same loads, with the default
configurations of its methods. Test sets out of range are left out, because the earlier version does
not know all of them. Networks on grids and meshes are left out, because they need longer
trainings. The regression has another name today, which says what it is told. Hyper-reduction runs
without static correction, which the earlier version lacks.

Two more runs have methods of today that the first two leave out. Scenes of a run that the file has
already are not repeated, so that the same command continues after an interruption. `--newest` has
the newest contestants instead, beside the full-order model.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from mor_bench.snapshots.store import write_atomically

ROOT = Path(__file__).parents[2]
SCENES = (
    "beam-coarse",
    "beam-coarse-3-forces",
    "beam-fine",
    "l-shape",
    "liver-hex",
    "liver-tet",
    "beam-nearly-incompressible",
    "beam-neo-hooke",
)
BEFORE = ("fem", "linear-fem", "pod", "hpod", "pca-regression", "sparse-polynomial", "pod-nn")
NOW = (
    "fem",
    "linear-fem",
    "pod",
    "hpod[static_correction=false]",
    "pca-regression-linear",
    "sparse-polynomial",
    "pod-nn",
)
CORRECTED = "[cubature_tolerance=0.01,static_correction=true]"
MORE = (
    f"quadratic-manifold-pod{CORRECTED}",
    f"pod-ann{CORRECTED}",
    "local-pod[n_clusters=1]",
    "modal-derivatives",
    "sparse-polynomial-derivative",
    "pgd-snapshots",
    "pca-gaussian-process",
)
FURTHER = (
    "hpod[static_correction=true]",
    "pod-nn-derivative",
    "autoencoder",
    "pod-deeponet[input=linear-response]",
)
NEWEST = (
    "fem",
    "ecm[sampling=points,static_correction=true]",
    "fem-coarse[static_correction=true]",
    "hybrid",
)

TEST_SETS = re.compile(r"^\[tests\]\n(?:[^\[\n].*\n|\n)*", re.MULTILINE)
ERRORS = ("rel_l2_median", "rel_l2_p95", "rel_l2_max")


def rows_of(
    code: Path, methods: tuple[str, ...], names: list[str], limit: int, folder: Path
) -> list[dict[str, Any]]:
    """Run a version of the suite; return error and time of each configuration that ended."""
    folder.mkdir()
    scenes = []
    for name in names:
        text = (ROOT / f"datasets/{name}.toml").read_text(encoding="utf-8")
        (folder / f"{name}.toml").write_text(TEST_SETS.sub("", text), encoding="utf-8")
        scenes.append(str(folder / f"{name}.toml"))
    chosen = [text for name in methods for text in ("-m", name)]
    command = [sys.executable, "-m", "mor_bench", "run", *scenes, *chosen]
    command += ["--limit", str(limit), "--out", str(folder / "run"), "--cache", str(folder)]
    subprocess.run(command, cwd=code, env={**os.environ, "PYTHONPATH": str(code)}, check=True)
    results = json.loads((folder / "run/results.json").read_text(encoding="utf-8"))
    return [
        {
            "dataset": row["dataset"],
            "method": row["method"],
            "label": row["label"],
            "ms": row["latency_ms"]["median"],
            **{name: row["error"][name] for name in ERRORS},
        }
        for row in results["rows"]
        if row["status"] == "ok"
    ]


def main(
    commit: Annotated[str, typer.Argument(help="The earlier commit.")],
    limit: Annotated[int, typer.Option(help="Samples of each scene.")] = 400,
    newest: Annotated[bool, typer.Option("--newest", help="Run the newest methods only.")] = False,
    report: Annotated[
        Path, typer.Option("--json", metavar="FILE", help="Write the rows here.")
    ] = Path("fronts.json"),
) -> None:
    """Compare methods as they were at an earlier commit with the same methods today."""
    found: dict[str, Any] = {"commit": commit, "limit": limit}
    if report.exists():
        stored = json.loads(report.read_text(encoding="utf-8"))
        if found | stored != stored:
            raise SystemExit(f"{report} is of another commit or limit than {commit} and {limit}")
        found = stored
    with TemporaryDirectory() as text:
        folder = Path(text)
        old = folder / "code"
        subprocess.run(["git", "worktree", "add", "--detach", old, commit], cwd=ROOT, check=True)
        try:
            of_both_versions = {
                "before": (old, BEFORE),
                "now": (ROOT, NOW),
                "more": (ROOT, MORE),
                "further": (ROOT, FURTHER),
            }
            runs = {"newest": (ROOT, NEWEST)} if newest else of_both_versions
            for name, (code, methods) in runs.items():
                rows = found.get(name, [])
                measured = {row["dataset"] for row in rows}
                if lacking := [scene for scene in SCENES if scene not in measured]:
                    rows = [*rows, *rows_of(code, methods, lacking, limit, folder / name)]
                    found[name] = sorted(rows, key=lambda row: SCENES.index(row["dataset"]))
                    write_atomically(report, (json.dumps(found, indent=1) + "\n").encode())
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", old], cwd=ROOT, check=True)


if __name__ == "__main__":
    typer.run(main)
