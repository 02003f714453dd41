"""Saves figures of `bench` and compares later ones with them.

There is one JSON document for each name, in the folder `.rlightning-aio/bench` of the working
directory.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.cli.option_files import naming_option
from rlightning_aio.cli.terminal import count, named_columns, print_table
from rlightning_aio.errors import ConfigError
from rlightning_aio.files import check_folder, check_regular, write_file
from rlightning_aio.json_text import json_of

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["Comparison", "check_name", "check_save", "compared", "save"]

_FOLDER: Final = Path(".rlightning-aio", "bench")
_SLOWER: Final = 0.95
"""A contender below this share of its former rate, and of all former rounds, is slower."""


@dataclass(frozen=True)
class Pair:
    """Former and present figures of one contender.

    Attributes:
        before, now: medians of steps per second.
        slower: it is slower by more than the rounds differ.
    """

    place: str
    rule: str
    before: float
    now: float
    slower: bool


@dataclass(frozen=True)
class Comparison:
    """A comparison with the figures saved as `name`.

    Attributes:
        differences: other changes, in words.
    """

    name: str
    pairs: list[Pair]
    differences: list[str]

    @property
    def slower(self) -> list[Pair]:
        """Return the contenders that have become slower."""
        return [pair for pair in self.pairs if pair.slower]

    def as_json(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        return {
            "name": self.name,
            "pairs": [asdict(pair) for pair in self.pairs],
            "differences": self.differences,
            "slower": len(self.slower),
        }

    def print(self, console: Console) -> None:
        """Print a table with slower contenders in red."""
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
    """Raise `ConfigError` if `name` is not valid, or if nothing was saved under it."""
    if name is None:
        return
    if not re.fullmatch(r"[\w-][\w.-]*", name):
        raise ConfigError(
            f"{name!r} is not a valid name for figures: use letters, digits, '.', '_' and '-'"
        )
    if must_exist and not _path(name).is_file():
        known = ", ".join(sorted(path.stem for path in _FOLDER.glob("*.json"))) or "nothing"
        raise ConfigError(
            f"--compare {name}: there is no {_path(name)}; saved with --save: {known}"
        )


def _path(name: str) -> Path:
    return _FOLDER / f"{name}.json"


def check_save(name: str | None) -> None:
    """Check before the measurement that figures can be saved as `name`.

    Raises:
        ConfigError: they can't be saved, with the reason.
    """
    if name is not None:
        with naming_option("--save", _path(name)):
            check_folder(_FOLDER)
            check_regular(_path(name))


def save(name: str, document: dict[str, Any]) -> None:
    """Save the document of a `bench`, replacing any with this name.

    Raises:
        ConfigError: it can't be written.
    """
    with naming_option("--save", _path(name)):
        write_file(_path(name), json_of(document, indent=2).encode())


def compared(name: str, document: dict[str, Any]) -> Comparison:
    """Compare the contenders of a `bench` with those saved as `name`.

    Raises:
        ConfigError: the saved figures can't be read.
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
        f"{key} was {before.get(key)} and is now {document[key]}"
        for key in ("config", "cores", "cpu", "versions")
        if before.get(key) != document[key]
    ]
    return Comparison(name, pairs, differences)


def _pair(place: str, rule: str, then: list[float], now: list[float]) -> Pair:
    before, rate = median(then), median(now)
    slower = rate < _SLOWER * before and max(now) < min(then)
    return Pair(place, rule, before, rate, slower)
