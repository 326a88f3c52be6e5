"""Pictures in the pages that are drawn from the evidence.

    <!-- drawn from: reports/quick-start error-against-time beam-coarse -->
    ![…](docs/error-against-time.png)

The PNG carries digests of its source files and of its own pixels.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import image
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from mor_bench.report.canvas import Picture, as_png
from mor_bench.report.entries import Analysis
from mor_bench.report.error_against_deformation import error_against_deformation
from mor_bench.report.error_against_time import error_against_time
from mor_bench.report.error_over_position import error_over_position
from mor_bench.report.figures import explain_names
from mor_bench.results.comparison import Comparison
from mor_bench.snapshots.store import write_atomically
from tests.published.compact import ERRORS, StoredRun
from tests.published.front_picture import fronts_picture
from tests.published.sampling_picture import sampling_cost
from tests.published.stored import ROOT, EvidenceError, run_of
from tests.published.training_curve_picture import training_curves

OPENING = r"(?:!\[[^\]]*\]\(|<img src=\")"
"""A picture in Markdown, or in HTML, which can also state a width."""

DRAWN = re.compile(
    r"<!-- drawn from: (?P<source>\S+) (?P<kind>\S+) (?P<dataset>\S+) -->\n+"
    rf"{OPENING}(?P<path>[^)\"]+)[)\"]"
)
PICTURE = re.compile(rf"{OPENING}(?P<path>[^)\"]+\.png)[)\"]")


DRAWINGS: dict[str, Callable[[Comparison, str, Analysis], Picture | None]] = {
    "error-against-time": error_against_time,
    "error-against-deformation": error_against_deformation,
    "error-over-position": error_over_position,
}
"""The pictures of a run that a page may show."""

OF_FILES: dict[str, Callable[[str], Picture]] = {
    "training-curves": training_curves,
    "fronts": fronts_picture,
    "sampling-cost": sampling_cost,
}
"""The pictures of files, FILE,FILE,…."""


def drawn(source: str, kind: str, dataset: str) -> bytes:
    """Draw a figure from a stored run; return the PNG with its digests."""
    if kind in OF_FILES:
        picture = OF_FILES[kind](source)
    elif kind in DRAWINGS:
        picture = _of_run(source, kind, dataset)
    else:
        raise EvidenceError(f"{source}: there is no picture {kind!r}.")
    png = as_png(picture.figure, {})
    texts = PngInfo()
    texts.add_text("Software", f"matplotlib {matplotlib.__version__}")
    texts.add_text("Source", f"{source} {kind} {dataset} {source_digest(source)}")
    texts.add_text("Comment", pixel_digest(png))
    content = io.BytesIO()
    with Image.open(io.BytesIO(png)) as opened:
        opened.save(content, "png", pnginfo=texts, dpi=opened.info["dpi"])
    return content.getvalue()


def _of_run(source: str, kind: str, dataset: str) -> Picture:
    analysis = run_of(source).analysis or {}
    run = StoredRun.read(ROOT / source)
    picture = DRAWINGS[kind](run, dataset, analysis)
    if picture is None:
        raise EvidenceError(f"{source}: no configuration of {dataset} can be drawn.")
    explain_names(picture, run, dataset)
    return picture


def source_digest(source: str) -> str:
    """Digest of the files, or of those of a run, that a picture is drawn from."""
    names = ("results.json", "comparison.json", ERRORS)
    paths = [ROOT / name for name in source.split(",")]
    if paths[0].is_dir():
        paths = [paths[0] / name for name in names]
    files = [path.read_bytes() for path in paths]
    return hashlib.sha256(b"\0".join(files)).hexdigest()


def pixel_digest(png: bytes) -> str:
    """Digest of the pixels of a PNG."""
    return hashlib.sha256(pixels(png).tobytes()).hexdigest()


def pixels(png: bytes) -> NDArray[np.float32]:
    """Pixels (height, width, 4) of a PNG."""
    return np.asarray(image.imread(io.BytesIO(png), format="png"))


MOST_UNLIKE = 1e-3
"""Largest share of pixels that differ visibly, since fonts are drawn a little differently."""


def unlike(a: NDArray[np.float32], b: NDArray[np.float32]) -> bool:
    """Return whether two pictures differ visibly."""
    return a.shape != b.shape or bool((np.abs(a - b).max(axis=-1) > 0.2).mean() > MOST_UNLIKE)


def stale_pictures(page: Path, text: str) -> Iterator[str]:
    """Yield each picture of a page that is not drawn from the present evidence."""
    known = set()
    for match in DRAWN.finditer(text):
        known.add(match["path"])
        path = page.parent / match["path"]
        if not path.is_file():
            yield f"{page.name}: {match['path']} does not exist"
            continue
        with Image.open(path) as opened:
            said = dict(opened.text)  # type: ignore[attr-defined]
        source = " ".join((match["source"], match["kind"], match["dataset"]))
        if said.get("Source") != f"{source} {source_digest(match['source'])}":
            yield f"{page.name}: {match['path']} is not drawn from the present {match['source']}"
        if said.get("Comment") != pixel_digest(path.read_bytes()):
            yield f"{page.name}: {match['path']} was changed after it was drawn"
        if said.get("Software") == f"matplotlib {matplotlib.__version__}":
            again = drawn(match["source"], match["kind"], match["dataset"])
            if unlike(pixels(again), pixels(path.read_bytes())):
                yield f"{page.name}: {match['path']} is not what the code draws now"
    for match in PICTURE.finditer(text):
        if match["path"] not in known:
            yield f"{page.name}: {match['path']} has no line `<!-- drawn from: … -->` above it"


def draw_pictures(page: Path, text: str) -> None:
    """Draw the pictures of a page again."""
    for match in DRAWN.finditer(text):
        png = drawn(match["source"], match["kind"], match["dataset"])
        write_atomically(page.parent / match["path"], png)
