"""Refuses worker processes on systems that don't have what they need."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from rlightning_aio.config import EnvConfig

__all__ = ["check_system"]


def check_system(config: EnvConfig) -> None:
    """Check that worker processes can run on this system.

    Raises:
        ConfigError: it is not Linux.
    """
    if sys.platform != "linux":
        raise ConfigError(
            f"entry {config.name!r}: worker processes (placement: process) need Linux, and this is "
            f"{sys.platform}. Here, use placement: inline (the envs live in this process), "
            "placement: loop (awaitable envs, in the asynchronous group) or backend: env_server "
            "(envs elsewhere connect); make_vec steps MuJoCo's tasks in one batch in this process"
        )
