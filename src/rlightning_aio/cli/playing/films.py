"""The options of commands that film: ``--video`` and those that go with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from rlightning_aio._core.group.setup.plan import Plan, plan_group
from rlightning_aio._core.hosts.filming.video_file import find_ffmpeg
from rlightning_aio.cli.option_files import naming_option
from rlightning_aio.config import MADE_BY_GYMNASIUM, EnvConfig, runs_here
from rlightning_aio.errors import ConfigError
from rlightning_aio.files import check_folder
from rlightning_aio.registry import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.api.aio import EnvGroup

__all__ = [
    "Films",
    "Video",
    "VideoEnvs",
    "VideoEvery",
    "check_films",
    "films_of",
    "rendering",
]

Video: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--video",
        metavar="FOLDER",
        help="Film episodes to this folder (MP4; needs imageio-ffmpeg).",
    ),
]
VideoEnvs: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--video-env",
        metavar="ENV_ID",
        help="Film this env; may be repeated.",
        show_default="the first of each entry",
    ),
]
VideoEvery: TypeAlias = Annotated[
    int | None,
    typer.Option("--video-every", min=1, help="Film every n-th episode.", show_default="1"),
]


@dataclass(frozen=True)
class Films:
    """The films of a run: of some envs, from their first episode on.

    Attributes:
        folder: for the files; None films nothing.
        env_ids: the envs; each has a worker of its own, unless the entry says how many share one.
        every: film every n-th episode.
    """

    folder: Path | None = None
    env_ids: tuple[str, ...] = ()
    every: int = 1

    def plan(self, configs: Sequence[EnvConfig]) -> Plan:
        """Return the plan of a group that can be filmed."""
        ids = self.env_ids
        return plan_group(configs, {}, None, mixed_actions=True, zero_copy=False, filmed=ids)

    async def begin(self, group: EnvGroup) -> None:
        """Film the envs of a group that has just started."""
        if self.folder is not None:
            await group.record_video(self.folder, self.env_ids, self.every)


def films_of(
    configs: Sequence[EnvConfig],
    folder: Path | None,
    env_ids: Sequence[str] | None,
    every: int | None,
) -> tuple[list[EnvConfig], Films]:
    """Return `configs` with envs that can be filmed, and the films that the options ask for.

    Raises:
        ConfigError: an option lacks --video, an env is unknown, or nothing can be filmed here.
    """
    if folder is not None:
        chosen = _chosen(configs, env_ids or None)
        check_films([config for config in configs if config.name in chosen], folder)
        ready = [rendering(config) if config.name in chosen else config for config in configs]
        ids = tuple(env_id for own in chosen.values() for env_id in own)
        return ready, Films(folder, ids, every or 1)
    for name, given in (("--video-env", env_ids), ("--video-every", every)):
        if given:
            raise ConfigError(f"{name} chooses what to film; add --video FOLDER for the files")
    return list(configs), Films()


def check_films(configs: Sequence[EnvConfig], folder: Path) -> None:
    """Find out, before anything is started, whether entries can be filmed.

    Raises:
        ConfigError: the encoder is missing, or nothing can be written to the folder.
    """
    if not any(runs_here(config) for config in configs):
        return
    try:
        find_ffmpeg()
    except ImportError as error:
        raise ConfigError(f"--video: {error}") from None
    with naming_option("--video", folder):
        check_folder(folder)


def _chosen(configs: Sequence[EnvConfig], env_ids: Sequence[str] | None) -> dict[str, list[str]]:
    """Return the ids of the chosen envs, by the name of their entry."""
    if env_ids is None:
        return {c.name: [f"{c.name}-0"] for c in configs if c.backend != "env_server"}
    entries = {
        f"{config.name}-{index}": config.name
        for config in configs
        for index in range(config.num_workers)
    }
    chosen: dict[str, list[str]] = {}
    for env_id in dict.fromkeys(env_ids):
        if env_id not in entries:
            hint = did_you_mean(env_id, entries) or f"known: {', '.join(entries)}"
            raise ConfigError(f"no env {env_id!r} to film; {hint}")
        chosen.setdefault(entries[env_id], []).append(env_id)
    return chosen


def rendering(config: EnvConfig) -> EnvConfig:
    """Return `config` with simulators that can render frames."""
    if config.backend not in MADE_BY_GYMNASIUM:
        return config
    kwargs = {"render_mode": "rgb_array", **config.env_kwargs}
    return config.model_copy(update={"env_kwargs": kwargs})
