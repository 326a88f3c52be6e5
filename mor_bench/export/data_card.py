"""The card of an archived dataset for people, its licence, and its metadata for catalogues."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mor_bench.checked_files import MIB, read_bytes
from mor_bench.checkout import source_commit
from mor_bench.errors import InvalidInputError, printable
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.report.scene_text import scene_text
from mor_bench.snapshots.archive_files import SUMS
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.solve import GENERATOR_VERSION
from mor_bench.snapshots.store import SCHEMA_VERSION, STATUSES
from mor_bench.specs import DatasetSpec, tables_of
from mor_bench.version import __version__

CREATIVE_COMMONS = {
    "CC-BY-4.0": (
        "Creative Commons Attribution 4.0 International",
        "https://creativecommons.org/licenses/by/4.0/",
    ),
    "CC0-1.0": (
        "Creative Commons Zero 1.0 Universal",
        "https://creativecommons.org/publicdomain/zero/1.0/",
    ),
}
"""Names and addresses of the licences that an address suffices for, by SPDX identifier."""

KINDS = {".toml": "text/toml", ".md": "text/markdown", ".txt": "text/plain"} | {
    ".json": "application/json",
    ".h5": "application/x-hdf5",
}
"""Media types of files in an archive, by their endings."""


@dataclass(frozen=True)
class Licence:
    """The licence of an archive's data.

    Attributes
    ----------
    name : str
        For a text, its first line.
    url : str
        Address of its text; empty if the archive holds the text.
    own_text : str
        A text instead of the name and the address.
    """

    name: str
    url: str = ""
    own_text: str = ""

    @classmethod
    def named(cls, choice: str) -> Licence:
        """Return a licence from its SPDX identifier, or from a file with its text.

        Raises
        ------
        InvalidInputError
            If it is neither, or the file is no text, or holds nothing.
        """
        if choice in CREATIVE_COMMONS:
            name, url = CREATIVE_COMMONS[choice]
            return cls(f"{name} ({choice})", url)
        try:
            text = read_bytes(Path(choice), MIB, InvalidInputError).decode()
        except FileNotFoundError:
            raise InvalidInputError(
                f"`licence` must be {' or '.join(CREATIVE_COMMONS)}, or the path of a text; got "
                f"{choice!r}."
            ) from None
        except UnicodeDecodeError:
            raise InvalidInputError(f"{choice}: a licence must be a text in UTF-8.") from None
        lines = [" ".join(_plain(line).split()) for line in text.splitlines()]
        if not any(lines):
            raise InvalidInputError(f"{choice}: a licence must be a text; the file holds none.")
        return cls(printable(next(filter(None, lines)), 200, "").rstrip("."), own_text=text)

    def text(self, authors: Sequence[str]) -> str:
        """Return the content of LICENSE.txt."""
        if self.own_text:
            return self.own_text
        by = "" if "zero" in self.url else f"Copyright {_listed(authors)}\n\n"
        return f"{by}This dataset is licensed under\n{self.name}.\n{self.url}legalcode\n"


@dataclass(frozen=True)
class Facts:
    """What card and metadata are written from.

    Attributes
    ----------
    data : Dataset
        With the test sets of the archive.
    spec : DatasetSpec
    authors : tuple of str
    licence : Licence
    environments : tuple of dict
        Environments that generated the main set, see `mor_bench.snapshots.manifest.Manifest`.
    """

    data: Dataset
    spec: DatasetSpec
    authors: tuple[str, ...]
    licence: Licence
    environments: tuple[Mapping[str, str], ...]

    @property
    def scene(self) -> str:
        """The scene in a sentence."""
        return scene_text(self.spec.model_dump(mode="json", exclude={"name"}))

    @property
    def software(self) -> str:
        """Name, version and commit of the program that writes the archive."""
        commit = source_commit()
        return f"mor-bench {__version__}{f', commit {commit}' if commit else ''}"

    @property
    def citation(self) -> str:
        return (
            f"{_listed(self.authors)}: {self.spec.title}. Dataset {self.spec.name}, made with "
            f"mor-bench {__version__}."
        )

    @property
    def n_samples(self) -> int:
        data = self.data
        parts = (data.train, data.validation, data.test)
        return sum(map(len, parts)) + data.n_refused + data.n_unused


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names)


def card_text(facts: Facts) -> str:
    """Return the content of README.md."""
    spec, mesh = facts.spec, facts.data.scene.mesh
    sections = {
        "Scene": f"{facts.scene}\n\n"
        f"- Mesh: {mesh.n_cells:,} cells of {mesh.cells.shape[1]} nodes, {mesh.n_nodes:,} nodes, "
        f"{len(facts.data.scene.free_dofs):,} unknowns\n"
        f"- Origin: {_plain(spec.source) or 'not given'}\n"
        f"- Everything else is in `{spec.name}.toml`: supports, material, loads, sampling, split",
        "Samples": _samples(facts),
        "Arrays": _arrays(facts),
        "Read it": _reading(spec.name),
        "Cite it": f"{_plain(facts.citation)}\n\n"
        "Add the identifier of the repository that you have it from. Cite the program too:\n\n"
        f"The mor-bench authors: {facts.software}.",
        "Licence": f"{facts.licence.name}, see `LICENSE.txt`. {facts.licence.url}".rstrip(),
    }
    title = (
        f"# {_plain(spec.title)}\n\nDataset `{spec.name}`: static equilibria of a hyperelastic "
        "body under sampled loads, for methods that predict its deformation. The full-order model "
        f"of mor-bench computed them. {facts.software} wrote this archive.\n"
    )
    return title + "".join(f"\n## {name}\n\n{text}\n" for name, text in sections.items())


def _plain(text: str) -> str:
    """Return a text in one line, without the characters that are markup in Markdown or HTML."""
    return re.sub(r"[\[\]<>`*_\\|#]", " ", " ".join(text.split()))


def _samples(facts: Facts) -> str:
    data, spec = facts.data, facts.spec
    rows = {
        "training": data.train,
        "validation": data.validation,
        f"test, held out by {spec.split.by}": data.test,
        **{f"named test set {name}": part for name, part in data.tests.items()},
    }
    table = "".join(
        f"| {name} | {len(part):,} | {_largest(part)} |\n" for name, part in rows.items()
    )
    environments = "; ".join(
        ", ".join(f"{name} {value}" for name, value in environment.items())
        for environment in facts.environments
    )
    return (
        f"| part | samples | largest displacement, m |\n|---|---|---|\n{table}\n"
        f"Of {facts.n_samples:,} samples of the main set, {data.n_refused:,} have no valid "
        f"equilibrium and {data.n_unused:,} are in no part of the split.\n\n"
        f"- Solver: `{spec.solver}`; the residual is at most {NewtonOptions().tolerance:g} of the "
        "load\n"
        f"- Version of the generator: {GENERATOR_VERSION}; version of the store: {SCHEMA_VERSION}\n"
        f"- Computed with: {environments}"
    )


def _largest(part: Snapshots) -> str:
    return f"{np.abs(part.free_displacements).max():.3g}" if part.free_displacements.size else "–"


def _arrays(facts: Facts) -> str:
    """Describe the arrays of a shard, with their units."""
    scene = facts.data.scene
    kinds = {table.kind for table in tables_of(facts.spec.load_plan)}
    vectors = []
    if kinds & {"displacement", "contact"}:
        vectors.append("displacements of the tool, m")
    if kinds - {"displacement", "contact", "pressure"}:
        vectors.append("forces on the patches, N")
    if "pressure" in kinds:
        vectors.append("each pressure p, Pa, as −p times the unit vectors on three patches")
    rows = {
        "patches": "numbers of the loaded patches or regions",
        "vectors": "; ".join(vectors),
        "displacements": "displacements of the unknowns, m; NaN without an equilibrium",
        "min_det_f": "smallest determinant of the deformation gradient of a sample",
        "status": ", ".join(f"{number}: {status}" for number, status in enumerate(STATUSES)),
    }
    if scene.parameter_names:
        rows["parameters"] = ", ".join(scene.parameter_names)
    table = "".join(f"| `{name}` | {text} |\n" for name, text in rows.items())
    return (
        "The shards are HDF5 files. Lengths are in m, forces in N, pressures and moduli in Pa.\n\n"
        f"| array | content, one row per sample |\n|---|---|\n{table}\n"
        "All nodal forces and displacements as plain arrays: `mor-bench export numpy`."
    )


def _reading(name: str) -> str:
    return f"""\
