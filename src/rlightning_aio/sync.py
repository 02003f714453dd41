"""The synchronous facade: the same group without ``await``, event loop or thread."""

from __future__ import annotations

from rlightning_aio._core.group.api.sync import EnvGroup, EnvHandle, build_env_group

__all__ = ["EnvGroup", "EnvHandle", "build_env_group"]
