"""Provides RLightning's modules, with our objects in them, where RLightning is not installed.

Rule: a table of paths and names. A name of RLightning's that is not in it raises an ImportError
that explains this. Modules are made when they are first imported.
"""

from __future__ import annotations

import importlib
import sys
from importlib.machinery import ModuleSpec
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import ModuleType

__all__ = ["ALIASED", "install_finder", "is_ours"]

_HERE: Final = "rlightning_aio.plugins.legacy"
_ENV_CONFIG: Final = {"config": ("Config", "EnvConfig")}
_REGISTRY: Final = {"registry": ("ENVS", "Registry", "load_modules_from_config")}
_RETS: Final = ("EnvRet", "MultiAgentEnvRet", "Processed_EnvRet_fields")
_RESPONSES: Final = ("MultiAgentPolicyResponse", "PolicyResponse")
_PROFILER: Final = ("record_timing", "timer", "timer_wrap")

ALIASED: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "rlightning": {},
    "rlightning.types": {"types": ("BatchedData", "EnvMeta", *_RETS, *_RESPONSES)},
    "rlightning.types.batched_data": {"types": ("BatchedData",)},
    "rlightning.types.env_rets": {"types": _RETS},
    "rlightning.types.metadata": {"types": ("EnvMeta",)},
    "rlightning.types.policy_response": {"types": _RESPONSES},
    "rlightning.env": {
        "env": ("BaseEnv",),
        "types": ("EnvMeta",),
        "group": ("EnvGroup", "build_env_group"),
    },
    "rlightning.env.base_env": {"env": ("BaseEnv",), "types": ("EnvMeta",)},
    "rlightning.env.env_group": {
        "counter": ("EnvStepCounter", "ThroughputTracker"),
        "group": ("EnvGroup",),
    },
    "rlightning.env.env_server": {"remote": ("RemoteEnvServer",)},
    "rlightning.env.remote_env": {"remote": ("RemoteEnvClient",)},
    "rlightning.env.remote_env.env_client": {"remote": ("RemoteEnvClient",)},
    "rlightning.env.mujoco_env": {"backends": ("MujocoEnv",)},
    "rlightning.env.ale_env": {"backends": ("ALEEnv",)},
    "rlightning.env.maniskill_env": {"backends": ("ManiskillEnv",)},
    "rlightning.env.isaac_env": {"backends": ("IsaacEnv",)},
    "rlightning.env.isaac_marl_env": {"backends": ("IsaacMarlEnv",)},
    "rlightning.env.piper_env": {"backends": ("PiperEnv",)},
    "rlightning.env.utils": {},
    "rlightning.env.utils.utils": {"env": ("default_env_preprocess_fn",)},
    "rlightning.utils": {},
    "rlightning.utils.builders": {"group": ("build_env_group", "define_env_instance_cfgs")},
    "rlightning.utils.config": _ENV_CONFIG,
    "rlightning.utils.config.config": _ENV_CONFIG,
    "rlightning.utils.logger": {"profiler": ("get_logger", "log_metric")},
    "rlightning.utils.profiler": {},
    "rlightning.utils.profiler.profiler": {"profiler": _PROFILER},
    "rlightning.utils.ray": {"tensors": ("resolve_object",)},
    "rlightning.utils.registry": _REGISTRY,
    "rlightning.utils.registry.registry": {"registry": ("Registry",)},
    "rlightning.utils.utils": {
        "flags": ("InternalFlag",),
        "tensors": ("to_device", "to_numpy"),
    },
}
"""For each module of RLightning: our modules, and the names taken from each."""

_SECTIONS: Final = (
    "BufferConfig", "ClusterConfig", "LogConfig", "MainConfig", "PolicyConfig",
    "ResourcePoolConfig", "TrainConfig", "WeightBufferConfig", "validate_config_for_placement",
)  # fmt: skip
_ABSENT: Final = {
    "rlightning.utils.builders": (
        "build_data_buffer", "build_engine", "build_policy_group",
        "create_distributed_policy_class",
    ),
    "rlightning.env": ("LiberoEnv",),
    "rlightning.utils.config": _SECTIONS,
    "rlightning.utils.config.config": _SECTIONS,
    "rlightning.utils.ray": ("RayActorMixin", "TaskSubmitter"),
    "rlightning.utils.registry": ("BUFFERS", "ENGINE", "POLICIES", "WEIGHTS"),
}  # fmt: skip
"""Names that programs often import and that only RLightning itself has."""


def _refusal(name: str) -> ImportError:
    # Without the module's name, which would make `from rlightning import engine` ignore it.
    return ModuleNotFoundError(
        f"{name} belongs to RLightning, which is not installed: rlightning_aio.legacy has its "
        "names for envs and groups, but not its experiments, engines, buffers and policies; "
        "install RLightning, and its builder still makes groups of rlightning_aio"
    )


class _Finder:
    """Finds and loads the modules of `ALIASED`."""

    def find_spec(
        self, path: str, where: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        del where, target
        if path.partition(".")[0] != "rlightning":
            return None
        if path not in ALIASED:
            raise _refusal(path)
        return ModuleSpec(path, self, origin=_HERE, is_package=True)  # pyright: ignore[reportArgumentType]

    def create_module(self, spec: ModuleSpec) -> None:
        del spec

    def exec_module(self, module: ModuleType) -> None:
        if module.__name__ == "rlightning":
            # Register the built-in envs in every process that imports RLightning.
            importlib.import_module(f"{_HERE}.backends")
            module.__dict__["__version__"] = importlib.import_module("rlightning_aio").__version__
        homes = ALIASED[module.__name__]
        origin = {name: home for home, names in homes.items() for name in names}
        module.__dict__["__all__"] = list(origin)
        module.__dict__["__getattr__"] = _getter(module, origin)


def _getter(module: ModuleType, origin: dict[str, str]) -> Callable[[str], Any]:
    def get(name: str) -> Any:
        path = module.__name__
        if name in origin:
            value = getattr(importlib.import_module(f"{_HERE}.{origin[name]}"), name)
            setattr(module, name, value)
            return value
        if f"{path}.{name}" in ALIASED:
            return importlib.import_module(f"{path}.{name}")
        if name in _ABSENT.get(path, ()):
            raise _refusal(f"{path}.{name}")
        # `hasattr` and `getattr` with a default expect an AttributeError.
        raise AttributeError(f"{path} has no {name!r} in rlightning_aio.legacy")

    return get


_finder: Final[Any] = _Finder()


def is_ours(spec: ModuleSpec | None) -> bool:
    """Return True if this finder provides the module."""
    return spec is not None and spec.loader is _finder


def install_finder() -> None:
    """Make ``import rlightning`` find the modules of `ALIASED`."""
    if _finder not in sys.meta_path:
        sys.meta_path.append(_finder)
