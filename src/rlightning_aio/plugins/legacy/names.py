"""Makes ``import rlightning`` work: RLightning's own modules if it is installed, or ours.

Rule: a table of paths and names. A name of RLightning's that is not in it raises an ImportError
that explains this. Modules are made when they are first imported, and no other module of this
package asks if RLightning is installed.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import ModuleType

_ROOT: Final = "rlightning"
_HERE: Final = "rlightning_aio.plugins.legacy"

ALIASED: Final[dict[str, dict[str, str]]] = {
    "rlightning": {},
    "rlightning.types": dict.fromkeys(
        ("BatchedData", "EnvMeta", "EnvRet", "PolicyResponse"), "types"
    ),
    "rlightning.env": {
        "BaseEnv": "env", "EnvGroup": "group", "EnvMeta": "types", "build_env_group": "group",
    },
    "rlightning.env.base_env": {"BaseEnv": "env"},
    "rlightning.env.env_group": {"EnvGroup": "group", "EnvStepCounter": "group"},
    "rlightning.env.remote_env": {"RemoteEnvClient": "remote"},
    "rlightning.env.remote_env.env_client": {"RemoteEnvClient": "remote"},
    "rlightning.env.mujoco_env": {"MujocoEnv": "env"},
    "rlightning.env.ale_env": {"ALEEnv": "env"},
    "rlightning.env.utils": {},
    "rlightning.env.utils.utils": {"default_env_preprocess_fn": "env"},
    "rlightning.utils": {},
    "rlightning.utils.builders": {"build_env_group": "group"},
    "rlightning.utils.config": dict.fromkeys(("Config", "EnvConfig"), "config"),
    "rlightning.utils.ray": {"resolve_object": "registry"},
    "rlightning.utils.registry": dict.fromkeys(
        ("ENVS", "Registry", "load_modules_from_config"), "registry"
    ),
    "rlightning.utils.registry.registry": {"Registry": "registry"},
    "rlightning.utils.utils": {"InternalFlag": "registry"},
}  # fmt: skip
"""For each module of RLightning: its names, and our module that has each."""

_HOMES: Final = {
    "EnvRet": "types", "PolicyResponse": "types", "BatchedData": "types",
    "ENVS": "utils.registry", "default_env_preprocess_fn": "env.utils.utils",
}  # fmt: skip
"""Where RLightning has the names that a group needs, its own or ours."""


class _Finder:
    """Finds and loads the modules of `ALIASED`."""

    def find_spec(
        self, path: str, where: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        del where, target
        if path.partition(".")[0] != _ROOT:
            return None
        if path not in ALIASED:
            # Without its name, which would make `from rlightning import engine` ignore it.
            raise ModuleNotFoundError(
                f"{path} belongs to RLightning, which is not installed: rlightning_aio.legacy has "
                "its names for envs and groups, but not its experiments, engines, buffers and "
                "policies; install RLightning, and its builder still makes groups of rlightning_aio"
            )
        # As packages they send every name that they lack here, too.
        return ModuleSpec(path, self, origin=_HERE, is_package=True)  # pyright: ignore[reportArgumentType]

    def create_module(self, spec: ModuleSpec) -> None:
        del spec

    def exec_module(self, module: ModuleType) -> None:
        if module.__name__ == _ROOT:
            # Register the built-in envs in every process that imports RLightning.
            importlib.import_module(f"{_HERE}.env")
        homes = ALIASED[module.__name__]
        module.__dict__["__all__"] = list(homes)
        module.__dict__["__getattr__"] = _getter(module, homes)


def _getter(module: ModuleType, homes: dict[str, str]) -> Callable[[str], Any]:
    def get(name: str) -> Any:
        path = f"{module.__name__}.{name}"
        if name in homes:
            value = getattr(importlib.import_module(f"{_HERE}.{homes[name]}"), name)
            setattr(module, name, value)
            return value
        if path in ALIASED:
            return importlib.import_module(path)
        # `hasattr` and `getattr` with a default expect an AttributeError.
        raise AttributeError(f"{path} is no name of rlightning_aio.legacy")

    return get


_finder: Final[Any] = _Finder()


def is_rlightning_installed() -> bool:
    """Return True if Python finds RLightning itself; imports nothing of it."""
    spec = importlib.util.find_spec(_ROOT)
    # A folder without __init__.py may be any folder of that name.
    return spec is not None and spec.origin is not None and spec.loader is not _finder


def make_importable() -> None:
    """Make ``import rlightning`` find the modules of `ALIASED`, unless RLightning is installed."""
    if _finder not in sys.meta_path and not is_rlightning_installed():
        sys.meta_path.insert(0, _finder)  # Before what finds such a folder.


def named(name: str) -> Any:
    """Return RLightning's own object of a name that a group needs, or ours."""
    make_importable()
    return getattr(importlib.import_module(f"{_ROOT}.{_HOMES[name]}"), name)
