"""The laws of the source tree, each as a function that lists what breaks it.

Every check takes the tree as a dict that maps each path, relative to the root, to its source text.
So a test can plant a violation without touching a file.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from itertools import takewhile
from pathlib import Path

Tree = dict[str, str]

FLOORS = (
    (
        "errors",
        "compile_clock",
        "counting",
        "digests",
        "machine",
        "parent_death",
        "scratch",
        "version",
        "checked_files",
        "checkout",
        "array_files",
    ),
    ("specs", "options"),
    ("scene",),
    ("mechanics",),
    ("snapshots",),
    ("reduction",),
    (
        "training_options",
        "model_arrays",
        "model_file",
        "surrogate",
        "method_loading",
    ),
    ("learning",),
    ("surrogates",),
    ("sandbox",),
    ("measure",),
    ("results",),
    ("analysis",),
    ("runs",),
    ("hard_cases",),
    ("report",),
    ("export",),
    ("adapters",),
    ("",),  # mor_bench/__init__.py
    ("cli",),
    ("__main__",),
)
"""The rooms from the ground up. A room imports from its own floor and from floors below."""

MAX_FILE, MAX_FUNCTION, MAX_PARAMETERS, MAX_WIDTH = 400, 60, 6, 100

FOR_TOOLS = re.compile(r"\s+# (type: ignore|noqa).*")

PUBLIC_UNDERSCORES = {"_exit", "_replace", "_asdict", "_fields", "_getframe", "_name"}
"""Documented names of the standard library that begin with an underscore."""

WITHOUT_PUBLIC_NAME = {
    "_call_pardiso",  # pypardiso: solve with an existing factorisation
    "_reorder_convolution_weight",  # oneDNN's operators in torch
    "_convolution_pointwise",
}
"""Names of other libraries for what they offer in no other way."""


def read_tree() -> Tree:
    """Read every Python file of the package and of the tests."""
    root = Path(__file__).parents[1]
    return {
        path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
        for folder in ("mor_bench", "tests")
        for path in sorted((root / folder).rglob("*.py"))
    }


@cache
def _parsed(source: str) -> ast.Module:
    return ast.parse(source)


@cache
def _nodes(source: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(_parsed(source)))


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@cache
def _modules(paths: frozenset[str]) -> frozenset[str]:
    return frozenset(map(_module, paths))


def _imports(path: str, tree: Tree) -> Iterator[tuple[int, str, str]]:
    """Yield line, imported module of this tree, and imported name or "" for the module itself."""
    modules = _modules(frozenset(tree))
    for node in _nodes(tree[path]):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name in modules:
                    yield node.lineno, alias.name, ""
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                if inner in modules:
                    yield node.lineno, inner, ""
                elif node.module in modules:
                    yield node.lineno, node.module, alias.name


def _floor(module: str) -> int:
    room = [*module.split("."), ""][1]
    return next((n for n, rooms in enumerate(FLOORS) if room in rooms), -1)


def arrows_back(tree: Tree) -> list[str]:
    """List imports from a higher floor, also inside functions and for type checkers only."""
    return [
        f"{path}:{line}: imports {module}, which stands above it"
        for path in tree
        if path.startswith("mor_bench/")
        for line, module, _ in _imports(path, tree)
        if _floor(module) > _floor(_module(path)) or _floor(_module(path)) < 0
    ]


def circles(tree: Tree) -> list[str]:
    """List modules that import each other, directly or through others."""
    graph = {
        _module(path): {module for _, module, _ in _imports(path, tree)} - {_module(path)}
        for path in tree
        if path.startswith("mor_bench/")
    }
    found = []
    for start in graph:
        reached: set[str] = set()
        waiting = [start]
        while waiting:
            for module in graph.get(waiting.pop(), set()) - reached:
                reached.add(module)
                waiting.append(module)
        if start in reached:
            found.append(f"{start}: is part of a circle of imports")
    return found


def imports_of_tests(tree: Tree) -> list[str]:
    """List imports from files of tests: shared helpers live in modules of their own."""
    return [
        f"{path}:{line}: imports {module}"
        for path in tree
        for line, module, _ in _imports(path, tree)
        if module.split(".")[-1].startswith("test_") and module.startswith("tests.")
    ]


def _is_private(name: str) -> bool:
    hidden = name.startswith("_") and not (name.startswith("__") and name.endswith("__"))
    return hidden and name != "_" and name not in PUBLIC_UNDERSCORES | WITHOUT_PUBLIC_NAME


def _defined(source: str) -> set[str]:
    """Collect the names that a module defines anywhere: functions, classes, attributes."""
    names = set()
    for node in _nodes(source):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif (
            isinstance(node, ast.Attribute)
            and isinstance(node.ctx, ast.Store)
            and isinstance(node.value, ast.Name)
            and node.value.id in ("self", "cls")
        ):
            names.add(node.attr)
    return names


def private_names(tree: Tree) -> list[str]:
    """List private names of other modules that are imported or accessed, also by `getattr`."""
    found = []
    for path, source in tree.items():
        for line, module, name in _imports(path, tree):
            if _is_private(name or module.split(".")[-1]):
                found.append(f"{path}:{line}: imports {name or module} of {module}")
        own = _defined(source)
        for node in _nodes(source):
            if isinstance(node, ast.Attribute):
                name = node.attr
            elif (
                isinstance(node, ast.Call)
                and getattr(node.func, "id", getattr(node.func, "attr", ""))
                in ("getattr", "setattr", "hasattr", "delattr")
                and len(node.args) > 1
                and isinstance(node.args[1], ast.Constant)
            ):
                name = str(node.args[1].value)
            else:
                continue
            if _is_private(name) and name not in own:
                found.append(f"{path}:{node.lineno}: accesses {name}, which is not defined here")
    return found


def long_files(tree: Tree) -> list[str]:
    """List files over 400 lines whose docstring does not say why."""
    return [
        f"{path}: {n} lines"
        for path, source in tree.items()
        if (n := len(source.splitlines())) > MAX_FILE
        and not any(
            line.strip().startswith("Longer than 400 lines because")
            for line in (ast.get_docstring(_parsed(source)) or "").splitlines()
        )
    ]


def _functions(tree: Tree) -> Iterator[tuple[str, ast.FunctionDef]]:
    for path, source in tree.items():
        for node in _nodes(source):
            if isinstance(node, ast.FunctionDef):
                yield path, node


def _length(function: ast.FunctionDef) -> int:
    """Count the lines of a function from ``def`` to its end, without its docstring."""
    lines = (function.end_lineno or 0) - function.lineno + 1
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        lines -= (first.end_lineno or 0) - first.lineno + 1
    return lines


def _comment_above(source: str, function: ast.FunctionDef) -> list[str]:
    """Return the lines of the comment right above a function and its decorators."""
    first = min([function.lineno, *(d.lineno for d in function.decorator_list)])
    above = reversed(source.splitlines()[: first - 1])
    return [line.strip(" #") for line in takewhile(lambda line: line.startswith("#"), above)]


def _says_why_it_is_long(source: str, function: ast.FunctionDef) -> bool:
    docstring = (ast.get_docstring(function) or "").splitlines()
    lines = [*docstring, *_comment_above(source, function)]
    return any(line.startswith("Longer than 60 lines because") for line in lines)


def long_functions(tree: Tree) -> list[str]:
    """List functions over 60 lines, docstrings not counted.

    A compiled kernel may be longer if its docstring or the comment above it says why, because a
    call of another compiled function can cost time.
    """
    return [
        f"{path}:{function.lineno}: {function.name} has {n} lines"
        for path, function in _functions(tree)
        if (n := _length(function)) > MAX_FUNCTION
        and not (_is_compiled(function) and _says_why_it_is_long(tree[path], function))
    ]


def _parameters(function: ast.FunctionDef) -> list[str]:
    arguments = function.args
    names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def _is_compiled(function: ast.FunctionDef) -> bool:
    names = {getattr(getattr(d, "func", d), "id", "") for d in function.decorator_list}
    return "njit" in names


def many_parameters(tree: Tree) -> list[str]:
    """List functions with more than six parameters; ``self`` is not counted.

    Compiled kernels are not listed: Numba takes arrays and numbers, but no dataclass.
    """
    return [
        f"{path}:{function.lineno}: {function.name} has {n} parameters"
        for path, function in _functions(tree)
        if (n := len(_parameters(function))) > MAX_PARAMETERS and not _is_compiled(function)
    ]


def names_twice(tree: Tree) -> list[str]:
    """List file names that occur twice, or that the standard library has."""
    stems = Counter(Path(path).stem for path in tree)
    return [
        f"{path}: {'twice in the tree' if stems[stem] > 1 else 'a name of the standard library'}"
        for path in tree
        if (stem := Path(path).stem) not in ("__init__", "__main__")
        and (stems[stem] > 1 or stem in sys.stdlib_module_names)
    ]


def missing_docstrings(tree: Tree) -> list[str]:
    """List files without a docstring; that of a package has at least five lines."""
    found = []
    for path, source in tree.items():
        docstring = (ast.get_docstring(_parsed(source)) or "").splitlines()
        package = path.endswith("__init__.py") and path.startswith("mor_bench/")
        if len(docstring) < (5 if package else 1) and source.strip():
            found.append(f"{path}: docstring of {len(docstring)} lines")
        if package and not source.strip():
            found.append(f"{path}: no docstring")
    return found


def formatting(tree: Tree) -> list[str]:
    """List lines over 100 characters, and comments that switch the formatter off.

    As for the linter, a comment for tools at the end of a line does not count.
    """
    off = ("# fmt" + ": skip", "# fmt" + ": off")
    return [
        f"{path}:{number}: {len(line)} characters, or formatter off"
        for path, source in tree.items()
        for number, line in enumerate(source.splitlines(), 1)
        if len(FOR_TOOLS.sub("", line)) > MAX_WIDTH or any(word in line for word in off)
    ]


CHECKS: dict[str, Callable[[Tree], list[str]]] = {
    check.__name__: check
    for check in (
        arrows_back,
        circles,
        imports_of_tests,
        private_names,
        long_files,
        long_functions,
        many_parameters,
        names_twice,
        missing_docstrings,
        formatting,
    )
}
