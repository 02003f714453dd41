"""Facts that figures depend on, besides the config: versions, the processor, its cores."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import TYPE_CHECKING, Any

import rlightning_aio
from rlightning_aio.cli.processes import cpu_model
from rlightning_aio.registry import ENVS
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rlightning_aio.config import EnvConfig

__all__ = ["surroundings"]


def surroundings(configs: Iterable[EnvConfig]) -> dict[str, Any]:
    """Return the cores, the processor, and the versions of Python and of the simulators."""
    versions = {"rlightning_aio": rlightning_aio.__version__, "python": platform.python_version()}
    for name in ("numpy", "gymnasium"):
        versions[name] = importlib.metadata.version(name)
    for config in configs:
        backend = ENVS.described(config.backend)
        version = None if backend is None else backend.installed_version()
        if backend is not None and version is not None:
            versions[backend.module] = version
    return {"cores": num_cores(), "cpu": cpu_model(), "versions": versions}
