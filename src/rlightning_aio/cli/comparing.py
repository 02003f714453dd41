"""Figures of `bench` that are kept, and compared with later ones.

They lie in the folder `.rlightning-aio/bench` below the one where the command is run, one JSON
document for each name.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.cli.terminal import count, named_columns, print_table
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["Comparison", "check_name", "compared", "save"]

_FOLDER: Final = Path(".rlightning-aio", "bench")
_SLOWER: Final = 0.95
"""Below this share of the former rate, and of all its rounds, something has become slower."""


@dataclass(frozen=True)
class Pair:
    """One contender, then and now.

    Attributes:
        before, now: steps per second, medians.
        slower: by more than the rounds differ.
    """

    place: str
    rule: str
    before: float
    now: float
    slower: bool


@dataclass(frozen=True)
class Comparison:
    """With what was saved as `name`.

    Attributes:
        differences: what else has changed, in words.
    """

    name: str
    pairs: list[Pair]
    differences: list[str]

    @property
    def slower(self) -> list[Pair]:
        """What has become slower."""
        return [pair for pair in self.pairs if pair.slower]

    def as_json(self) -> dict[str, Any]:
        """All of it."""
        return {
            "name": self.name,
            "pairs": [asdict(pair) for pair in self.pairs],
            "differences": self.differences,
            "slower": len(self.slower),
        }

    def print(self, console: Console) -> None:
        """A table, those that have become slower in red."""
        table = named_columns(
            f"Compared with {self.name!r}: {len(self.slower)} of {len(self.pairs)} slower",
            "envs in", "results", "before", "now", "change",
        )  # fmt: skip
        table.columns[1].justify = "left"
        for pair in self.pairs:
            change = f"{pair.now / pair.before - 1:+.0%}{' slower' if pair.slower else ''}"
            row = (pair.place, pair.rule, count(pair.before), count(pair.now), change)
            table.add_row(*row, style="red" if pair.slower else None)
        print_table(console, table, ("before",))
        for words in self.differences:
            console.print(words, markup=False)


def check_name(name: str | None, *, must_exist: bool) -> None:
    """Raises `ConfigError` if nothing can be saved under `name`, or nothing was."""
    if name is None:
        return
    if not re.fullmatch(r"[\w-][\w.-]*", name):
        raise ConfigError(
            f"{name!r} is not a valid name for figures: use letters, digits, '.', '_' and '-'"
        )
    if must_exist and not _path(name).is_file():
        known = ", ".join(sorted(path.stem for path in _FOLDER.glob("*.json"))) or "nothing"
        raise ConfigError(
            f"--compare {name}: there is no {_path(name)}; --save makes one, and {known} is there"
        )


def _path(name: str) -> Path:
    return _FOLDER / f"{name}.json"


def save(name: str, document: dict[str, Any]) -> None:
    """Keep the document of a `bench`; one of the same name is replaced.

    Raises:
        ConfigError: it can't be written.
    """
    try:
        _FOLDER.mkdir(parents=True, exist_ok=True)
        _path(name).write_text(json.dumps(document, indent=2))
    except OSError as error:
        raise ConfigError(f"--save {name}: {error}") from error


def compared(name: str, document: dict[str, Any]) -> Comparison:
    """The contenders of a `bench` beside those that were saved as `name`.

    Raises:
        ConfigError: what was saved can't be read.
    """
    try:
        before = json.loads(_path(name).read_text())
        then = {(c["place"], c["rule"]): c["rounds"] for c in before["contenders"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"--compare {name}: {_path(name)} can't be read: {error}") from error
    pairs = [
        _pair(c["place"], c["rule"], then[c["place"], c["rule"]], c["rounds"])
        for c in document["contenders"]
        if c["rounds"] and then.get((c["place"], c["rule"]))
    ]
    differences = [
        f"{key} was {before.get(key)}, and is {document[key]}"
        for key in ("config", "cores", "cpu", "versions")
        if before.get(key) != document[key]
    ]
    return Comparison(name, pairs, differences)


def _pair(place: str, rule: str, then: list[float], now: list[float]) -> Pair:
    before, rate = median(then), median(now)
    slower = rate < _SLOWER * before and max(now) < min(then)
    return Pair(place, rule, before, rate, slower)
