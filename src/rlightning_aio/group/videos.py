"""Checks what filming needs, before anything is started."""

from __future__ import annotations

import importlib.util
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import placement_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rlightning_aio.config import EnvConfig

__all__ = ["check_videos", "filmed_alone"]


def check_videos(configs: Iterable[EnvConfig]) -> None:
    """Look for the encoder, and for a place for the files; where those are another machine's, or
    the encoder another Python's, it is not known here.

    Raises:
        ConfigError: one of them is missing; the message names entry and field.
    """
    for config in configs:
        if config.video is None or not placement_of(config.backend, config.placement).local:
            continue
        where = f"entry {config.name!r}, video"
        if config.interpreter is None and importlib.util.find_spec("imageio_ffmpeg") is None:
            raise ConfigError(f"{where}: needs imageio-ffmpeg: pip install 'rlightning-aio[video]'")
        folder = Path(config.video.folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            raise ConfigError(
                f"{where}.folder: nothing can be written to {folder}: {error.strerror}"
            ) from None


def filmed_alone(config: EnvConfig) -> set[int]:
    """Which envs of an entry have a worker of their own, as others would wait for their frames."""
    if config.video is None or config.envs_per_process != "auto":
        return set()
    return set(config.video.envs)
