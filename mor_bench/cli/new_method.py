"""`mor-bench new-method`: the two files of a new method, which work as they are."""

from __future__ import annotations

import ast
import keyword
import re
import sys
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import Annotated

import typer

from mor_bench.cli.help_texts import command
from mor_bench.errors import SpecError
from mor_bench.specs import list_suite

app = typer.Typer(rich_markup_mode=None)


@command(
    app,
    {
        "new-method my-method": "Write my-method.toml and my_method.py to this folder.",
        "new-method my-method --folder ideas": "Write them to another folder.",
    },
    name="new-method",
)
def new_method(
    name: Annotated[str, typer.Argument(help="Name: lower-case letters, digits and hyphens.")],
    folder: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder to write to. In a checkout of mor-bench, the TOML goes to methods/ "
            "and the Python file to mor_bench/surrogates/.",
        ),
    ] = Path(),
) -> None:
    """Write a TOML and a Python file for a new method. Both work; change them step by step."""
    toml, source = write_method(name, folder)
    print(toml, source, sep="\n")
    tests = f"pytest -k {name}; " if source.parent != toml.parent else ""
    print(f"Next: mor-bench check {toml}; {tests}mor-bench run beam-tiny -m fem -m {toml}")


def write_method(name: str, folder: Path) -> tuple[Path, Path]:
    """Write the files of a new method and return their paths: the TOML and the Python file.

    Raises
    ------
    SpecError
        If the name is not allowed, or a file exists. Then nothing is written.
    """
    in_checkout = (folder / "methods").is_dir() and (folder / "mor_bench" / "surrogates").is_dir()
    module = name.replace("-", "_")
    _check_name(name, module, in_checkout)
    toml = (folder / "methods" if in_checkout else folder) / f"{name}.toml"
    source = (folder / "mor_bench" / "surrogates" if in_checkout else folder) / f"{module}.py"
    for path in (toml, source):
        if path.exists():
            raise SpecError(f"{path}: the file exists; choose another name or remove it.")
    words = {
        "title": name.replace("-", " ").strip().capitalize(),
        "class_name": _class_name(name),
        "target": f"{'mor_bench.surrogates.' if in_checkout else ''}{module}:{_class_name(name)}",
    }
    parts = ["new_method.toml.txt", *(["new_method_battery.toml.txt"] if in_checkout else [])]
    toml_text = "".join(_filled(part, words) for part in parts)
    folder.mkdir(parents=True, exist_ok=True)
    _write_all({toml: toml_text, source: _filled("new_method.py.txt", words)})
    return toml, source


def _class_name(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("-"))


def _check_name(name: str, module: str, in_checkout: bool) -> None:
    if not re.fullmatch("[a-z][a-z0-9-]*", name):
        raise SpecError(
            "the name of a method must hold lower-case letters, digits and hyphens, "
            f"and begin with a letter; got {name!r}."
        )
    if name in list_suite("methods"):
        raise SpecError(f"{name!r} is a method of the suite; choose another name.")
    known = keyword.iskeyword(module) or keyword.iskeyword(_class_name(name))
    if known or module in sys.stdlib_module_names or (not in_checkout and find_spec(module)):
        raise SpecError(f"{name!r}: Python has a module or keyword of this name; choose another.")
    if _class_name(name) in _imported_names():
        raise SpecError(
            f"{name!r}: its class would be called {_class_name(name)}, "
            "a name that its file imports; choose another."
        )


def _imported_names() -> set[str]:
    source = _filled("new_method.py.txt", {"title": "Title", "class_name": "Method"})
    imports = [
        n for n in ast.walk(ast.parse(source)) if isinstance(n, (ast.Import, ast.ImportFrom))
    ]
    return {alias.asname or alias.name for node in imports for alias in node.names}


def _filled(template: str, words: dict[str, str]) -> str:
    text = (files("mor_bench.cli") / "templates" / template).read_text(encoding="utf-8")
    return Template(text).substitute(words)


def _write_all(texts: dict[Path, str]) -> None:
    """Write all files or none."""
    written: list[Path] = []
    try:
        for path, text in texts.items():
            with path.open("x", encoding="utf-8") as file:
                written.append(path)
                file.write(text)
    except BaseException:
        for path in written:
            path.unlink()
        raise
