"""Write the numbers of the evidence into the pages: tables, sentences and pictures.

python -m tests.published.write
"""

from __future__ import annotations

import sys

from mor_bench.snapshots.store import write_atomically
from tests.published.blocks import pages, with_blocks
from tests.published.claims import statements, with_numbers, without_evidence, wrong_numbers
from tests.published.compact import reword
from tests.published.pictures import draw_pictures
from tests.published.record import experiments
from tests.published.stored import REPORTS, ROOT, EvidenceError, content_of


def main() -> int:
    """Write every page; print what remains to be done by hand, and return 1 if there is any."""
    known = statements()
    left = []
    for name in experiments():
        if (REPORTS / name / "comparison.json").is_file() and reword(REPORTS / name):
            print(f"reports/{name}: its verdicts are worded as the code does now")
            content_of.cache_clear()
    for path in pages():
        page = path.relative_to(ROOT).as_posix()
        before = path.read_text(encoding="utf-8")
        try:
            text = with_numbers(page, with_blocks(before), known)
        except EvidenceError as error:
            left.append(f"{page}: not written: {error}")
            continue
        if text != before:
            write_atomically(path, text.encode())
            print(f"{page}: written")
        draw_pictures(path, text)
        left += [*wrong_numbers(page, text, known), *without_evidence(page, text, known)]
    print("\n".join(left))
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
