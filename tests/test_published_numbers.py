"""README and docs say what the stored evidence says: tables, numbers in sentences, pictures."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from mor_bench.results.comparison import Comparison
from mor_bench.specs import list_suite, load_method_spec
from tests.published.blocks import pages, with_blocks
from tests.published.claims import (
    EVERY_PAGE,
    measured_in_specification,
    statements,
    without_evidence,
    wrong_numbers,
)
from tests.published.compact import (
    ERRORS,
    wrong_bounds,
    wrong_conclusions,
    wrong_summaries,
    wrong_verdicts,
)
from tests.published.pictures import stale_pictures
from tests.published.stored import REPORTS, ROOT
from tests.verification.trust_record import git

NAMES = [path.relative_to(ROOT).as_posix() for path in pages()]
RUNS = sorted(
    path.parent.relative_to(REPORTS).as_posix()
    for path in REPORTS.rglob(ERRORS)
    if "runs" not in path.relative_to(REPORTS).parts
)
FILES = [
    path.relative_to(ROOT).as_posix()
    for folder in ("methods", "datasets")
    for path in sorted((ROOT / folder).glob("*.toml"))
]
MOST_BYTES = 50e6
LEAST_COMMITS = 100  # fewer: a copy without the history
COMMIT = re.compile(r'"?commit"?\s*[:=]\s*"([0-9a-f]{40})')


def _read(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", NAMES)
def test_every_table_is_generated_from_the_evidence(page: str) -> None:
    assert with_blocks(_read(page)) == _read(page), "run python -m tests.published.write"


@pytest.mark.parametrize("page", NAMES)
def test_every_number_in_a_sentence_is_that_of_the_evidence(page: str) -> None:
    wrong = list(wrong_numbers(page, _read(page), statements()))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("page", NAMES)
def test_every_number_has_evidence_or_a_reason_why_it_needs_none(page: str) -> None:
    found = list(without_evidence(page, _read(page), statements()))
    assert not found, "\n".join([f"{len(found)} numbers without an entry in claims.toml:", *found])


@pytest.mark.parametrize("page", NAMES)
def test_every_picture_is_drawn_from_the_evidence(page: str) -> None:
    stale = list(stale_pictures(ROOT / page, _read(page)))
    assert not stale, "\n".join(stale)


@pytest.mark.parametrize("file", FILES)
def test_no_method_or_dataset_file_states_a_measurement(file: str) -> None:
    found = list(measured_in_specification(file, statements()))
    assert not found, "\n".join(["measurements belong into reports/:", *found])


def test_every_entry_of_the_ledger_belongs_to_a_page() -> None:
    assert {statement.page for statement in statements()} <= {EVERY_PAGE, *NAMES, *FILES}
    texts = [_read(page) for page in NAMES]
    general = [statement for statement in statements() if statement.page == EVERY_PAGE]
    unused = [s.text for s in general if not any(map(s.pattern().search, texts))]
    assert not unused


@pytest.mark.parametrize("run", RUNS)
def test_the_errors_of_a_run_are_those_of_its_samples(run: str) -> None:
    wrong = list(wrong_summaries(REPORTS / run))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("run", RUNS)
def test_the_bounds_of_single_errors_follow_from_the_samples_of_a_run(run: str) -> None:
    wrong = list(wrong_bounds(REPORTS / run))
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS)
def test_the_conclusions_of_a_run_follow_from_its_samples(run: str) -> None:
    wrong = list(wrong_conclusions(REPORTS / run))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("run", RUNS)
def test_the_verdict_of_a_run_is_that_of_its_rows(run: str) -> None:
    wrong = list(wrong_verdicts(REPORTS / run))
    assert not wrong, "\n".join(wrong)


def _command(run: str) -> dict[str, str]:
    record: dict[str, str] = tomllib.loads((REPORTS / run / "run.toml").read_text("utf-8"))["run"]
    return record


def _needs_history() -> None:
    if not (ROOT / ".git").exists() or int(git("rev-list", "--count", "HEAD")) < LEAST_COMMITS:
        pytest.skip("the history is not here")


@pytest.mark.parametrize("run", RUNS)
def test_the_methods_of_a_command_were_in_its_commit(run: str) -> None:
    """Otherwise nobody could repeat the run."""
    _needs_history()
    record = _command(run)
    listed = git("ls-tree", "--name-only", record["commit"], "methods/").split()
    named = re.findall(r"-m '?([\w-]+)", record["command"])
    assert {f"methods/{name}.toml" for name in named} <= set(listed)


@pytest.mark.parametrize("run", RUNS)
def test_a_run_has_the_sweeps_of_the_methods_files(run: str) -> None:
    """A changed sweep asks for a new run."""
    comparison = Comparison.read(REPORTS / run)
    profile, command = comparison.settings["profile"], _command(run)["command"]
    for row in comparison.rows:
        if f"{row.method}[" not in command:
            sweep = load_method_spec(row.method).sweep_of(profile)
            assert all(value in sweep.get(key, ()) for key, value in row.swept.items()), row.label


def test_every_record_names_a_commit_of_the_history() -> None:
    _needs_history()
    files = [path for folder in ("reports", "datasets", "trained") for path in _records(folder)]
    found = {commit for path in files for commit in COMMIT.findall(path.read_text("utf-8"))}
    assert len(found) > 3
    assert found <= set(git("rev-list", "HEAD").split())


def _records(folder: str) -> list[Path]:
    """Return the tracked files of a folder that may name the commit of a measurement."""
    return [ROOT / name for name in git("ls-files", f"{folder}/*.json", f"{folder}/*.toml").split()]


def test_the_evidence_is_small() -> None:
    files = [p for p in REPORTS.rglob("*") if p.is_file() and REPORTS / "runs" not in p.parents]
    assert sum(path.stat().st_size for path in files) <= MOST_BYTES


COMPARISONS = re.compile(
    r"\b(faster|slower|slowest|fastest|always|better|worse|cheaper|expensive)\b"
    r"|\b(more|less) accurate\b"
)


@pytest.mark.parametrize("name", list_suite("methods"))
def test_the_files_of_methods_compare_with_no_other_method(name: str) -> None:
    """Which method is faster or more accurate is a matter of evidence, and stands in the report."""
    content = tomllib.loads(list_suite("methods")[name].read_text(encoding="utf-8"))
    for text in (content.get("limits", ""), content.get("regime", {}).get("says", "")):
        assert not COMPARISONS.search(text), text
