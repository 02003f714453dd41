"""The options of commands that film: ``--video`` and its kin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from rlightning_aio.errors import ConfigError
from rlightning_aio.video import record_video

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.config import EnvConfig

__all__ = ["Video", "VideoEnvs", "VideoEvery", "filmed"]

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
    """`configs` with what the options ask for.

    Raises:
        ConfigError: an option lacks --video, or an env can't be filmed.
    """
    if folder is not None:
        return record_video(list(configs), folder, env_ids or None, every=every or 1)
    for name, given in (("--video-env", env_ids), ("--video-every", every)):
        if given:
            raise ConfigError(f"{name} says what to film, but not where to: add --video FOLDER")
    return list(configs)
