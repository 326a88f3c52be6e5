"""The YAML block of a data set card: the title, and the files of each split."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from mor_bench.adapters.imported_parts import PARTS
from mor_bench.checked_files import KIB, read_bytes
from mor_bench.errors import StoreError, printable

CARD = "README.md"
MOST_CARD_BYTES = 256 * KIB
MOST_LEVELS = 20
"""Levels of nested lists and mappings in a card; cards need 5."""

ENDINGS = (".h5", ".hdf5")
CONFIGURATION_KEYS = ("config_name", "data_files", "default", "description")


class Card:
    """The keys of a card that matter here. Those of other purposes may be anything.

    Parameters
    ----------
    folder : Path

    Attributes
    ----------
    title : str
        `pretty_name`, or the name of the folder.

    Raises
    ------
    StoreError
        If the card is not readable, or names its files in another way than the Hub allows.
    FileNotFoundError
        If there is no card.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / CARD
        keys = self._keys()
        title = keys.get("pretty_name") or folder.resolve().name
        if not isinstance(title, str):
            raise StoreError(f"{self.path}: `pretty_name` must be a text.")
        self.title = printable(" ".join(title.split()), 500, "") or "data set"
        self._patterns = self._named_patterns(keys)

    def files(self) -> dict[str, list[Path]]:
        """Return the files of each split, in the card's order."""
        patterns = self._patterns or {name: [f"data/{name}-*.h5"] for name in PARTS}
        found: dict[str, list[Path]] = {}
        for split, texts in patterns.items():
            files = sorted({path for text in texts for path in self._matching(text)})
            if not files and (self._patterns or split == "train"):
                raise StoreError(f"{self.path}: no file of the split {split!r} exists: {texts}.")
            for other, others in found.items():
                for path in set(files).intersection(others):
                    raise StoreError(f"{path}: it is in the splits {other!r} and {split!r}.")
            if files:
                found[split] = files
        if not self._patterns:
            named = {path for files in found.values() for path in files}
            for path in sorted(set(_visible_files(self.folder, "data/**/*")) - named):
                raise StoreError(
                    f"{path}: in no split. Name the files in the card, or call them "
                    f"data/SPLIT-*.h5, where SPLIT is {' or '.join(PARTS)}."
                )
        return found

    def _keys(self) -> dict[str, Any]:
        try:
            text = read_bytes(self.path, MOST_CARD_BYTES).decode("utf-8-sig")
        except UnicodeDecodeError:
            raise StoreError(f"{self.path}: not a text in UTF-8.") from None
        block = re.match(r"---[ \t]*\r?\n(.*?\n)---[ \t]*(\r?\n|$)", text, re.DOTALL)
        if block is None:
            raise StoreError(
                f"{self.path}: a data set card begins with a YAML block between two lines `---`."
            )
        try:
            self._check_events(yaml.parse(block[1], Loader=yaml.SafeLoader))
            node = yaml.compose(block[1], Loader=yaml.SafeLoader)
        except yaml.YAMLError as error:
            text = " ".join(str(getattr(error, "problem", None) or error).split())
            mark = getattr(error, "problem_mark", None)
            where = f", line {mark.line + 2}" if mark else ""
            raise StoreError(
                f"{self.path}{where}: not valid YAML: {printable(text, 200, '')}."
            ) from None
        keys = self._plain(node)
        if not isinstance(keys, dict):
            raise StoreError(f"{self.path}: its YAML block must be a mapping of keys to values.")
        return keys

    def _check_events(self, events: Iterable[yaml.Event]) -> None:
        """Refuse aliases, whose expansion has no limit, and deep nesting, before recursion."""
        depth = 0
        for event in events:
            if isinstance(event, yaml.AliasEvent):
                raise StoreError(
                    f"{self.path}: aliases (`*{printable(event.anchor, 100, '')}`) "
                    "are not read; write the value again."
                )
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            if depth > MOST_LEVELS:
                raise StoreError(f"{self.path}: more than {MOST_LEVELS} nested levels.")

    def _plain(self, node: yaml.Node | None) -> Any:
        """Return dicts, lists, texts and None. YAML's other scalars stay as they are written."""
        if isinstance(node, yaml.SequenceNode):
            return [self._plain(item) for item in node.value]
        if isinstance(node, yaml.MappingNode):
            found: dict[str, Any] = {}
            for key, value in node.value:
                if not isinstance(key, yaml.ScalarNode) or key.value == "<<" or key.value in found:
                    name = printable(str(key.value), 100, "")
                    raise StoreError(
                        f"{self.path}, line {key.start_mark.line + 2}: keys must be texts, each "
                        f"once and not `<<`; got {name!r}."
                    )
                found[key.value] = self._plain(value)
            return found
        if node is None or node.tag == "tag:yaml.org,2002:null":
            return None
        return str(node.value)

    def _named_patterns(self, keys: Mapping[str, Any]) -> dict[str, list[str]]:
        """Return the path patterns of each split; nothing if the card names none."""
        configurations = keys.get("configs")
        if configurations is None:
            return {}
        if not isinstance(configurations, list) or not all(
            isinstance(item, dict) for item in configurations
        ):
            raise StoreError(f"{self.path}: `configs` must be a list of configurations.")
        if len(configurations) != 1:
            raise StoreError(
                f"{self.path}: it has {len(configurations)} configurations; one is allowed."
            )
        (configuration,) = configurations
        for key in configuration.keys() - set(CONFIGURATION_KEYS):
            raise StoreError(
                f"{self.path}: a configuration has the key `{printable(key, 100, '')}`, which is "
                f"not read; allowed: {', '.join(CONFIGURATION_KEYS)}."
            )
        files = configuration.get("data_files")
        if files is None:
            return {}
        found: dict[str, list[str]] = {}
        for split, paths in self._entries(files):
            if split not in PARTS or split in found:
                raise StoreError(
                    f"{self.path}: each split must be one of {', '.join(PARTS)}, once; "
                    f"got {printable(str(split), 100, '')!r}."
                )
            found[split] = self._texts(paths)
        if "train" not in found:
            raise StoreError(f"{self.path}: the split 'train' is missing.")
        return found

    def _entries(self, files: Any) -> list[tuple[Any, Any]]:
        """Return the splits and their paths, from each form of `data_files`."""
        if isinstance(files, dict):
            return list(files.items())
        if isinstance(files, list) and files and all(isinstance(item, dict) for item in files):
            for item in files:
                if item.keys() != {"split", "path"}:
                    got = printable(", ".join(item), 200, "")
                    raise StoreError(
                        f"{self.path}: each item of `data_files` needs the keys split and path, "
                        f"and no others; got {got}."
                    )
            return [(item["split"], item["path"]) for item in files]
        return [("train", files)]

    def _texts(self, paths: Any) -> list[str]:
        texts = paths if isinstance(paths, list) else [paths]
        if not texts or not all(isinstance(text, str) and text for text in texts):
            raise StoreError(f"{self.path}: the paths of a split must be a text or a list of them.")
        return texts

    def _matching(self, pattern: str) -> list[Path]:
        path = PurePosixPath(pattern)
        if path.is_absolute() or ".." in path.parts or ":" in pattern or "\\" in pattern:
            raise StoreError(
                f"{self.path}: `path` must lie in the folder; got {printable(pattern, 200, '')!r}."
            )
        try:
            found = _visible_files(self.folder, pattern)
        except (ValueError, NotImplementedError):
            raise StoreError(
                f"{self.path}: {printable(pattern, 200, '')!r} is no pattern of files."
            ) from None
        for item in found:
            if item.suffix not in ENDINGS:
                raise StoreError(
                    f"{item}: not read, though the card names it; only HDF5 files are read, "
                    f"with the ending {' or '.join(ENDINGS)}."
                )
        return found


def _visible_files(folder: Path, pattern: str) -> list[Path]:
    return [
        item for item in folder.glob(pattern) if not item.is_dir() and not item.name.startswith(".")
    ]
