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
    from rlightning_aio.evaluation.episode_video import Wanted

__all__ = [
    "EpisodesFile",
    "QueueOptions",
    "Retries",
    "Seeds",
    "Tasks",
    "VideoEpisodes",
    "VideoFailed",
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
VideoFailed: TypeAlias = Annotated[
    bool,
    typer.Option("--video-failed", help="Of a queue, keep only films of episodes without success."),
]
VideoEpisodes: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--video-episode",
        metavar="TASK:SEED",
        help="Of a queue, film this episode; may be repeated.",
        show_default="all",
    ),
]


@dataclass(frozen=True, slots=True)
class QueueOptions:
    """What the options ask for, as given."""

    episodes_file: Path | None
    tasks: Sequence[str] | None
    seeds: str | None
    video: Path | None
    video_every: int | None
    video_failed: bool
    video_episodes: Sequence[str] | None

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
        if self.video_failed or self.video_episodes:
            raise ConfigError(
                "--video-failed and --video-episode choose episodes of a queue; add --seeds or "
                "--episodes-file"
            )
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

    def films(self, specs: Sequence[EpisodeSpec]) -> dict[str, Any]:
        """Return what `evaluate` is to know of films.

        Raises:
            ConfigError: an option lacks --video, or names no episode.
        """
        chosen = set(self.video_episodes or ())
        if self.video is None:
            if chosen or self.video_failed or self.video_every:
                raise ConfigError(
                    "--video-episode, --video-failed and --video-every choose what to film; add "
                    "--video FOLDER for the files"
                )
            return {}
        for name in chosen - {_name(spec) for spec in specs}:
            raise ConfigError(f"--video-episode {name}: is not in the queue; give TASK:SEED")
        every = {_place(spec) for spec in specs[:: self.video_every or 1]}

        def wanted(spec: EpisodeSpec) -> Wanted:
            is_chosen = _place(spec) in every and (not chosen or _name(spec) in chosen)
            return "failed" if is_chosen and self.video_failed else is_chosen

        return {"video": self.video, "video_if": wanted}


def _name(spec: EpisodeSpec) -> str:
    return f"{spec.task}:{spec.seed}"


def _place(spec: EpisodeSpec) -> Any:
    """Return what identifies an episode before its entry is known."""
    return spec.key[1:]


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
