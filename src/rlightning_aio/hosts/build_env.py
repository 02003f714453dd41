"""Where an env comes from: the one place that calls an env's class."""

from __future__ import annotations

import contextlib
import importlib
from typing import TYPE_CHECKING, Any

from gymnasium.error import UnregisteredEnv

from rlightning_aio.hosts.known_tasks import register_tasks
from rlightning_aio.hosts.runner import EnvRunner
from rlightning_aio.hosts.saving import SavingRunner
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.hosts.messages import StartOrder

__all__ = ["build_env", "built_envs"]


def build_env(
    config: EnvConfig,
    env_class: type[BaseEnv] | None = None,
    worker_index: int = 0,
    preprocess_fn: Any = None,
) -> BaseEnv:
    """Import what the entry asks for and build one env of it; `env_class` None resolves it."""
    for module in config.imports:
        importlib.import_module(module)
    env_class = env_class or ENVS.resolve(config.backend)
    return env_class(config, worker_index=worker_index, preprocess_fn=preprocess_fn)


def built_envs(order: StartOrder, *, inline: bool = False) -> Iterator[EnvRunner]:
    """Build the envs of a host, one after the other."""
    for place, (index, fn) in enumerate(
        zip(order.worker_indices, order.preprocess_fns, strict=True)
    ):
        config = order.config
        makers: Any = config.make_env
        if isinstance(makers, tuple):
            config = config.model_copy(update={"make_env": makers[place]})
        env = _built(order, config, index, fn)
        env.trainer_pid = None if inline else order.trainer_pid
        runner = EnvRunner if config.snapshot_every is None else SavingRunner
        video = config.video
        filmed = video is not None and index in video.envs
        yield runner(env, inline=inline, video=video if filmed else None)


def _built(order: StartOrder, config: EnvConfig, index: int, preprocess_fn: Any) -> BaseEnv:
    if order.tasks:
        # Only if one is missing: whoever registers it here would be warned that it is there.
        with contextlib.suppress(UnregisteredEnv):
            return build_env(config, order.env_class, index, preprocess_fn)
        register_tasks(order.tasks)
    return build_env(config, order.env_class, index, preprocess_fn)
