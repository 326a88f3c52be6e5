"""Tables in Markdown of evidence other than runs; a table takes the path of a file or folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.told import class_of_method
from mor_bench.measure.mesh_limit import known_error
from mor_bench.report.number_format import DASH, number
from mor_bench.scene.scene import load_scene
from mor_bench.specs import load_method_spec
from tests.published import bound_tables, network_size_tables, projection_tables
from tests.published.choice_tables import choices, choices_decided
from tests.published.cost_tables import (
    generation,
    large_deformation,
    law_speed,
    poisson_ratios,
    probe_cost,
    scaling,
)
from tests.published.front_tables import fronts, fronts_of_all, fronts_of_newest, nothing_slower
from tests.published.literature_table import literature
from tests.published.record import SOURCES, experiments, record_of
from tests.published.run_tables import markdown
from tests.published.sampling_tables import learning_curves
from tests.published.stored import REPORTS, ROOT, EvidenceError, content_of, look_up
from tests.published.stress_tables import stresses
from tests.published.training_curve_tables import training_iterations, training_samples


def _medians(row: Mapping[str, Any]) -> NDArray[np.float64]:
    return np.asarray(np.median(np.array(row["times_ms"]), axis=1))


def peers(source: str) -> str:
    """Show the time of each code over that of the first; SOURCE is FILE,FILE,….

    It is the median over loads.
    """
    files = [content_of(file)["datasets"] for file in source.split(",")]
    columns = {
        _column(dataset, found): {
            row["name"]: f"{number(row['times_as_long'])} "
            f"({number(float(np.median(_medians(row))))} ms)"
            for row in found["contenders"]
        }
        for file in files
        for dataset, found in file.items()
    }
    names = list(dict.fromkeys(name for column in columns.values() for name in column))
    body = [[name, *(column.get(name, DASH) for column in columns.values())] for name in names]
    return markdown(["", *columns], body)


def _column(dataset: str, found: Mapping[str, Any]) -> str:
    """Return the name of a shipped dataset, or the size of another."""
    return dataset if "/" not in dataset else f"beam, {found['n_unknowns']:,} unknowns"


def reduced_peers(source: str) -> str:
    """Show cells, time and speed-up over the faster POD of Kratos, for each number of modes."""
    modes = content_of(source)["modes"]
    headings, columns = [""], []
    for n_modes, rows in modes.items():
        headings += [f"r = {n_modes}: cells", "ms", "×"]
        best = {row["name"]: np.min(np.array(row["times_ms"]), axis=1) for row in rows}
        pods = [times for name, times in best.items() if name.startswith("Kratos POD")]
        if not pods:
            raise EvidenceError(f"{source}: Kratos' POD was not measured.")
        base = np.min(pods, axis=0)
        columns.append(
            {
                row["name"]: [
                    DASH if row["n_cells"] is None else f"{row['n_cells']}",
                    number(float(np.median(_medians(row)))),
                    number(float(np.median(base / best[row["name"]]))),
                ]
                for row in rows
            }
        )
    names = list(dict.fromkeys(name for column in columns for name in column))
    body = [
        [name, *(cell for column in columns for cell in column.get(name, [DASH] * 3))]
        for name in names
    ]
    return markdown(headings, body)


def paper_amplitude(source: str) -> str:
    """Show the largest deformation of the paper's scenes over the size of the loads."""
    parts = {"test": "test part, split by sample", "set": "test set `paper-amplitude`"}
    body = [
        [
            f"`{row['dataset']}`",
            parts[row["part"]],
            f"{row['force_n']:g}",
            f"{row['loads']:,}",
            f"{100 * row['refused'] / row['loads']:.2g} %",
            number(row["largest_m"]),
            f"{row['paper_m']:g}",
        ]
        for row in content_of(source)["rows"]
    ]
    headings = ["dataset", "loads", "up to, N", "number", "refused", "largest u, m", "paper, m"]
    return markdown(headings, body)


def random_loads(source: str) -> str:
    """Show how many answers to random loads passed the independent checks; SOURCE is FILE,…."""
    body = []
    for file in source.split(","):
        found = content_of(file)
        factor = "" if found["times"] == 1 else f", {number(found['times'])} times as large"
        body.append(
            [
                f"{found['dataset']}, {found['loads']:,} loads as its dataset draws them{factor}",
                ", ".join(f"{n:,} {outcome}" for outcome, n in found["outcomes"].items()),
                f"{found['least_det_f']:.3f}",
                f"{found['largest_residual']:.1e}",
                f"{found['iterations_median']:.0f}, {found['iterations_most']}",
            ]
        )
    headings = ["loads", "answers", "least det F", "largest residual", "iterations: median, most"]
    return markdown(headings, body)


def records(source: str, key: str, columns: str = "") -> str:
    """Show a list of flat records; `columns` names the shown fields, by default all."""
    found = look_up(content_of(source), key)
    names = columns.split(",") if columns else list(found[0])
    return markdown(
        [name.replace("_", " ") for name in names],
        [[_shown(record.get(name)) for name in names] for record in found],
    )


