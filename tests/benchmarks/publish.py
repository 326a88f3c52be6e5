"""Publish the dashboard of asv's results and comparisons as a folder that needs no internet.

    python -m tests.benchmarks.publish
    python -m http.server --directory .asv/html

Unlike with `asv publish`, the page loads jQuery, Flot and Bootstrap from copies in the folder. It
shows comparisons from `mor-bench export asv` even if `asv run` has since rewritten its list of
benchmarks.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from pathlib import Path

from mor_bench.errors import MorBenchError

ROOT = Path(__file__).parents[2]
HISTORY = ROOT / "tests" / "history" / "asv.conf.json"
"""Configuration of the benchmarks whose results are stored in `reports/asv`."""

COPIES = Path(__file__).parent / "dashboard"

_CDNJS = "https://cdnjs.cloudflare.com/ajax/libs"
_JSDELIVR = "https://cdn.jsdelivr.net/npm"
LOCAL = {
    "https://code.jquery.com/jquery-3.3.1.min.js": "jquery.min.js",
    f"{_CDNJS}/flot/0.8.3/jquery.flot.min.js": "jquery.flot.js",
    f"{_CDNJS}/flot/0.8.3/jquery.flot.time.min.js": "jquery.flot.time.js",
    f"{_CDNJS}/flot/0.8.3/jquery.flot.selection.min.js": "jquery.flot.selection.js",
    f"{_CDNJS}/flot/0.8.3/jquery.flot.categories.min.js": "jquery.flot.categories.js",
    f"{_JSDELIVR}/flot-orderbars@1.0.0/js/jquery.flot.orderBars.js": "jquery.flot.orderBars.js",
    f"{_CDNJS}/stupidtable/1.0.1/stupidtable.min.js": "stupidtable.min.js",
    f"{_CDNJS}/blueimp-md5/2.19.0/js/md5.min.js": "md5.min.js",
    f"{_JSDELIVR}/bootstrap@3.1.1/dist/js/bootstrap.min.js": "bootstrap.min.js",
    f"{_JSDELIVR}/bootstrap@3.1.1/dist/css/bootstrap.min.css": "bootstrap.min.css",
}
"""What the page loads, and the file in `COPIES` that stands in for it."""

_TAG = re.compile(
    r'<(?P<tag>script|link)\b[^>]*?\b(?P<where>src|href)="(?P<url>(?:https?:)?//[^"]+)"[^>]*>'
)


def make_offline(folder: Path) -> None:
    """Make the page of a published folder load local copies.

    Raises
    ------
    MorBenchError
        If the page loads a file without a local copy, which may happen with a newer asv.
    """
    page = folder / "index.html"

    def local(match: re.Match[str]) -> str:
        if match["url"] not in LOCAL:
            raise MorBenchError(
                f"{page}: loads {match['url']}, of which {COPIES} has no copy; "
                "add one, and its licence."
            )
        kind = 'rel="stylesheet" ' if match["tag"] == "link" else 'onerror="js_load_failure()" '
        return f'<{match["tag"]} {kind}{match["where"]}="offline/{LOCAL[match["url"]]}">'

    written = _TAG.sub(local, page.read_text(encoding="utf-8"))
    shutil.copytree(COPIES, folder / "offline", dirs_exist_ok=True)
    page.write_text(written, encoding="utf-8")


def publish(configuration: Path) -> Path:
    """Publish the results of an asv.conf.json; return the folder."""
    from asv.commands.publish import Publish
    from asv.config import Config

    from mor_bench.export.asv_results import describe

    config = Config.load(str(configuration))
    describe(config.results_dir)
    Publish.run(config)
    make_offline(Path(config.html_dir))
    return Path(config.html_dir)


def publish_history(html: Path) -> None:
    """Publish the stored history in a folder, which is replaced; for this, asv needs git."""
    from asv.commands.publish import Publish
    from asv.config import Config

    config = Config.load(str(HISTORY))
    config.repo = str(ROOT)
    config.html_dir = str(html)
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "asv"
        shutil.copytree(ROOT / "reports" / "asv", results)
        keep_measured(results)
        config.results_dir = str(results)
        Publish.run(config, pull=False)
    make_offline(html)


def keep_measured(results: Path) -> None:
    """Take the benchmarks that no commit has a value of out of the list that asv shows."""
    path = results / "benchmarks.json"
    listed = json.loads(path.read_text(encoding="utf-8"))
    stored = [json.loads(each.read_text(encoding="utf-8")) for each in results.glob("*/*-*.json")]
    measured = {name for content in stored for name in content["results"]}
    kept = {name: each for name, each in listed.items() if name in {"version", *measured}}
    path.write_text(json.dumps(kept), encoding="utf-8")


if __name__ == "__main__":
    print(publish(Path("asv.conf.json")))
