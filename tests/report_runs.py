"""Runs for tests of the report, and what a page holds."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

from mor_bench.analysis.analyse import analyse
from mor_bench.measure.error_metrics import summary
from mor_bench.report.entries import Analysis
from mor_bench.report.page import write_page
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from mor_bench.specs import load_dataset_spec
from tests.synthetic import MESH, a_row, put_samples, sample_errors_of

N_TEST = 40


def add_row(
    comparison: Comparison,
    method: str,
    swept: Mapping[str, Any],
    error: float,
    latency_ms: float,
    **fields: Any,
) -> Row:
    """Add a row with raw samples and this median relative L2 error; `n_failed` samples fail."""
    relative = error * np.linspace(0.5, 1.5, N_TEST)
    relative[: fields.get("n_failed", 0)] = np.inf
    amplitude = np.linspace(0.01, 0.2, N_TEST)
    errors = sample_errors_of(relative, amplitude, 0.25)
    measured = {
        "n_test": N_TEST,
        "error": summary(errors),
        "latency_ms": {"median": latency_ms, "p95": 1.09 * latency_ms, "p99": 1.1 * latency_ms},
        "offline_s": {"data": 3.0, "fit": 0.5},
        "model_bytes": 12345,
    }
    timed = {"latency_ms": latency_ms * np.linspace(0.9, 1.1, 41)}
    row = a_row(method, swept, **{**measured, **fields})
    return put_samples(comparison, row, errors, timed)


def tiny(out: Path, *names: str, **machine: Any) -> Comparison:
    """A comparison without rows on beam-tiny (needs: 1 %, 3 ms), under one or several names."""
    made = Comparison(out, machine)
    arrays = {"points": MESH.points, "cells": MESH.cells, "singular_values": 0.8 ** np.arange(30.0)}
    for name in names or ("beam-tiny",):
        made.add_dataset(name, load_dataset_spec("beam-tiny").model_dump(mode="json"), arrays)
    return made


def page_of(comparison: Comparison, analysis: Analysis | None = None) -> str:
    """Return the page of a comparison; no figures are drawn, which would take most of the time."""
    analysis = analysis or analyse(comparison)
    return write_page(comparison, analysis)[-1].read_text(encoding="utf-8")


def markup_of(page: str) -> str:
    """Return the page without its scripts, its data and its style sheet."""
    return re.sub(r"<(script|style)\b.*?</\1>", " ", page, flags=re.DOTALL)


def text_of(page: str) -> str:
    """Return the words of a page, without the signs that keep a figure on one line."""
    text = unescape(re.sub(r"<[^>]*>", " ", markup_of(page))).replace("\N{WORD JOINER}", "")
    return " ".join(text.split())


def data_of(page: str) -> list[dict[str, Any]]:
    """Return the data for the scripts."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    found: list[dict[str, Any]] = json.loads(text)
    return found