def _shown(value: Any) -> str:
    return number(value) if isinstance(value, float) else DASH if value is None else str(value)


def optimism(source: str) -> str:
    """Show, by way of selection, how often a selected configuration misses its target."""
    ways = ("test", "validation", "bound")
    body = []
    for record in content_of(source)["methods"]:
        for way in ways:
            found = record.get(way) or {"n": 0}
            if found["n"]:
                figures = (100 * found["missed"], found["ratio"], found["ratio_p90"])
                told = record.get("told") or _told(record["method"])
                cells = [f"`{record['method']}`", told, way, str(found["n"])]
                body.append([*cells, *map(number, figures)])
    headings = [
        "method",
        "is given",
        "selected by",
        "selections",
        "missed %",
        "error ratio: mean",
        "p90",
    ]
    return markdown(headings, body)


def _told(method: str) -> str:
    """State the information that a method of the suite is given, for evidence without it."""
    return class_of_method(load_method_spec(method), "quick")


def leaves(source: str, key: str = "") -> str:
    """Show every number and text of a nested file, with its key."""
    content = content_of(source)
    found = _leaves(look_up(content, key) if key else content)
    return markdown(["", "value"], [[" · ".join(path), value] for path, value in found])


def _leaves(content: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _leaves(value, (*path, key.replace("_", " ")))
    elif isinstance(content, list):
        for i, value in enumerate(content, 1):
            yield from _leaves(value, (*path, str(i)))
    else:
        yield path, _shown(content)


def refinement(source: str) -> str:
    """Show the discretisation error of every mesh; SOURCE is the folder of the datasets."""
    body = []
    for path in sorted((ROOT / source).glob("*.refine.json")):
        found = content_of(path.relative_to(ROOT).as_posix())
        meshes, (error_m, relative, at_least) = found["meshes"], known_error(found)
        orders = [load["order"] for load in found["loads"] if load["order"] is not None]
        least = "≥ " if at_least else ""
        body.append(
            [
                f"`{found['dataset']}`",
                f"{meshes[0]['n_cells']:,}",
                f"{meshes[-1]['n_cells']:,}",
                f"{len(meshes) - 1}",
                f"{len(found['loads'])}",
                f"{min(orders):.2f} to {max(orders):.2f}" if orders else DASH,
                "not known" if error_m is None else f"{least}{error_m:.1e}",
                "not known" if relative is None else f"{least}{100 * relative:.2g}",
                (found.get("commit") or DASH)[:7],
                found.get("date", DASH).partition(" ")[0],
            ]
        )
    headings = ["mesh", "cells", "cells of the finest mesh", "refinements", "loads"]
    return markdown([*headings, "orders", "e, m", "median %", "commit", "date"], body)


LAWS = {
    "saint-venant-kirchhoff": "SVK",
    "neo-hookean": "neo-Hookean",
    "mooney-rivlin": "Mooney–Rivlin",
}


def _law(law: Mapping[str, Any]) -> str:
    """Name a law and its constants."""
    if "young_pa" in law:
        return f"{LAWS[law['law']]}, {law['young_pa']:,g} Pa, ν = {law['poisson']:g}"
    moduli = (
        f"{key.removesuffix('_pa')} = {value:g}" for key, value in law.items() if key != "law"
    )
    return f"{LAWS[law['law']]}, {', '.join(moduli)} Pa"


def scenes(source: str) -> str:
    """Show mesh, material and loads of every dataset; SOURCE is the folder of the datasets."""
    body = []
    for path in sorted((ROOT / source).glob("*.toml")):
        spec = content_of(f"{source}/{path.name}")
        scene, loads, law = load_scene(path), spec["loads"], spec["material"]
        element = {"hexahedron": "H8", "tetrahedron": "T4"}[
            spec.get("discretisation", {}).get("element", "hexahedron")
        ]
        patches = len(scene.patch_nodes)
        samples = loads.get("samples") or patches * loads["samples_per_patch"]
        plan = scene.generated.load_plan
        low, high = plan.magnitude
        area = loads.get("patch_area_m2")
        where = f"{patches} of {area:g} m²" if area else DASH
        n_loads = len(loads["regions"]) if scene.pressure else plan.simultaneous
        size = "×".join(f"{side:g}" for side in spec["geometry"].get("size_m", ()))
        body.append(
            [
                f"`{path.stem}`",
                f"{size} m, " * bool(size)
                + f"{scene.mesh.n_cells:,} {element}, {scene.mesh.n_nodes:,} nodes",
                _law(law),
                f"{n_loads} × {loads['kind']}, {low:g}–{high:g} {plan.unit}",
                where,
                f"{samples:,}",
            ]
        )
    return markdown(["dataset", "mesh", "material", "loads", "patches", "samples"], body)


def _outcomes(source: str) -> list[dict[str, Any]]:
    return [row for row in content_of(source)["rows"] if row["verdict"] != "not applicable"]


def hard_cases(source: str) -> str:
    """Show every hard case: expected behaviour, and which methods pass or fall short."""
    cases: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in _outcomes(source):
        cases.setdefault((row["case"], row["expected"]), []).append(row)
    body = []
    for (case, expected), rows in cases.items():
        short = list(dict.fromkeys(r["method"] for r in rows if r["verdict"] == "fall short"))
        methods = {row["method"] for row in rows}
        if len(methods) == 1 and not short:
            result = rows[0]["happened"]
        else:
            result = f"{len(methods) - len(short)} of {len(methods)} methods pass"
            result += f"; short: {', '.join(f'`{m}`' for m in short)}" if short else ""
        body.append([f"`{case}`", expected, result.replace("|", "/")])
    return markdown(["case", "expected", "result"], body)


def hard_loads(source: str) -> str:
    """Show the errors of every method under loads unlike the training loads."""
    rows = [row for row in _outcomes(source) if row["case"] == "out-of-distribution"]
    parts = list(dict.fromkeys(row["part"] for row in rows))
    cells = {(row["method"], row["part"]): _spread(row["measured"]) for row in rows}
    methods = dict.fromkeys(row["method"] for row in rows)
    known: dict[str, str] = content_of(source).get("told", {})
    headings = ["median / p95 / max, %", "is given", *parts]
    body = [
        [f"`{m}`", known.get(m) or _told(m), *(cells.get((m, part), DASH) for part in parts)]
        for m in methods
    ]
    return markdown(headings, body)


def _spread(measured: Mapping[str, Any]) -> str:
    names = ("rel_l2_median", "rel_l2_p95", "rel_l2_max")
    values: Sequence[float] = [float(measured[name]) for name in names]
    return " / ".join(number(100 * x) if np.isfinite(x) else "none" for x in values)


def evidence(source: str) -> str:
    """List the experiments: evidence, command, commit, date, seconds, machine."""
    if source != SOURCES:
        raise EvidenceError(f"The table of the evidence is made from {SOURCES}.")
    body = []
    for name, entry in experiments().items():
        path, key = record_of(name)
        facts = content_of(path.relative_to(ROOT).as_posix()).get(key)
        if facts is None:
            raise EvidenceError(f"{name}: not recorded in {path.relative_to(ROOT)}.")
        folder = (REPORTS / name).relative_to(REPORTS).as_posix()
        body.append(
            [
                f"[{name}]({folder})",
                f"`{facts['command']}`",
                facts["commit"][:7],
                facts["date"],
                f"{facts['seconds']:,.0f}",
                facts["machine"],
            ]
        )
        if facts["command"] != entry["command"]:
            raise EvidenceError(f"{name}: recorded with another command: {facts['command']}")
    headings = ["evidence in `reports/`", "command", "commit", "date", "seconds", "machine"]
    return markdown(headings, body)


def timed_work(source: str) -> str:
    """Show how far the counted work of timed and scored loads differs; SOURCE is FILE,FILE,…."""
    body = []
    for content in map(content_of, source.split(",")):
        found = content["difference_percent"]
        methods = {label.partition(" [")[0] for label in found}
        largest = max(map(abs, found.values()))
        cells = [f"{len(methods)}", f"{len(found)}", f"{content['queries']:,}", f"{largest:g}"]
        body.append([f"`{content['dataset']}`", *cells])
    return markdown(
        ["dataset", "methods", "configurations", "queries", "largest difference, %"], body
    )


OTHER_TABLES: dict[str, Callable[..., str]] = {
    "peers": peers,
    "reduced-peers": reduced_peers,
    "large-deformation": large_deformation,
    "law-speed": law_speed,
    "poisson-ratios": poisson_ratios,
    "probe-cost": probe_cost,
    "scaling": scaling,
    "generation": generation,
    "random-loads": random_loads,
    "choices": choices,
    "choices-decided": choices_decided,
    "network-sizes": network_size_tables.network_sizes,
    "network-size-law": network_size_tables.network_size_law,
    "fronts": fronts,
    "fronts-of-all": fronts_of_all,
    "fronts-of-newest": fronts_of_newest,
    "nothing-slower": nothing_slower,
    "stresses": stresses,
    "full-sizes": network_size_tables.full_sizes,
    "training-speed": network_size_tables.training_speed,
    "paper-size": network_size_tables.paper_size,
    "paper-size-latency": network_size_tables.paper_size_latency,
    "recipes": network_size_tables.recipes,
    "paper-amplitude": paper_amplitude,
    "records": records,
    "optimism": optimism,
    "leaves": leaves,
    "refinement": refinement,
    "scenes": scenes,
    "hard-cases": hard_cases,
    "hard-loads": hard_loads,
    "evidence": evidence,
    "literature": literature,
    "timed-work": timed_work,
    "projections": projection_tables.projections,
    "reconstructions": projection_tables.reconstructions,
    "softened-volume": projection_tables.softened_volume,
    "response-inputs": projection_tables.response_inputs,
    "spread-bounds": bound_tables.spread_bounds,
    "learning-curves": learning_curves,
    "training-iterations": training_iterations,
    "training-samples": training_samples,
}
