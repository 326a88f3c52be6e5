"""Digest of the code that a method's results depend on: its imports, and library versions."""

from __future__ import annotations

import ast
import hashlib
import io
import platform
import tokenize
from collections.abc import Iterator
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mor_bench.checked_files import read_bytes

OWN = "mor_bench"
SOURCES = Path(__file__).parents[2]

LIBRARIES = (
    "numpy",
    "scipy",
    "numba",
    "scikit-learn",
    "torch",
    "pyamg",
    "pypardiso",
    "safetensors",
)

LEARNING_ROOMS = ("mor_bench.surrogates.", "mor_bench.learning.", "mor_bench.scene.grid")
"""Beginnings of the names of modules that define a network, its inputs and its training."""

NOT_LEARNING = (".onnx_model", ".onnx_graph", ".checkpoint")
"""Ends of the names of modules in these rooms that do not change what is learned."""

DATA_ONLY = frozenset(
    f"mor_bench.snapshots.{name}"
    for name in ("executors", "generate", "manifest", "solve", "store", "test_sets")
)
"""Modules that make datasets; the samples themselves are part of a fit's key."""


def code_digest(surrogate: str, folder: Path | None = None) -> str:
    """Return the SHA-256 of a class's sources and of library versions.

    Parameters
    ----------
    surrogate : str
        ``package.module:Class``.
    folder : Path, optional
        Folder of a third party's module, unless it is installed.
    """
    digest = hashlib.sha256()
    for name, path in sorted(imported_sources(surrogate.partition(":")[0], folder).items()):
        digest.update(name.encode() + b"\0" + _source_digest(path, path.stat().st_mtime_ns))
    digest.update(repr(library_versions()).encode())
    return digest.hexdigest()


@cache
def measuring_digest() -> str:
    """Return eight digits of a digest of the code that scores and times.

    It covers `mor_bench.measure` and the two modules of this package that call it.

    The names of cached scores and timings contain it, so a new metric or timing rule invalidates
    them.
    """
    digest = hashlib.sha256()
    runs = [Path(__file__).with_name(name) for name in ("scoring.py", "timing_stage.py")]
    for path in [*sorted((SOURCES / OWN / "measure").glob("*.py")), *runs]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


@cache
def library_versions() -> dict[str, str]:
    """Return the versions of the installed libraries that results depend on."""
    found = {"python": platform.python_version()}
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found


def learning_digest(surrogate: str) -> str:
    """Return the SHA-256 of the code that gives a trained model its meaning.

    It covers the sources in `LEARNING_ROOMS` that the class imports, without comments, docstrings
    and blank lines. So it changes with the network and its training, and with little else.
    """
    digest = hashlib.sha256()
    for name, path in sorted(imported_sources(surrogate.partition(":")[0]).items()):
        if name.startswith(LEARNING_ROOMS) and not name.endswith(NOT_LEARNING):
            digest.update(f"{name}\n{bare_code(path.read_text(encoding='utf-8'))}\n".encode())
    return digest.hexdigest()


def bare_code(source: str) -> str:
    """Return a source without comments, docstrings and blank lines."""
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            for row in range(node.lineno, (node.end_lineno or node.lineno) + 1):
                lines[row - 1] = ""
    return "\n".join(line.rstrip() for line in lines if line.strip())


def imported_sources(module: str, folder: Path | None = None) -> dict[str, Path]:
    """Return the source files that a module imports, by module name.

    Only modules of this package and of the method's own package count. The interface that every
    method has, `mor_bench.surrogate`, is always among them.
    """
    packages = {module.partition(".")[0], OWN}
    found: dict[str, Path] = {}
    waiting = [module, "mor_bench.surrogate"]
    while waiting:
        name = waiting.pop()
        if name in found or name in DATA_ONLY:
            continue
        top = name.partition(".")[0]
        path = _file_under(SOURCES if top == OWN else folder, name)
        if path is None and top != OWN and top in packages:
            path = _installed_file(name)
        if path is None:
            continue
        found[name] = path
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        waiting += _imports_of(path, path.stat().st_mtime_ns, package)
    return found


def _file_under(folder: Path | None, name: str) -> Path | None:
    """Find the source of a module below a folder."""
    if folder is None:
        return None
    stem = folder.joinpath(*name.split("."))
    candidates = (stem.with_suffix(".py"), stem / "__init__.py")
    return next((path for path in candidates if path.is_file()), None)


def _installed_file(name: str) -> Path | None:
    """Find the source of an installed module without importing it."""
    search: list[str] | None = None
    parts = name.split(".")
    for i in range(len(parts)):
        spec = PathFinder.find_spec(".".join(parts[: i + 1]), search)
        if spec is None:
            return None
        search = list(spec.submodule_search_locations or [])
    return Path(spec.origin) if spec and spec.origin and spec.origin.endswith(".py") else None


@cache
def _source_digest(path: Path, changed: int) -> bytes:
    return hashlib.sha256(read_bytes(path)).digest()


@cache
def _imports_of(path: Path, changed: int, package: str) -> tuple[str, ...]:
    """Return the names that a source file imports; ``from a import b`` gives a and a.b."""
    names: list[str] = []
    try:
        tree = ast.parse(read_bytes(path))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return ()  # nothing can import it either, and the method's row says so
    for node in _nodes(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")
            above = parents[: len(parents) - node.level + 1] if node.level else []
            base = ".".join(filter(None, [*above, node.module]))
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return tuple(dict.fromkeys(names))


def _nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes but those for type checkers only, in the order of the source.

    Expressions may be nested deeper than Python's recursion limit.
    """
    waiting = [iter([tree])]
    while waiting:
        node = next(waiting[-1], None)
        if node is None:
            waiting.pop()
        elif not (isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"):
            yield node
            waiting.append(ast.iter_child_nodes(node))