With mor-bench {__version__} or a later version that has the same generator and store:

    sha256sum -c {SUMS}                  # on macOS: shasum -a 256 -c {SUMS}
    mor-bench generate --from-archive .       # checks everything, and generates nothing
    mor-bench run {name}.toml

In Python, after the second command:

    import mor_bench
    data = mor_bench.load_dataset("{name}.toml")
    data.train.forces, data.train.displacements    # (n, n_nodes, 3), N and m"""


def metadata_of(facts: Facts, sums: Mapping[str, str], sizes: Mapping[str, int]) -> dict[str, Any]:
    """Return the metadata in the terms of schema.org, with every file so far."""
    units = {"displacement": "m", "force": "N", "pressure": "Pa"}
    return {
        "@context": "https://schema.org/",
        "@type": "Dataset",
        "name": facts.spec.title,
        "alternateName": facts.spec.name,
        "description": f"{facts.scene} {facts.n_samples:,} static equilibria.",
        "creator": [{"name": author} for author in facts.authors],
        "license": facts.licence.url
        or {"@type": "CreativeWork", "name": facts.licence.name, "url": "LICENSE.txt"},
        "creditText": facts.citation,
        "version": f"v{SCHEMA_VERSION}.{GENERATOR_VERSION}",
        "keywords": ["hyperelasticity", "model order reduction", "finite elements", "surrogate"],
        "measurementTechnique": f"static equilibria by finite elements, with {facts.software}",
        "variableMeasured": [
            {"@type": "PropertyValue", "name": name, "unitText": unit}
            for name, unit in units.items()
        ],
        "distribution": [
            {
                "@type": "DataDownload",
                "name": name,
                "contentUrl": name,
                "contentSize": f"{sizes[name]} B",
                "encodingFormat": KINDS.get(Path(name).suffix, "application/octet-stream"),
                "sha256": sums[name],
            }
            for name in sorted(sums)
        ],
    }
