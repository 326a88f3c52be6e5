"""Plant known bugs in a copy of the package, one at a time, and record which verification tests notice.

Run as ``python -m tests.verification.planted_bugs`` (``--workers 2`` for two at once); it writes `PLANTED_BUGS.md` beside
this file and fails if a bug goes unnoticed or a test function has never failed.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).parents[2]
RECORD = Path(__file__).with_name("PLANTED_BUGS.md")
COPIED = ("mor_bench", "tests", "datasets", "methods")
LIMIT_S = 120
"""A bug may also make the suite hang; what has failed until then counts."""

# Which tests run, as an expression of pytest's -k. Compiling and the slow tests are most of the time.
SLOW = "manufactured or elastica or cures or slender or felupe or arch or huge or nearly or conjugate or turned or solver or multigrid or among"
CORE = f"not ({SLOW} or refused or warned or check)"
STATES = "taylor or rest or patch or homogeneous or hydrostatic or uniaxial or shear or least or symmetric or small or kernel or equal or free or rigid"
STATES += " or without"
ALL = "not (manufactured and tetrahedron or 4999 or 0.49)"


@dataclass(frozen=True)
class Bug:
    """A text of a source file, found in it exactly once, and what to put in its place."""

    name: str
    file: str
    text: str
    wrong: str
    tests: str = CORE


KERNELS, LAWS, ELEMENTS, ASSEMBLY = (
    f"mor_bench/mechanics/{name}.py" for name in ("kernels", "laws", "elements", "assembly")
)
LINEAR, MODEL, NEWTON, ROTATED, STABILITY = (
    f"mor_bench/mechanics/{name}.py"
    for name in ("linear", "model", "newton", "rotated", "stability")
)
LOCKING, GALERKIN, SURROGATE = (
    "mor_bench/mechanics/locking.py",
    "mor_bench/reduction/galerkin.py",
    "mor_bench/surrogate.py",
)
CHECK, ANDERSON = "mor_bench/runs/file_check.py", "mor_bench/mechanics/anderson.py"

BUGS = (
    # Saint Venant-Kirchhoff on H8
    Bug(
        "H8 kernel: sign of a shear stress",
        KERNELS,
        "s01, s02, s12 = wm * e01,",
        "s01, s02, s12 = -wm * e01,",
    ),
    Bug(
        "H8 kernel: μ for λ in the pressure",
        KERNELS,
        "wl = w_lam[l] * trace",
        "wl = w_mu[l] * trace",
        STATES,
    ),
    Bug(
        "H8 kernel: λ for μ in the shear",
        KERNELS,
        "wm = 2.0 * w_mu[l]",
        "wm = 2.0 * w_lam[l]",
        STATES,
    ),
    Bug(
        "H8 kernel: geometric stiffness dropped",
        KERNELS,
        "m00, m11, m22 = gg * M[l] + s,",
        "s = 0.0\n                m00, m11, m22 = gg * M[l] + s,",
    ),
    Bug(
        "H8 kernel: F transposed in P",
        KERNELS,
        " f00 * s01 + h01 * s11 + h02 * s12",
        " f00 * s01 + h10 * s11 + h20 * s12",
        STATES,
    ),
    Bug(
        "H8 kernel: strain not quadratic",
        KERNELS,
        "e00 = h00 + 0.5 *",
        "e00 = h00 + 0.25 *",
        STATES,
    ),
    Bug(
        "H8 kernel: energy halved",
        KERNELS,
        "energy[l] += 0.5 * (s00",
        "energy[l] += 0.25 * (s00",
        f"{STATES} or work or huge",
    ),
    Bug(
        "H8 kernel: λ and μ swapped in a tangent block",
        KERNELS,
        "+= l0 * h1 + n1 * h0 + m01",
        "+= l1 * h0 + n0 * h1 + m01",
    ),
    Bug(
        "H8 kernel: force alone takes the first Gauss point's gradients",
        KERNELS,
        "_point(u_e, gradients[b, q], w_lam",
        "_point(u_e, gradients[b, 0], w_lam",
        STATES + " or alone",
    ),
    Bug(
        "H8 kernel: det F of the wrong sign",
        KERNELS,
        "- h01 * (h10 * f22 - h12 * h20)",
        "+ h01 * (h10 * f22 - h12 * h20)",
    ),
    # any law on any element
    Bug(
        "general kernel: sign of the force",
        LAWS,
        "f_e[a, i] += F[i, 0] * Sg[a, 0]",
        "f_e[a, i] -= F[i, 0] * Sg[a, 0]",
        STATES,
    ),
    Bug(
        "general kernel: F transposed",
        LAWS,
        "+= u_e[a, i] * g[a, j]",
        "+= u_e[a, j] * g[a, i]",
        STATES,
    ),
    Bug(
        "general kernel: geometric stiffness dropped",
        LAWS,
        "k_ab = geometric if i == j else 0.0",
        "k_ab = 0.0",
    ),
    Bug(
        "general kernel: min det F not kept",
        LAWS,
        "    " * 3 + "min_det = min(min_det, det)",
        "    " * 3 + "min_det = det",
        "kernel or confined or alone or huge or rigid",
    ),
    # laws
    Bug(
        "Saint Venant-Kirchhoff: λ and μ swapped",
        LAWS,
        "lam, mu = p[0], p[1]\n    trace",
        "lam, mu = p[1], p[0]\n    trace",
        STATES,
    ),
    Bug(
        "Saint Venant-Kirchhoff: sign of the stress",
        LAWS,
        "S[i, j] = 2.0 * mu * e",
        "S[i, j] = -2.0 * mu * e",
        STATES,
    ),
    Bug(
        "Saint Venant-Kirchhoff: tangent in shear",
        LAWS,
        "D[3 + i, 3 + i] = mu",
        "D[3 + i, 3 + i] = 2.0 * mu",
        STATES,
    ),
    Bug(
        "neo-Hooke: λ and μ swapped",
        LAWS,
        "lam, mu = p[0], p[1]\n    inverse",
        "lam, mu = p[1], p[0]\n    inverse",
        STATES,
    ),
    Bug(
        "neo-Hooke: sign of the stress",
        LAWS,
        "(lam * log_j - mu) * inverse[i, j]",
        "(mu - lam * log_j) * inverse[i, j]",
        STATES,
    ),
    Bug(
        "neo-Hooke: tangent",
        LAWS,
        "2.0 * (mu - lam * log_j)",
        "2.0 * (mu + lam * log_j)",
        f"{STATES} or quadratically",
    ),
    Bug(
        "Mooney-Rivlin: c10 and c01 swapped",
        LAWS,
        "c10, c01, bulk = p[0], p[1], p[2]",
        "c01, c10, bulk = p[0], p[1], p[2]",
        f"{STATES} or felupe",
    ),
    Bug(
        "Mooney-Rivlin: sign of the second stress",
        LAWS,
        "+ 2.0 * b * (d_second",
        "- 2.0 * b * (d_second",
        STATES,
    ),
    Bug(
        "Mooney-Rivlin: tangent",
        LAWS,
        "_add_product(D, -4.0 * b, identity)",
        "_add_product(D, 4.0 * b, identity)",
        STATES,
    ),
    Bug(
        "Ogden: sign of the stress",
        LAWS,
        "S += principal[a] * Na",
        "S -= principal[a] * Na",
        STATES,
    ),
    Bug(
        "Ogden: tangent in shear",
        LAWS,
        "shear = (principal[a] - principal[b])",
        "shear = 0.5 * (principal[a] - principal[b])",
        STATES,
    ),
    Bug(
        "Ogden: tangent of equal stretches",
        LAWS,
        "gamma[a, b] - 2.0 * beta[a])",
        "gamma[a, b] + 2.0 * beta[a])",
        "equal",
    ),
    Bug(
        "volumetric energy: tangent",
        LAWS,
        "_add_product(D, -2.0 * J * d_u, inverse)",
        "_add_product(D, 2.0 * J * d_u, inverse)",
        STATES,
    ),
    # elements and assembly
    Bug(
        "H8: one Gauss weight wrong",
        ELEMENTS,
        "np.ones(8)",
        "np.array([1.0] * 7 + [1.2])",
        f"({ALL}) and not (tetrahedron or turned)",
    ),
    Bug(
        "H8: Gauss points at the wrong place",
        ELEMENTS,
        "_CORNERS / np.sqrt(3.0)",
        "_CORNERS / np.sqrt(1.5)",
        "elastica or slender or manufactured and not tetrahedron",
    ),
    Bug(
        "T4: two nodes exchanged",
        ELEMENTS,
        "[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]",
        "[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]",
        STATES,
    ),
    Bug(
        "T4: weight of the pyramid",
        ELEMENTS,
        "np.array([1.0 / 6.0])",
        "np.array([1.0 / 3.0])",
        f"{STATES} or contrast or felupe",
    ),
    Bug(
        "inverted cells accepted", ELEMENTS, "if not np.all(det_j > least):", "if False:", "refused"
    ),
    Bug(
        "NaN in det J accepted",
        ELEMENTS,
        "if not np.all(det_j > least):",
        "if np.any(det_j <= least):",
        "refused",
    ),
    Bug(
        "selective: gradient at the centre, not the mean",
        ASSEMBLY,
        'mean = np.einsum("cq,cqaj->caj", weights, gradients) / volume[:, None, None]',
        "mean = shape_gradients(points, cells, element.centre[None])[0][:, 0]",
        f"{STATES} or cures",
    ),
    Bug("selective integration ignored", ASSEMBLY, "if not selective:", "if True:", "cures"),
    Bug(
        "weights of cells ignored",
        ASSEMBLY,
        "else quadrature.weights * cell_weights[:, None]",
        "else quadrature.weights",
        "contrast",
    ),
    Bug(
        "block of nodes in falling order not transposed",
        ASSEMBLY,
        "np.where(swapped, start[:, j] + i,",
        "np.where(swapped, start[:, i] + j,",
        "contrast or direct or quadratically or reorders",
    ),
    # Newton
    Bug(
        "tolerance ignored by the accelerated pass",
        NEWTON,
        "if size <= tolerance * load_norm:\n            break",
        "if size <= 1e-1 * load_norm:\n            break",
        f"{CORE} or nearly or turned or (felupe and not every)",
    ),
    Bug(
        "tolerance ignored by Newton's method",
        NEWTON,
        "if _met(load - state.force, load_norm, tolerance):",
        "if _met(load - state.force, load_norm, 1e-1):",
        f"{CORE} or solver",
    ),
    Bug(
        "accelerated pass: negative curvature of probes accepted",
        NEWTON,
        "converged=probes.convex",
        "converged=True",
        "unstable or column",
    ),
    Bug(
        "iterative solvers: solutions not certified",
        MODEL,
        "if self._iterative:\n            force",
        "if False:\n            force",
        "column",
    ),
    Bug(
        "det F not checked",
        NEWTON,
        "return self.converged and self.min_det_f > 0",
        "return self.converged",
        "confined or huge or limit or arch",
    ),
    Bug(
        "the last state returned where there is no equilibrium",
        NEWTON,
        'raise NoEquilibriumError(f"no',
        'return Solution(q, 1.0, iterations, cuts)\n            raise NoEquilibriumError(f"no',
        "column",
    ),
    Bug(
        "cut-backs not limited",
        NEWTON,
        "if cuts > options.max_cuts or",
        "if cuts > 2 * options.max_cuts or",
        "cut_back",
    ),
    Bug(
        "safeguarded pass takes half a load for the whole",
        NEWTON,
        "if target == 1.0:",
        "if target >= 0.5:",
        "cut_back or huge",
    ),
    Bug(
        "start perturbed at random",
        NEWTON,
        "q = (yield [(load, rotations)])[0] if",
        "q = (yield [(load, rotations)])[0] * (1 + 1e-9 * np.random.random(len(load))) if",
        "identical or mirrored or among",
    ),
    Bug(
        "increments: the first attempt returned",
        NEWTON,
        '            story = f"stopped',
        '            return Solution(attempt.q, attempt.min_det_f, iterations, cuts)\n            story = f"stopped',
        "confined or huge or arch or limit or inversion",
    ),
    Bug(
        "round-off floor of a small load not recognised",
        NEWTON,
        "max(float(np.abs(q).max()), extent)",
        "float(np.abs(q).max())",
        "tiny",
    ),
    Bug(
        "ill-conditioning not reported",
        MODEL,
        "if condition > ILL_CONDITIONED:",
        "if False:",
        "ill_conditioned",
    ),
    Bug(
        "loads that are not finite solved",
        NEWTON,
        "or not np.isfinite(array).all():",
        "or False:",
        "refuses",
    ),
    Bug(
        "loads beyond all bounds solved",
        NEWTON,
        "if np.abs(load).max() > MAX_LOAD_N:",
        "if False:",
        "refuses",
    ),
    Bug(
        "starts of another shape taken",
        NEWTON,
        "or array.shape != (problem.n_unknowns,)",
        "",
        "refuses",
    ),
    Bug(
        "round-off for an answer to a tiny load",
        NEWTON,
        "<= LINEAR * problem.extent",
        "<= 0.0 * problem.extent",
        "tiny",
    ),
    Bug(
        "scale of one load taken for all",
        ROTATED,
        "or 1.0) for residual in residuals]",
        "or 1.0) for residual in [residuals[0]] * len(residuals)]",
        "among",
    ),
    Bug(
        "accelerated pass without memory",
        ANDERSON,
        "self._held = min(self._count, WINDOW)",
        "self._held = 0",
        "turned or solver or among or multigrid",
    ),
    # solvers
    Bug(
        "banded Cholesky: indefinite accepted",
        LINEAR,
        "if info != 0:",
        "if info < 0:",
        "direct or huge or conjugate",
    ),
    Bug(
        "SuperLU: indefinite accepted",
        LINEAR,
        "if not np.all(lu.U.diagonal() > 0):",
        "if False:",
        "direct",
    ),
    Bug("band not reordered", LINEAR, "min(natural, reordered)", "natural", "reorders"),
    Bug(
        "banded Cholesky: solution not put back in order",
        LINEAR,
        "solution[self._order] = ",
        "solution[:] = ",
        "reorders",
    ),
    Bug(
        "dense Cholesky: indefinite accepted",
        GALERKIN,
        "if info != 0:",
        "if info < 0:",
        "unstable or confined or limit or arch",
    ),
    Bug(
        "conjugate gradients: indefinite accepted",
        ROTATED,
        "if not curvature > 0.0:",
        "if curvature == 0.0:",
        "conjugate or turned",
    ),
    Bug(
        "rotations dropped",
        ROTATED,
        "Q[2, 0], Q[2, 1], Q[2, 2] = a, b, c, d, e, f, g, h, i",
        "Q[2, 0], Q[2, 1], Q[2, 2] = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0",
        "conjugate or turned or solver",
    ),
    Bug(
        "Pardiso: the first factor kept",
        LINEAR,
        "self._matrix.data = np.ascontiguousarray(values)",
        "pass",
        "solver",
    ),
    Bug(
        "block-Jacobi: wrong blocks",
        ROTATED,
        "first + 2, second + 1, third], axis=1)",
        "first + 2, second, third], axis=1)",
        "solver",
    ),
    Bug(
        "multigrid: a solve that failed is accepted",
        LINEAR,
        "if not missed <= ACCEPTED_RESIDUAL:",
        "if missed > 1e9:",
        "plates",
    ),
    Bug("unknown solvers taken", MODEL, "if self.solver not in SOLVERS:", "if False:", "exist"),
    Bug(
        "multigrid: solves not to the end",
        LINEAR,
        "CYCLE_TOLERANCE = 1e-12",
        "CYCLE_TOLERANCE = 1e-4",
        "multigrid",
    ),
    Bug(
        "conjugate gradients: product with K",
        ROTATED,
        "y2 += k20 * z0 + k21 * z1 + k22 * z2",
        "y2 += k20 * z0 + k12 * z1 + k22 * z2",
        "conjugate or turned",
    ),
    # stability
    Bug("highest eigenvalue for the lowest", STABILITY, 'which="SA"', 'which="LA"', "lowest"),
    Bug(
        "eigenvalue not relative to rest",
        STABILITY,
        "scipy.linalg.eigvalsh(here, there,",
        "scipy.linalg.eigvalsh(here, np.eye(n),",
        "limit",
    ),
    Bug("limit: leaps not noticed", STABILITY, "LEAP = 0.25", "LEAP = 1e9", "arch or limit"),
    Bug(
        "limit: stops at a coarse factor",
        STABILITY,
        "tolerance: float = 1e-8",
        "tolerance: float = 1e-2",
        "limit or arch",
    ),
    Bug(
        "limit: inverse factor named",
        STABILITY,
        "{limit.factor:.6g}",
        "{1 / limit.factor:.6g}",
        "limit or arch",
    ),
    # checks
    Bug("supports not checked", MODEL, "    if free:\n", "    if False:\n", "named"),
    Bug(
        "locking warned of too late",
        LOCKING,
        "LOCKING_FROM = 0.45",
        "LOCKING_FROM = 0.47",
        "warned or check",
    ),
    Bug(
        "locking warned of too early",
        LOCKING,
        "LOCKING_FROM = 0.45",
        "LOCKING_FROM = 0.4",
        "warned or check",
    ),
    Bug(
        "locking not said by check",
        CHECK,
        "if risk else said",
        "if False else said",
        "warned or check",
    ),
    Bug("complex forces accepted", SURROGATE, 'not in "fiu"', 'not in "fiuc"', "refused"),
    Bug(
        "forces of any size accepted",
        SURROGATE,
        "(np.abs(array) <= MAX_FORCE_N).all()",
        "True",
        "refused",
    ),
)


def sources(bug: Bug, root: Path = ROOT) -> tuple[str, str]:
    """The file's text without and with the bug.

    Raises
    ------
    ValueError
        If the text to replace is not found exactly once.
    """
    text = (root / bug.file).read_text(encoding="utf-8")
    if text.count(bug.text) != 1:
        raise ValueError(
            f"{bug.name}: {bug.text!r} must be found once in {bug.file}; found {text.count(bug.text)} times."
        )
    return text, text.replace(bug.text, bug.wrong)


def test_functions() -> list[str]:
    """`file::function` of every test of this folder but the one about this program."""
    found = []
    for path in sorted(Path(__file__).parent.glob("test_*.py")):
        if path.name != "test_planted_bugs.py":
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found += [
                f"{path.name}::{node.name}"
                for node in tree.body
                if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
            ]
    return found


def run(tree: Path, tests: str, limit_s: float = LIMIT_S) -> tuple[set[str], bool]:
    """Red test functions of a copy, and whether the suite ran at all."""
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tree / ".numba"),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONUNBUFFERED": "1",
        "PYTHONPATH": str(tree),
        "OMP_NUM_THREADS": "1",
    }
    command = [
        sys.executable,
        "-m",
        "pytest",
        "tests/verification",
        "-v",
        "--tb=no",
        "-p",
        "no:cacheprovider",
        "-k",
        tests,
    ]
    command += ["--ignore", "tests/verification/test_planted_bugs.py"]
    try:
        output = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=limit_s
        ).stdout
    except subprocess.TimeoutExpired as error:
        output = (error.stdout or b"").decode()
    red = re.findall(r"^tests/verification/(\w+\.py::\w+).* (?:FAILED|ERROR)", output, re.MULTILINE)
    return set(red), " PASSED" in output or bool(red)


def plant(bug: Bug, tree: Path) -> set[str]:
    """Red test functions with one bug in a copy, which is put back in order afterwards.

    Numba keeps compiled kernels by the source's path and content, so that copies must last.
    """
    before, planted = sources(bug, tree)
    (tree / bug.file).write_text(planted, encoding="utf-8")
    red, _ = run(tree, bug.tests)
    (tree / bug.file).write_text(before, encoding="utf-8")
    shutil.rmtree(tree / ".numba")
    shutil.copytree(tree / ".numba-clean", tree / ".numba")
    print(f"{bug.name}: {len(red)} red", flush=True)
    return red


def prepare(tree: Path) -> set[str]:
    """Copy the package and compile its kernels by a run of the suite; red test functions, or the word that nothing ran."""
    for name in COPIED:
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tree)
    red, ran = run(tree, ALL, 10 * LIMIT_S)
    shutil.copytree(tree / ".numba", tree / ".numba-clean")
    return red if ran else {"nothing ran"}


def read_record() -> dict[str, set[str]]:
    """Bug → tests that it turned red, from the record's second table."""
    caught: dict[str, set[str]] = {bug.name: set() for bug in BUGS}
    for test, bugs in re.findall(
        r"^\| `(\w+\.py::\w+)` \| (.*) \|$", RECORD.read_text(encoding="utf-8"), re.MULTILINE
    ):
        for name in caught.keys() & set(bugs.split("; ")):
            caught[name].add(test)
    return caught


