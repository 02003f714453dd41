"""The options of commands that film: ``--video`` and those that go with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from rlightning_aio.config import MADE_BY_GYMNASIUM, EnvConfig
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Video", "VideoEnvs", "VideoEvery", "filmed", "rendering"]

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


def filmed(
    configs: Sequence[EnvConfig],
    folder: Path | None,
    env_ids: Sequence[str] | None,
    every: int | None,
) -> list[EnvConfig]:
    """Return `configs` with the video that the options ask for.

    Raises:
        ConfigError: an option lacks --video, or an env can't be filmed.
    """
    if folder is not None:
        fields = {"folder": str(folder), "every": every or 1}
        chosen = _chosen(configs, env_ids or None)
        return [
            _filmed(config, {**fields, "envs": own}) if own else config
            for config, own in zip(configs, chosen, strict=True)
        ]
    for name, given in (("--video-env", env_ids), ("--video-every", every)):
        if given:
            raise ConfigError(f"{name} chooses what to film; add --video FOLDER for the files")
    return list(configs)


def _chosen(configs: Sequence[EnvConfig], env_ids: Sequence[str] | None) -> list[list[int]]:
    """Return the numbers of the chosen envs of each entry."""
    if env_ids is None:
        return [[] if config.backend == "env_server" else [0] for config in configs]
    places = {
        f"{config.name}-{index}": (entry, index)
        for entry, config in enumerate(configs)
        for index in range(config.num_workers)
    }
    chosen: list[list[int]] = [[] for _ in configs]
    for env_id in dict.fromkeys(env_ids):
        if env_id not in places:
            hint = did_you_mean(env_id, places) or f"known: {', '.join(places)}"
            raise ConfigError(f"no env {env_id!r} to film; {hint}")
        entry, index = places[env_id]
        chosen[entry].append(index)
    return chosen


def rendering(config: EnvConfig) -> EnvConfig:
    """Return `config` with simulators that can render frames."""
    if config.backend not in MADE_BY_GYMNASIUM:
        return config
    kwargs = {"render_mode": "rgb_array", **config.env_kwargs}
    return config.model_copy(update={"env_kwargs": kwargs})


def _filmed(config: EnvConfig, video: dict[str, Any]) -> EnvConfig:
    fields = {name: getattr(config, name) for name in config.model_fields_set}
    if config.backend in MADE_BY_GYMNASIUM:
        fields["env_kwargs"] = rendering(config).env_kwargs
    try:
        return EnvConfig.model_validate({**fields, "video": video})
    except ValueError as error:
        raise ConfigError(f"entry {config.name!r}, video: {error}") from None
