"""The options of ``eval`` that make a queue of episodes."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from rlightning_aio._core.group.episodes.seeds import checked_seed
from rlightning_aio.errors import ConfigError
from rlightning_aio.evaluation import EpisodeSpec

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.config import EnvConfig

__all__ = [
    "EpisodesFile",
    "QueueOptions",
    "Retries",
    "Seeds",
    "Tasks",
]

EpisodesFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Play the episodes in this file, each once: JSON lines with task, seed, options, "
        "entry.",
    ),
]
Tasks: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TASK,…",
        help="Play these tasks with each of --seeds, on any free env.",
        show_default="those of the config",
    ),
]
Seeds: TypeAlias = Annotated[
    str | None,
    typer.Option(metavar="FIRST:END|SEED,…", help="Play each task once with each of these seeds."),
]
Retries: TypeAlias = Annotated[
    int,
    typer.Option(
        min=0, help="How often an episode is played again that was lost, before it has failed."
    ),
]


@dataclass(frozen=True, slots=True)
class QueueOptions:
    """What the options ask for, as given."""

    episodes_file: Path | None
    tasks: Sequence[str] | None
    seeds: str | None

    @property
    def wanted(self) -> bool:
        """True if the options make a queue.

        Raises:
            ConfigError: an option lacks another one.
        """
        if self.episodes_file is not None or self.seeds is not None:
            return True
        if self.tasks:
            raise ConfigError("--tasks needs the seeds of their episodes: add --seeds 0:50")
        return False

    def specs(self, configs: Sequence[EnvConfig]) -> list[EpisodeSpec]:
        """Return the episodes in the order in which they begin.

        Raises:
            ConfigError: an option or the file is wrong.
        """
        if self.episodes_file is None:
            seeds = _seeds(self.seeds or "")
            names = [name for given in self.tasks or () for name in given.split(",") if name]
            if names:
                return [EpisodeSpec(name, seed) for name in names for seed in seeds]
            return [
                EpisodeSpec(config.task_name, seed, entry=config.name)
                for config in configs
                for seed in seeds
            ]
        if self.tasks or self.seeds is not None:
            raise ConfigError("--episodes-file names the episodes; leave --tasks and --seeds out")
        return _with_tasks(_in_file(self.episodes_file), configs)


def _seeds(text: str) -> list[int]:
    first, colon, end = text.partition(":")
    try:
        given = range(int(first or 0), int(end)) if colon else map(int, text.split(","))
        seeds = [*map(checked_seed, given)]
    except ValueError:
        seeds = []
    if not seeds:
        raise ConfigError(f"--seeds {text!r}: should look like 0:50 or 1,2,5")
    return seeds


def _with_tasks(specs: list[EpisodeSpec], configs: Sequence[EnvConfig]) -> list[EpisodeSpec]:
    """Give episodes without a task that of their entry."""
    task_of = {config.name: config.task_name for config in configs}
    if len(configs) == 1:
        task_of[""] = configs[0].task_name
    return [
        spec if spec.task else replace(spec, task=task_of.get(spec.entry, "")) for spec in specs
    ]


def _in_file(path: Path) -> list[EpisodeSpec]:
    try:
        lines = path.read_text(encoding="utf-8").split("\n")  # JSON may hold other ends of lines.
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--episodes-file {path}: can't be read: {error}") from None
    specs: list[EpisodeSpec] = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            fields: dict[str, Any] = {"task": "", **json.loads(line)}
            spec = EpisodeSpec(**fields)
        except (ValueError, TypeError) as error:
            raise ConfigError(
                f"--episodes-file {path}, line {number}: {error}; a line should look like "
                '{"task": "reach-v3", "seed": 0}, with options and entry if needed'
            ) from None
        specs.append(spec)
    if not specs:
        raise ConfigError(f"--episodes-file {path}: has no episodes")
    return specs
