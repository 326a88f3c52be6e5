"""What a method's results depend on beside its data and knobs: the source of all that it imports, and libraries' versions."""

from __future__ import annotations

import ast
import hashlib
import platform
from collections.abc import Iterator
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

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

DATA_ONLY = frozenset(
    f"mor_bench.snapshots.{name}"
    for name in ("executors", "generate", "manifest", "solve", "store", "test_sets")
)
"""What makes datasets has its say through the samples themselves, which are part of a fit's key."""


def code_digest(surrogate: str, folder: Path | None = None) -> str:
    """SHA-256 of the sources that ``package.module:Class`` imports, of this package or beside it, and of versions.

    Parameters
    ----------
    surrogate : str
    folder : Path, optional
        Where a third party's module lies, unless it is installed.
    """
    digest = hashlib.sha256()
    for name, path in sorted(_closure(surrogate.partition(":")[0], folder).items()):
        digest.update(name.encode() + b"\0" + _source_digest(path, path.stat().st_mtime_ns))
    digest.update(repr(library_versions()).encode())
    return digest.hexdigest()


@cache
def library_versions() -> dict[str, str]:
    """Versions that results depend on; the names of absent libraries are left out."""
    found = {"python": platform.python_version()}
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found


@cache
def _source_digest(path: Path, changed: int) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()


@cache
def _imports_of(path: Path, changed: int, package: str) -> tuple[str, ...]:
    """Names that a source file imports, anywhere in it; of ``from a import b`` both a and a.b."""
    names: list[str] = []
    for node in _nodes(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = (
                package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            )
            base = ".".join(filter(None, [*above, node.module]))
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return tuple(dict.fromkeys(names))


def _nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those for type checkers only."""
    for node in ast.iter_child_nodes(tree):
        if (
            isinstance(node, ast.If)
            and isinstance(node.test, ast.Name)
            and node.test.id == "TYPE_CHECKING"
        ):
            continue
        yield node
        yield from _nodes(node)


def _closure(module: str, folder: Path | None) -> dict[str, Path]:
    """All modules of this package, and of the method's own, that a module imports, with their files; and what all methods are."""
    own = module.partition(".")[0]
    found: dict[str, Path] = {}
    waiting = [module, "mor_bench.surrogate"]
    while waiting:
        name = waiting.pop()
        if name in found or name in DATA_ONLY:
            continue
        path = _file_of(
            name,
            folder if name.partition(".")[0] != "mor_bench" else None,
            installed=name.partition(".")[0] in (own, "mor_bench"),
        )
        if path is None:
            continue
        found[name] = path
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        waiting += _imports_of(path, path.stat().st_mtime_ns, package)
    return found


def _file_of(name: str, folder: Path | None, installed: bool) -> Path | None:
    """The source of a module, found without importing anything: beside the method's file, or an installed one that is its own."""
    parts = name.split(".")
    roots = [Path(__file__).parents[2]] if parts[0] == "mor_bench" else [folder] if folder else []
    for root in roots:
        stem = root.joinpath(*parts)
        for path in (stem.with_suffix(".py"), stem / "__init__.py"):
            if path.is_file():
                return path
    if parts[0] == "mor_bench" or not installed:
        return None
    search: list[str] | None = None
    spec = None
    for i in range(len(parts)):
        spec = PathFinder.find_spec(".".join(parts[: i + 1]), search)
        if spec is None:
            return None
        search = list(spec.submodule_search_locations or [])
    return Path(spec.origin) if spec and spec.origin and spec.origin.endswith(".py") else None
