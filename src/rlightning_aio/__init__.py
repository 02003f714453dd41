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
    "batch": ("BatchedData",),
    "collecting": ("Collector",),
    "config": ("EnvConfig", "load_config"),
    "envs.base": ("BaseEnv",),
    "errors": (
        "BadAction",
        "ClientRefused",
        "ConfigError",
        "EnvAway",
        "EnvBusy",
        "EnvError",
        "EnvFault",
        "EnvHung",
        "EnvRaised",
        "GroupClosed",
        "NothingPending",
        "RLightningError",
        "ResetNeeded",
        "ResetNeeded",
        "SnapshotError",
        "StartFailed",
        "UnknownEnv",
        "WorkerDied",
    ),
    "_core.group.api.aio": ("EnvGroup", "EnvHandle", "build_env_group", "run"),
    "evaluation": ("evaluate",),
    "outcomes": ("Outcome",),
    "registry": ("ENVS",),
    "spaces": ("Anything",),
    "types": ("EnvMeta", "EnvRet", "MultiAgentEnvRet", "PolicyResponse"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

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
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__", "sync"]
