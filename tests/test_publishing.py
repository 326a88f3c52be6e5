"""The tools of published numbers find a wrong number, an unlisted number and a stale picture."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from matplotlib import image

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.draws import VALIDATION
from mor_bench.results.comparison import Comparison
from tests.published.blocks import with_blocks
from tests.published.claims import (
    NUMBER,
    Statement,
    measured_in_specification,
    prose,
    with_numbers,
    without_evidence,
    wrong_numbers,
)
from tests.published.compact import (
    ERRORS,
    compact,
    reword,
    verdict_again,
    wrong_bounds,
    wrong_conclusions,
    wrong_summaries,
    wrong_verdicts,
)
from tests.published.literature_table import literature
from tests.published.pictures import draw_pictures, stale_pictures
from tests.published.run_tables import covered
from tests.published.stored import REPORTS, EvidenceError, content_of, look_up, run_of
from tests.synthetic import synthetic_comparison

PAGE = "docs/page.md"


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic run in compact form."""
    folder = tmp_path_factory.mktemp("published")
    made = synthetic_comparison(folder / "run")
    made.rows = [row.with_parts(hidden=None) for row in made.rows]
    made.finish(analyse(made, n_resamples=50))
    compact(folder / "run", folder / "stored", "shown/stored")
    return folder / "stored"


def test_the_compact_form_keeps_errors_and_latencies_and_no_predictions(stored: Path) -> None:
    assert list(wrong_summaries(stored)) == []
    with h5py.File(stored / ERRORS, "r") as file:
        arrays = file["beam-coarse"]["linear-fem"]
        assert arrays["relative_l2"].dtype == np.float32
        assert arrays["latency_ms"].dtype == np.float32
        assert arrays["round"].dtype == np.uint8
        assert "worst_prediction" not in arrays


def test_an_error_that_its_samples_do_not_give_is_found(stored: Path, tmp_path: Path) -> None:
    shutil.copytree(stored, tmp_path / "copy")
    path = tmp_path / "copy" / "results.json"
    content = json.loads(path.read_text())
    row = look_up(content, "rows/label=linear-fem")
    row["error"]["rel_l2_median"] *= 1.001
    path.write_text(json.dumps(content))
    (found,) = wrong_summaries(tmp_path / "copy")
    assert "linear-fem: rel_l2_median" in found


def test_a_verdict_that_its_rows_do_not_give_is_found(stored: Path, tmp_path: Path) -> None:
    assert list(wrong_verdicts(stored)) == []
    shutil.copytree(stored, tmp_path / "copy")
    path = tmp_path / "copy" / "comparison.json"
    content = json.loads(path.read_text())
    content["verdicts"][0]["qualified"].reverse()
    content["rows"][0]["rel_l2_median"]["high"] = 0.0
    path.write_text(json.dumps(content))
    outside, order = wrong_verdicts(tmp_path / "copy")
    assert "rel_l2_median lies outside its interval" in outside
    assert "qualify, stated are" in order


