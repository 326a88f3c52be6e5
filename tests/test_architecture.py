"""The source tree keeps its laws, and every check of them can fail."""

from __future__ import annotations

import pytest

from tests.architecture_checks import CHECKS, Tree, read_tree

TREE = read_tree()


@pytest.mark.parametrize("check", CHECKS)
def test_the_source_tree_keeps_its_laws(check: str) -> None:
    broken = CHECKS[check](TREE)
    assert not broken, "\n".join([f"{len(broken)} violations:", *broken])


LOW, HIGH = "mor_bench/specs/low.py", "mor_bench/report/high.py"
LONG = "def f():\n" + "    x = 1\n" * 60
KERNEL = "@njit(cache=True)\n" + LONG
REASON = "# Longer than 60 lines because…\n"

PLANTED: list[tuple[str, Tree]] = [
    ("arrows_back", {LOW: "from mor_bench.report.high import draw", HIGH: ""}),
    ("arrows_back", {LOW: "def f():\n    import mor_bench.report.high", HIGH: ""}),
    ("arrows_back", {LOW: "if TYPE_CHECKING:\n    from mor_bench.report import high", HIGH: ""}),
    ("arrows_back", {"mor_bench/new_room/x.py": "import mor_bench.specs.low", LOW: ""}),
    ("circles", {LOW: "import mor_bench.specs.b", "mor_bench/specs/b.py": f"import {LOW}"}),
    ("imports_of_tests", {"tests/test_a.py": "from tests.test_b import f", "tests/test_b.py": ""}),
    ("private_names", {HIGH: "from mor_bench.specs.low import _f", LOW: "def _f(): ..."}),
    ("private_names", {HIGH: "low._f()"}),
    ("private_names", {HIGH: "monkeypatch.setattr(low, '_f', 1)"}),
    ("long_files", {LOW: "\n" * 401}),
    ("long_functions", {LOW: LONG}),
    ("long_functions", {LOW: REASON + LONG}),
    ("long_functions", {LOW: KERNEL}),
    ("long_functions", {LOW: REASON + "x = 1\n\n\n" + KERNEL}),
    ("many_parameters", {LOW: "class A:\n    def f(self, a, b, c, d, e, f, *, g): ..."}),
    ("names_twice", {LOW: "", "tests/low.py": ""}),
    ("names_twice", {"mor_bench/specs/code.py": ""}),
    ("missing_docstrings", {LOW: "x = 1"}),
    ("missing_docstrings", {"mor_bench/specs/__init__.py": '"""One line."""'}),
    ("formatting", {LOW: "#" * 101}),
    ("formatting", {LOW: "x = 1  # fmt" + ": skip"}),
]


@pytest.mark.parametrize(("check", "tree"), PLANTED)
def test_every_check_finds_a_planted_violation(check: str, tree: Tree) -> None:
    tree = {
        path: source.replace(f"import {LOW}", "import mor_bench.specs.low")
        for path, source in tree.items()
    }
    assert CHECKS[check](tree)


ALLOWED: list[tuple[str, Tree]] = [
    ("arrows_back", {HIGH: "from mor_bench.specs.low import read", LOW: ""}),
    (
        "private_names",
        {LOW: "class A:\n    def f(self):\n        self._x = 1\n        return b._x"},
    ),
    ("private_names", {LOW: "os._exit(1)"}),
    ("long_files", {LOW: '"""Tables.\n\nLonger than 400 lines because…"""' + "\n" * 401}),
    ("long_functions", {LOW: 'def f():\n    """' + "\n" * 80 + '    """\n'}),
    ("long_functions", {LOW: REASON + "# it is faster.\n" + KERNEL}),
    (
        "long_functions",
        {LOW: KERNEL.replace("():", '():\n    """Run.\n\n    Longer than 60 lines because…"""')},
    ),
    ("many_parameters", {LOW: "def f(self, a, b, c, d, e, f): ..."}),
    ("many_parameters", {LOW: "@njit(cache=True)\ndef f(a, b, c, d, e, f, g): ..."}),
]


@pytest.mark.parametrize(("check", "tree"), ALLOWED)
def test_no_check_is_stricter_than_its_law(check: str, tree: Tree) -> None:
    assert not CHECKS[check](tree)
