"""`EpisodeSpec`: an episode to play.

Rule: an episode is identified by its entry, task, seed and options. Which env plays it doesn't
matter, unless it names one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rlightning_aio._core.group.state.episodes import checked_seed

EpisodeKey = tuple[str, str, int | None, str, str]
"""Entry, task, seed, options as JSON, and env of an episode."""


@dataclass(frozen=True, slots=True)
class EpisodeSpec:
    """An episode to play.

    Attributes:
        task: name of the task; empty for the task of the config entry.
        seed: of the reset; None for an episode that can't be repeated.
        options: further options of the reset, such as the number of an initial state.
        entry: name of the config entry; empty for the one whose envs can play the task.
        env_id: of the only env that may play it; empty for any env of the entry.

    Raises:
        ValueError: `seed` is no int from 0 to 2**62 - 1, a name is no str, or `options` are no dict
            or can't be written as JSON. Numbers and arrays of NumPy can.
    """

    task: str
    seed: int | None
    options: Mapping[str, Any] | None = None
    entry: str = ""
    env_id: str = ""

    def __post_init__(self) -> None:
        """Check the fields, and convert the seed, which may be a number of NumPy."""
        if self.seed is not None:
            object.__setattr__(self, "seed", checked_seed(self.seed))
        names: dict[str, Any] = {"task": self.task, "entry": self.entry, "env_id": self.env_id}
        for what, name in names.items():
            if not isinstance(name, str):
                raise ValueError(f"the {what} of an episode should be a str, not {name!r}")
        options: Any = self.options
        if not isinstance(options, Mapping | None):
            raise ValueError(f"the options of an episode should be a dict, not {options!r}")
        try:
            written(self.options)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"the options of an episode can't be written as JSON: {error}"
            ) from error

    @property
    def key(self) -> EpisodeKey:
        """Identity of the episode."""
        return self.entry, self.task, self.seed, written(self.options), self.env_id

    def to_json(self) -> dict[str, Any]:
        """Return the episode as a row of JSON."""
        return {
            "entry": self.entry,
            "task": self.task,
            "seed": self.seed,
            "options": None if self.options is None else json.loads(written(self.options)),
            "env_id": self.env_id,
        }


def spec_of(row: dict[str, Any]) -> EpisodeSpec:
    """Take an episode's fields out of a row that has others as well.

    Raises:
        TypeError, ValueError, KeyError: it has no such fields.
    """
    return EpisodeSpec(**{name: row.pop(name) for name in EpisodeSpec.__slots__})


def written(options: Mapping[str, Any] | None) -> str:
    """Return the options of an episode as JSON; empty without any."""
    if options is None:
        return ""
    return json.dumps(options, sort_keys=True, default=plain, allow_nan=False)


def plain(value: Any) -> Any:
    """Return a number or an array of NumPy as JSON has it; TypeError for anything else."""
    if not hasattr(value, "tolist"):
        raise TypeError(f"{value!r} is neither a number, a text, a list nor an array")
    return value.tolist()