def test_stored_verdicts_are_worded_as_the_code_does(stored: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(stored, tmp_path / "copy")
    assert not reword(folder)
    path = folder / "comparison.json"
    now = path.read_text()
    content = json.loads(now)
    verdict = content["verdicts"][0]
    verdict["headline"] = "An old headline."
    lines = verdict["beside"]
    verdict["beside"] = [f"old {line}" if "Best when" in line else line for line in lines]
    path.write_text(json.dumps(content))
    content_of.cache_clear()
    assert len(list(wrong_verdicts(folder))) > 1
    assert reword(folder)
    assert path.read_text() == now
    content_of.cache_clear()
    assert list(wrong_verdicts(folder)) == []


def test_the_table_of_literature_needs_the_experiment_of_its_number(tmp_path: Path) -> None:
    text = (REPORTS / "literature.toml").read_text()
    commands = literature("reports/literature.toml").count("`python -m tests.published.record ")
    assert commands == text.count("[[number]]")
    wrong = text.replace('experiment = "full-order/peers.json"', 'experiment = "quick-start"')
    (tmp_path / "wrong.toml").write_text(wrong)
    with pytest.raises(EvidenceError, match=r"peers\.json is not of an experiment 'quick-start'"):
        literature(str(tmp_path / "wrong.toml"))


def forged(stored: Path, folder: Path, part: str, factor: float) -> Path:
    """Copy a run whose relative errors of a part are scaled in all texts, but not in its samples.

    Figures, intervals, and the verdicts that follow from them agree with each other.
    """
    shutil.copytree(stored, folder)
    figure = {"error": "rel_l2_median", "validation": VALIDATION}.get(part)
    content = json.loads((folder / "results.json").read_text())
    for row in content["rows"]:
        if row[part]:
            for name in ("rel_l2_median", "rel_l2_p95", "rel_l2_max"):
                row[part][name] *= factor
    (folder / "results.json").write_text(json.dumps(content))
    content = json.loads((folder / "comparison.json").read_text())
    for record in content["rows"]:
        if figure:
            record[figure] = {end: x and factor * x for end, x in record[figure].items()}
    for record in content["verdicts"]:
        again = verdict_again(Comparison.read(folder), content, record["dataset"]).summary()
        record.update({key: again[key] for key in ("qualified", "headline", "beside")})
    (folder / "comparison.json").write_text(json.dumps(content))
    content_of.cache_clear()
    return folder


@pytest.mark.parametrize("part", ["error", "validation", "hidden"])
def test_texts_that_agree_with_each_other_but_not_with_the_samples_are_found(
    part: str, tmp_path: Path
) -> None:
    folder = forged(REPORTS / "quick-start", tmp_path / "copy", part, 0.5)
    assert list(wrong_verdicts(folder)) == []
    found = list(wrong_summaries(folder))
    named = "rel_l2_median" + f" of {part}" * (part != "error")
    assert any(f"pod [n_modes=80]: {named} is" in line for line in found)


def test_a_bound_that_the_samples_do_not_give_is_found(tmp_path: Path) -> None:
    folder = shutil.copytree(REPORTS / "learned/named-sets", tmp_path / "copy")
    content = json.loads((folder / "results.json").read_text())
    linear, forces = (
        look_up(content, f"rows/label={name}/bound") for name in ("linear-fem", "pca-regression")
    )
    share, bound = linear["coverage"]["test"], forces["relative_l2"]
    linear["coverage"]["test"], forces["relative_l2"] = share - 0.001, 1.001 * bound
    (folder / "results.json").write_text(json.dumps(content))
    covers, differs, *_ = wrong_bounds(folder)
    assert f"linear-fem: {share:g} of the test is covered" in covers
    assert f"pca-regression: bound is {bound:g}, stated as {1.001 * bound:g}" in differs


def test_the_table_of_bounds_takes_each_method_from_the_first_run_that_has_it() -> None:
    first = covered("reports/learned/named-sets").splitlines()
    both = covered("reports/learned/named-sets,reports/learned/others").splitlines()
    assert both[: len(first)] == first
    beside = [line.split("|")[2].strip() for line in both[len(first) :]]
    others = run_of("reports/learned/others").rows
    unseen = {row.method for row in others} - {"linear-fem", "fem"}
    assert sorted(beside) == sorted(f"`{method}`" for method in unseen)
    row = look_up(
        content_of("reports/learned/named-sets/results.json"), "rows/label=pca-regression/bound"
    )
    (cells,) = [line.split(" | ") for line in first if "`pca-regression`" in line]
    assert cells[4] == f"{100 * row['relative_l2']:.3g}"
    assert cells[6].strip() == f"{100 * row['coverage']['test']:.3g}"


def test_a_interval_that_the_samples_do_not_give_is_found(stored: Path, tmp_path: Path) -> None:
    assert list(wrong_conclusions(stored)) == []
    shutil.copytree(stored, tmp_path / "copy")
    path = tmp_path / "copy" / "comparison.json"
    content = json.loads(path.read_text())
    figure = look_up(content, "rows/label=linear-fem/rel_l2_median")
    figure["high"] = figure["value"] * 1.0001
    path.write_text(json.dumps(content))
    (found,) = wrong_conclusions(tmp_path / "copy")
    assert "(linear-fem)/rel_l2_median/high is" in found


@pytest.mark.parametrize("table", ["selected", "verdict", "headline", "fastest", "facts"])
def test_a_table_that_was_edited_is_generated_again(stored: Path, table: str) -> None:
    page = with_blocks(f"Text\n\n<!-- from: {stored} {table} -->\nstale\n<!-- end -->\n\nMore\n")
    assert "stale" not in page
    assert page.endswith("<!-- end -->\n\nMore\n")
    assert with_blocks(page) == page
    first = page.index("-->\n") + 4
    assert with_blocks(page[:first] + "7" + page[first:]) == page


def test_a_table_shows_the_numbers_of_the_run(stored: Path) -> None:
    row = run_of(str(stored)).row("beam-coarse", "linear-fem")
    assert row.error is not None
    page = with_blocks(f"<!-- from: {stored} selected -->\n<!-- end -->")
    (line,) = [line for line in page.splitlines() if line.startswith("| `linear-fem` ")]
    assert f"| {100 * row.error.rel_l2_median:.3g} (" in line
    assert " * |" in line


@pytest.mark.parametrize("spec", ["no-such-folder selected", "{} no-such-table"])
def test_a_table_without_evidence_is_refused(stored: Path, spec: str) -> None:
    with pytest.raises(EvidenceError, match="there is no"):
        with_blocks(f"<!-- from: {spec.format(stored)} -->\n<!-- end -->")


@pytest.fixture
def claim(tmp_path: Path) -> Statement:
    """A statement with two numbers, 12.5 ms and a ratio of 4."""
    path = tmp_path / "times.json"
    path.write_text(
        json.dumps({"codes": [{"name": "a", "ms": [12, 13]}, {"name": "b", "ms": [50]}]})
    )
    ours = {"file": str(path), "key": "codes/name=a/ms", "reduce": "median", "format": ".1f"}
    ratio = {
        "file": str(path),
        "key": "codes/name=b/ms",
        "over": "codes/name=a/ms",
        "reduce": "median",
        "format": ".0f",
    }
    return Statement(PAGE, "takes {} ms, and b {} times as long", [ours, ratio])


def test_a_right_number_is_accepted_over_a_line_break(claim: Statement) -> None:
    text = "It takes 12.5 ms,\nand b 4 times as long.\n"
    assert list(wrong_numbers(PAGE, text, [claim])) == []
    assert list(without_evidence(PAGE, text, [claim])) == []


def test_a_wrong_number_is_found_and_corrected(claim: Statement) -> None:
    text = "It takes 12.5 ms,\nand b 5 times as long.\n"
    assert len(list(wrong_numbers(PAGE, text, [claim]))) == 1
    assert with_numbers(PAGE, text, [claim]) == text.replace("5 times", "4 times")


def test_a_number_that_no_entry_covers_is_found(claim: Statement) -> None:
    text = "It takes 12.5 ms, and b 4 times as long.\n\nA query takes 3 µs.\n"
    (found,) = without_evidence(PAGE, text, [claim])
    assert found.startswith("docs/page.md:3: '3'")


def test_an_entry_whose_text_left_the_page_is_found(claim: Statement) -> None:
    assert len(list(wrong_numbers(PAGE, "Nothing here.", [claim]))) == 1


SEEN = (
    "0.38 ms; 5 µs; 20 times; a factor of two; 1e-4 m; 18 of 25; 8,000 s; .037; 3×; 75 %; 22 MB; "
    "five times; 10⁸; 33 core-minutes; two minutes; 1.6–1.8; 135 H8; 64 patches; Section 3; "
    "at most a minute; half an hour; less than a second; half of the loads; thousands of percent; "
    "hundreds of seconds; thousands of the samples"
)


@pytest.mark.parametrize("text", SEEN.split("; "))
def test_a_number_is_seen(text: str) -> None:
    assert NUMBER.search(f"It has {text} here.")


@pytest.mark.parametrize(
    "text", ["two methods", "T4 and H8", "float32", "a second set", "half of them"]
)
def test_a_name_is_not_taken_for_a_number(text: str) -> None:
    assert not NUMBER.search(f"It has {text} here.")


def test_a_measurement_in_the_file_of_a_method_is_found(tmp_path: Path) -> None:
    file = tmp_path / "method.toml"
    file.write_text('title = "POD, 135 H8"\nsource = "Barbič 2005"\nn_modes = 3\n')
    assert list(measured_in_specification(str(file), [])) == []
    file = tmp_path / "other.toml"
    file.write_text(
        'title = "Errs by 3 %"\nsource = "A text"\nlimits = "It takes 430 steps, and a tenth of '
        'the time of pod."\nleast = 2.0  # measured 31\n'
    )
    assert len(list(measured_in_specification(str(file), []))) == 4


def test_a_number_of_the_code_is_looked_up_in_its_text() -> None:
    assert look_up("LEAST, MOST = 0.9, 12_360  # cores", "LEAST, MOST = 0.9, {}") == 12360
    for key in ("ST = {}", "LEAST = {}"):
        with pytest.raises(EvidenceError, match="0 different numbers"):
            look_up("LEAST, MOST = 0.9, 1.2", key)


def test_a_number_in_words_is_compared(tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text("EVERY_S = 10.0")
    value = {"file": str(tmp_path / "code.py"), "key": "EVERY_S = {}", "format": "word"}
    claim = Statement(PAGE, "every {} seconds", [value])
    assert list(wrong_numbers(PAGE, "It prints every ten seconds.", [claim])) == []
    assert len(list(wrong_numbers(PAGE, "It prints every five seconds.", [claim]))) == 1
    assert list(without_evidence(PAGE, "It prints every ten seconds.", [claim])) == []


def test_code_tables_and_links_are_no_prose() -> None:
    text = "a `5 ms` [b](c-3.5.md)\n```\n5 ms\n```\n<!-- from: x y -->\n5 ms\n<!-- end -->\n6 ms\n"
    assert len(prose(text)) == len(text)
    assert NUMBER.findall(prose(text)) == ["6"]


def test_a_star_selects_all_items_with_a_value() -> None:
    rows = {"rows": [{"s": {"fit": 1}, "of": 0}, {"s": {"fit": 2}}, {"s": {"fit": 3}, "of": None}]}
    assert look_up(rows, "rows/*s/s/fit") == [1, 2, 3]
    assert look_up(rows, "rows/*of/s/fit") == [1]


def test_a_key_must_lead_to_one_item(claim: Statement) -> None:
    content = content_of(claim.values[0]["file"])
    assert look_up(content, "codes/1/ms/0") == 50
    for key in ("codes/name=c", "codes/7", "nothing"):
        with pytest.raises(EvidenceError, match=key.split("/")[0]):
            look_up(content, key)


@pytest.mark.slow
def test_a_stale_or_edited_picture_is_found(stored: Path, tmp_path: Path) -> None:
    shutil.copytree(stored, tmp_path / "copy")
    page = tmp_path / "page.md"
    text = f"<!-- drawn from: {tmp_path}/copy error-against-time beam-coarse -->\n![a](a.png)\n"
    draw_pictures(page, text)
    assert list(stale_pictures(page, text)) == []
    assert len(list(stale_pictures(page, text.split("\n", 1)[1]))) == 1
    results = tmp_path / "copy" / "results.json"
    content = results.read_text()
    results.write_text(content + "\n")
    assert ["not drawn from" in found for found in stale_pictures(page, text)] == [True]
    results.write_text(content)
    image.imsave(tmp_path / "a.png", np.zeros((2, 2)))
    assert len(list(stale_pictures(page, text))) == 2
