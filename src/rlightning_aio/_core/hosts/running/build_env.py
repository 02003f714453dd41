"""Builds envs; no other module calls the class of an env."""

from __future__ import annotations

import importlib
import os
from functools import partial
from inspect import iscoroutinefunction
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rlightning_aio._core.hosts.messages import NotBuilt
from rlightning_aio._core.hosts.running.known_tasks import register_tasks
from rlightning_aio._core.hosts.running.renewal import Renewal
from rlightning_aio._core.hosts.running.runner import EnvRunner, seed_generators
from rlightning_aio.config import makers_of
from rlightning_aio.envs.adapted.films import RECORD_VIDEO, record
from rlightning_aio.envs.adapted.makers import RESTARTS
from rlightning_aio.envs.hardware import ACTION_TIMEOUT, HELD, limit_actions, says_hardware
from rlightning_aio.envs.results import is_awaitable
from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.registry import CALLABLE, ENVS, placement_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio._core.hosts.messages import StartOrder
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.base import BaseEnv


def build_env(
    config: EnvConfig,
    env_class: type[BaseEnv] | None = None,
    worker_index: int = 0,
    preprocess_fn: Any = None,
    *,
    is_hardware: bool = False,
) -> BaseEnv:
    """Import the modules of the entry and build one env; `env_class` None resolves it."""
    for module in config.imports:
        importlib.import_module(module)
    env_class = env_class or ENVS.resolve(config.backend)
    ours = {RECORD_VIDEO, ACTION_TIMEOUT} if is_hardware else {RECORD_VIDEO}
    given = config.env_kwargs
    if ours := ours & given.keys():
        own = {name: value for name, value in given.items() if name not in ours}
        config = config.model_copy(update={"env_kwargs": own})
    env = env_class(config, worker_index=worker_index, preprocess_fn=preprocess_fn)
    if RECORD_VIDEO in ours:
        record(env, config.name, given[RECORD_VIDEO])
    if ACTION_TIMEOUT in ours:
        limit_actions(env, given[ACTION_TIMEOUT])
    return env


def built_envs(order: StartOrder, *, inline: bool = False) -> Iterator[EnvRunner]:
    """Build the envs of a host one after the other; see `built_env`.

    A worker has its own numbers: those that fork servers fork have the same generators.
    """
    if not inline:
        seed_generators()
        register_tasks(order.tasks)
    simulations: dict[int, str] = {}
    num_envs = len(order.worker_indices)
    renewal = Renewal(order.config, num_envs) if order.config.recycle else None
    for index in range(num_envs):
        runner = built_env(order, index, inline=inline)
        runner.renewal = renewal
        check_distinct(runner.env, simulations)
        yield runner


def check_distinct(env: BaseEnv, simulations: dict[int, str]) -> None:
    """Check that an env of a host is an object of its own, and add it to those of the others.

    Args:
        env: of the host.
        simulations: whose each object is, by its `id`.

    Raises:
        ConfigError: its callable has returned what another one has; both would step one simulation.
    """
    if env.config.backend != CALLABLE:
        return
    other = simulations.setdefault(id(_simulation_of(env)), env.env_id)
    if other != env.env_id:
        raise ConfigError(
            f"the callables of envs {other!r} and {env.env_id!r} returned the same env object; "
            "make an env in the callable, and return that: lambda: MyEnv()"
        )


def _simulation_of(env: BaseEnv) -> object:
    made: Any = getattr(env, "env", None)
    if made is None:
        return env
    return made.unwrapped if isinstance(made, gym.Env | gym.vector.VectorEnv) else made  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]


def not_built(
    host_id: int, order: StartOrder | None, num_built: int, error: BaseException
) -> NotBuilt:
    """Report that the env after so many, or the description of the last one, raised `error`."""
    most = 1 if order is None else len(order.worker_indices)
    return NotBuilt(host_id, min(num_built, most - 1), ErrorText.of(error))


def built_env(order: StartOrder, index: int, *, inline: bool = False) -> EnvRunner:
    """Build one env of a host.

    While it is made, `RESTARTS` is in the environment if it takes the place of another.

    Args:
        order: of the host.
        index: of the env in the host.
        inline: see `EnvRunner`.

    Raises:
        TypeError: the env is awaitable and its placement can't await it, or the reverse.
        ConfigError: the env says that it is hardware, and what makes it doesn't; or its `stop` is
            a coroutine function.
    """
    config, worker_index = order.config, order.worker_indices[index]
    if makers := makers_of(config):
        config = config.model_copy(update={"task": makers[index]})

    def make(*, is_again: bool) -> BaseEnv:
        fn = order.preprocess_fns[index]
        hardware = order.is_hardware
        if is_again:
            os.environ[RESTARTS] = "1"
        try:
            env = build_env(config, order.env_class, worker_index, fn, is_hardware=hardware)
        finally:
            os.environ.pop(RESTARTS, None)
        env.trainer_pid = None if inline else order.trainer_pid
        if inline and hardware:
            HELD.add(env)
        return env

    env = make(is_again=order.is_again)
    if says_hardware(env) and not order.is_hardware:
        raise ConfigError(
            f"env {env.env_id!r} moves something real, as its attribute `hardware` says, and the "
            "group has to know before it is made: set `hardware = True` on the callable, too, or "
            "register a backend with hardware=True"
        )
    if order.is_hardware and any(map(_stops_by_coroutine, (env, env.env))):
        raise ConfigError(
            f"env {env.env_id!r} moves something real, and its stop() is called from any thread, "
            "also while nothing else runs: make it a plain method, not `async def`"
        )
    kind = _runner_class(env, config)
    # Others are replaced by their host, with a runner of their own.
    rebuilt = not (kind.is_awaitable or order.is_hardware)
    rebuild = partial(make, is_again=True) if rebuilt else None
    renews = config.on_env_error == "restart"
    return kind(env, inline=inline, rebuild=rebuild, renews=renews, is_hardware=order.is_hardware)


def _stops_by_coroutine(env: Any) -> bool:
    return iscoroutinefunction(getattr(env, "stop", None))


def _runner_class(env: BaseEnv, config: EnvConfig) -> type[EnvRunner]:
    awaits = placement_of(config.backend, config.placement).awaits
    if not is_awaitable(env):
        if awaits == "only":
            raise TypeError(
                f"env {env.env_id!r} would block the event loop, for its reset and step are not "
                "`async def`; make them so, or use placement: process or inline"
            )
        return EnvRunner
    if awaits == "never":
        raise TypeError(
            f"env {env.env_id!r} is awaitable (its step is `async def`), and placement "
            f"{config.placement!r} has no event loop for it; use placement: loop or process"
        )
    # Not at the top: few workers need it.
    from rlightning_aio._core.hosts.running.awaited_runner import AwaitedRunner  # noqa: PLC0415

    return AwaitedRunner