def write_record(caught: dict[str, set[str]], tests: list[str]) -> None:
    """Both tables: bug → tests, test → bugs."""
    lines = [
        "# Planted bugs",
        "",
        "Written by `python -m tests.verification.planted_bugs`: each bug is planted alone in a copy of the package.",
        "",
    ]
    lines += [
        "Of each bug only the tests run that its line in the program selects.",
        "",
        "| bug | tests that turn red |",
        "|---|---|",
    ]
    for name, red in caught.items():
        named = ", ".join(f"`{test.split('::')[1]}`" for test in sorted(red))
        lines.append(f"| {name} | {named or '**none**'} |")
    lines += ["", "| test | bugs that it has caught |", "|---|---|"]
    for test in tests:
        bugs = [name for name, red in caught.items() if test in red]
        lines.append(f"| `{test}` | {'; '.join(bugs) or '**none**'} |")
    RECORD.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        help="Only bugs whose name holds one of these texts; the others stay as recorded.",
    )
    arguments = parser.parse_args()
    bugs = [
        bug
        for bug in BUGS
        if not arguments.only or any(text in bug.name for text in arguments.only)
    ]
    for bug in bugs:
        sources(bug)
    with (
        tempfile.TemporaryDirectory(prefix="planted-") as folder,
        ThreadPoolExecutor(arguments.workers) as pool,
    ):
        trees = [Path(folder) / str(number) for number in range(arguments.workers)]
        red = set().union(*pool.map(prepare, trees))
        if red:
            print(f"red without a bug: {sorted(red)}")
            return 1
        free: SimpleQueue[Path] = SimpleQueue()
        for tree in trees:
            free.put(tree)

        def plant_somewhere(bug: Bug) -> set[str]:
            tree = free.get()
            try:
                return plant(bug, tree)
            finally:
                free.put(tree)

        caught = dict(zip([bug.name for bug in bugs], pool.map(plant_somewhere, bugs), strict=True))
    if arguments.only:
        caught = {**read_record(), **caught}
    tests = test_functions()
    unnoticed = [name for name, red in caught.items() if not red]
    never = [test for test in tests if not any(test in red for red in caught.values())]
    write_record(caught, tests)
    for name in unnoticed:
        print(f"unnoticed: {name}")
    for test in never:
        print(f"never red: {test}")
    return int(bool(unnoticed or never))


if __name__ == "__main__":
    sys.exit(main())
