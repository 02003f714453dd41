"""Check the requirements of video recording before anything is started."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

from rlightning_aio.errors import ConfigError
from rlightning_aio.files import check_folder
from rlightning_aio.registry import placement_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rlightning_aio.config import EnvConfig

__all__ = ["check_videos", "filmed_alone"]


def check_videos(configs: Iterable[EnvConfig]) -> None:
    """Check that the encoder is installed and the folder writable.

    Entries on other machines are skipped, and so is the encoder of another interpreter.

    Raises:
        ConfigError: the encoder is missing, the folder isn't writable, or the env can't render.
    """
    for config in configs:
        if config.video is None:
            continue
        where = f"entry {config.name!r}, video"
        if config.backend == "ale" and config.num_envs > 1:
            raise ConfigError(
                f"{where}: ale-py's vector env, which num_envs: {config.num_envs} makes, renders "
                "nothing; film an entry with num_envs: 1"
            )
        if not placement_of(config.backend, config.placement).local:
            continue
        if config.interpreter is None and importlib.util.find_spec("imageio_ffmpeg") is None:
            raise ConfigError(f"{where}: needs imageio-ffmpeg: pip install 'rlightning-aio[video]'")
        try:
            check_folder(config.video.folder)
        except OSError as error:
            raise ConfigError(
                f"{where}.folder: nothing can be written to {error.filename}: {error.strerror}"
            ) from None


def filmed_alone(config: EnvConfig) -> set[int]:
    """The filmed envs of an entry; each gets its own worker, as rendering would delay others."""
    if config.video is None or config.envs_per_process != "auto":
        return set()
    return set(config.video.envs)
