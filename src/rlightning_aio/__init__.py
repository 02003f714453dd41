"""rlightning_aio: many reinforcement-learning environments in worker processes, used as one.

The names that most programs need; each is imported when it is first used, as a worker needs few of
them. What ``docs/reference`` lists is promised. Everything else, `_core` above all, may change.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlightning_aio._core.group.api.aio import EnvGroup, EnvHandle, build_env_group, run
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.collecting import Collector
    from rlightning_aio.config import EnvConfig, load_config
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.errors import (
        BadAction,
        ClientRefused,
        ConfigError,
        EnvAway,
        EnvBusy,
        EnvError,
        EnvFault,
        EnvHung,
        EnvRaised,
        EpisodeLost,
        GroupClosed,
        NothingPending,
        ResetNeeded,
        RLightningError,
        SnapshotError,
        StartFailed,
        UnknownEnv,
        WorkerDied,
    )
    from rlightning_aio.evaluation import evaluate
    from rlightning_aio.outcomes import Outcome
    from rlightning_aio.registry import ENVS
    from rlightning_aio.spaces import Anything
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

__version__ = "0.2.0"

_HOMES = {
    "ENVS": "registry",
    "Anything": "spaces",
    "BaseEnv": "envs.base",
    "BatchedData": "batch",
    "Collector": "collecting",
    "EnvConfig": "config",
    "EnvGroup": "_core.group.api.aio",
    "EnvHandle": "_core.group.api.aio",
    "EnvMeta": "types",
    "EnvRet": "types",
    "MultiAgentEnvRet": "types",
    "Outcome": "outcomes",
    "PolicyResponse": "types",
    "build_env_group": "_core.group.api.aio",
    "evaluate": "evaluation",
    "load_config": "config",
    "run": "_core.group.api.aio",
}
"""Modules of names; all others are errors."""

__all__ = [
    "ENVS",
    "Anything",
    "BadAction",
    "BaseEnv",
    "BatchedData",
    "ClientRefused",
    "Collector",
    "ConfigError",
    "EnvAway",
    "EnvBusy",
    "EnvConfig",
    "EnvError",
    "EnvFault",
    "EnvGroup",
    "EnvHandle",
    "EnvHung",
    "EnvMeta",
    "EnvRaised",
    "EnvRet",
    "EpisodeLost",
    "GroupClosed",
    "MultiAgentEnvRet",
    "NothingPending",
    "Outcome",
    "PolicyResponse",
    "RLightningError",
    "ResetNeeded",
    "SnapshotError",
    "StartFailed",
    "UnknownEnv",
    "WorkerDied",
    "build_env_group",
    "evaluate",
    "load_config",
    "run",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = _HOMES.get(name, "errors")
    value = getattr(importlib.import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__", "sync"]
