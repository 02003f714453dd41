"""From a config entry to a running Isaac Lab environment.

Rule: nothing of Isaac Lab is imported before `make_simulator` is called, and then in
the order that the installed generation needs: 3 reads the task's configuration before
it launches, 2.3 launches before anything else of it can be imported.
Absent on purpose: stepping, which is `isaac`'s.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
from pydantic import BaseModel, ConfigDict, Field

from rlightning_aio.envs.options import load_named, read_options
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import BACKENDS, did_you_mean

if TYPE_CHECKING:
    from rlightning_aio.config import EnvConfig

ANY_SEED = -1
"""Isaac Lab draws a seed where it finds this one."""

# Stopping Isaac Sim ends the process it runs in, so what was launched stays until the
# process goes. Without Isaac Sim the entries hold nothing.
_launched: list[Any] = []


class IsaacOptions(BaseModel):
    """What ``env_kwargs`` of the Isaac backends may hold."""

    model_config = ConfigDict(extra="forbid")

    device: str | None = None
    """Simulation device; None takes ``cuda:0`` where there is one, else ``cpu``."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Fields of the task's configuration, dotted or nested: ``sim.dt: 0.01``. ``seed: 7`` seeds
    what the task draws once, while it is built; each env of the entry takes its own from there."""
    env_class: str | None = None
    """``module::Class`` of the environment, for a task given by its configuration class."""
    launcher: dict[str, Any] = Field(default_factory=dict)
    """Arguments of ``AppLauncher`` (2.3) or ``launch_simulation`` (3)."""


def make_simulator(
    env_id: str, config: EnvConfig, default_env_class: str | None, worker_index: int = 0
) -> Any:
    """Launch what the task needs and build its environment, unwrapped.

    Args:
        env_id: for messages.
        config: its ``task`` is a registered name, ``package:name`` with the package that
            registers it, or ``module::Class`` of a configuration.
        default_env_class: ``module::Class`` built from a configuration class if
            ``env_kwargs.env_class`` is missing.
        worker_index: of the env within its entry.

    Raises:
        ConfigError: there is no Isaac Lab; an option, an override or the task doesn't
            exist; or, for Isaac Lab 2.3, this isn't the main thread.
    """
    if importlib.util.find_spec("isaaclab") is None:
        raise ConfigError(
            f"{env_id}: {sys.executable} has no Isaac Lab; set the entry's interpreter to the "
            f"Python of an environment made by: {BACKENDS['isaac_marl'].install}"
        )
    options = read_options(IsaacOptions, env_id, config.env_kwargs)
    device = options.device or _default_device()
    app: Any = importlib.import_module("isaaclab.app")
    launcher_args = {"headless": True, **options.launcher, "device": device}
    if hasattr(app, "launch_simulation"):
        cfg = _make_cfg(env_id, config, options, device, worker_index)
        runtime = app.launch_simulation(cfg, launcher_args)
        runtime.__enter__()
        _launched.append(runtime)
    else:
        if not _launched:
            _launched.append(_launch_isaac_sim(env_id, app, launcher_args))
        cfg = _make_cfg(env_id, config, options, device, worker_index)
    if "::" not in config.task_name:
        return gym.make(config.task_name, cfg=cfg).unwrapped
    env_class = options.env_class or default_env_class
    if env_class is None:
        raise ConfigError(
            f"{env_id}: task {config.task_name!r} is a configuration class; say which environment "
            "it is for in env_kwargs.env_class, as 'module::Class'"
        )
    return load_named(env_id, "env_kwargs.env_class", env_class, "::")(cfg=cfg)


def _launch_isaac_sim(env_id: str, app: Any, launcher_args: dict[str, Any]) -> Any:
    if threading.current_thread() is not threading.main_thread():
        raise ConfigError(
            f"{env_id}: Isaac Sim starts on the main thread only; use placement: process"
        )
    return app.AppLauncher(**launcher_args)


def _default_device() -> str:
    torch: Any = importlib.import_module("torch")
    return "cuda:0" if torch.cuda.is_available() else "cpu"


def _make_cfg(
    env_id: str, config: EnvConfig, options: IsaacOptions, device: str, worker_index: int
) -> Any:
    """The task's configuration, with this entry's settings in it."""
    tasks: Any = importlib.import_module("isaaclab_tasks.utils")
    if "::" in config.task_name:
        cfg = load_named(env_id, "task", config.task_name, "::")()
        if hasattr(tasks, "resolve_presets"):
            cfg = tasks.resolve_presets(cfg)
        cfg.sim.device = device
        cfg.scene.num_envs = config.num_envs
    else:
        importlib.import_module("isaaclab_tasks")
        package, _, name = config.task_name.rpartition(":")
        if package:
            importlib.import_module(package)
        _check_registered(env_id, name)
        cfg = tasks.parse_env_cfg(name, device=device, num_envs=config.num_envs)
    if hasattr(cfg, "compute_final_obs"):
        cfg.compute_final_obs = True
    _apply(cfg, options.overrides, f"{env_id}: env_kwargs.overrides")
    if cfg.seed not in (None, ANY_SEED):
        # As resets count: envs of one seed would all have the same masses and terrain.
        cfg.seed += worker_index * config.num_envs
    if config.max_episode_steps is not None:
        # Half a step short: the simulator rounds up, and the product may exceed the whole.
        cfg.episode_length_s = (config.max_episode_steps - 0.5) * cfg.decimation * cfg.sim.dt
    return cfg


def _check_registered(env_id: str, name: str) -> None:
    if name in gym.registry:
        return
    hint = did_you_mean(name, gym.registry)
    raise ConfigError(
        f"{env_id}: task {name!r} is not registered{f'; {hint}' if hint else ''} "
        "Write 'package:name' if another package registers it, "
        "or 'module::Class' for a configuration class"
    )


def _apply(target: Any, overrides: Mapping[str, Any], where: str) -> None:
    """Set fields of a configuration tree of objects, dicts and lists, in place."""
    for dotted, value in overrides.items():
        field = f"{where}.{dotted}"
        parent = target
        *path, last = dotted.split(".")
        for name in path:
            parent = _child(parent, name, field)
        current = _child(parent, last, field)
        if isinstance(value, Mapping) and current is not None:
            _apply(current, cast("Mapping[str, Any]", value), field)
        else:
            given = cast("Any", value)
            _set_child(parent, last, tuple(given) if isinstance(current, tuple) else given)


def _child(parent: Any, name: str, field: str) -> Any:
    """The part of `parent` called `name`: an item of a dict or a list, or an attribute."""
    children = _children(parent)
    if name in children:
        return children[name]
    hint = did_you_mean(name, children) or f"it has {', '.join(children) or 'nothing'}"
    raise ConfigError(f"{field}: there is no {name!r} in {type(parent).__name__}; {hint}")


def _children(parent: Any) -> dict[str, Any]:
    if isinstance(parent, dict):
        return cast("dict[str, Any]", parent)
    if isinstance(parent, list | tuple):
        return {str(index): item for index, item in enumerate(cast("list[Any]", parent))}
    return getattr(parent, "__dict__", {})


def _set_child(parent: Any, name: str, value: Any) -> None:
    if isinstance(parent, dict):
        parent[name] = value
    elif isinstance(parent, list):
        parent[int(name)] = value
    else:
        setattr(parent, name, value)
