"""Chooses the names that a program uses: RLightning's own if it is installed, or ours.

Rule: no other module of this package asks if RLightning is installed.
"""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from rlightning_aio.plugins.legacy.finder import ALIASED, install_finder, is_ours

__all__ = ["Names", "is_rlightning_installed", "names_in_use"]

_ROOT: Final = "rlightning"


@dataclass(frozen=True)
class Names:
    """The names of RLightning that a group needs.

    Attributes:
        EnvRet, PolicyResponse, BatchedData, EnvConfig: classes.
        ENVS: the registry of envs.
        default_env_preprocess_fn: the default preprocess function.
        own: True if these are RLightning's own.
    """

    EnvRet: Any
    PolicyResponse: Any
    BatchedData: Any
    EnvConfig: Any
    ENVS: Any
    default_env_preprocess_fn: Any
    own: bool


def is_rlightning_installed() -> bool:
    """Return True if Python finds RLightning itself; imports nothing of it."""
    loaded = sys.modules.get(_ROOT)
    if loaded is not None:
        return not is_ours(loaded.__spec__)
    for finder in sys.meta_path:
        find = getattr(finder, "find_spec", None)
        spec = None if find is None else find(_ROOT, None)
        # A folder without __init__.py may be any folder of that name.
        if spec is not None and spec.loader is not None and spec.origin is not None:
            return not is_ours(spec)
    return False


@cache
def names_in_use() -> Names:
    """Return RLightning's names; from then on, ``import rlightning`` finds them."""
    own = is_rlightning_installed()
    if not own:
        install_finder()
    homes: dict[str, str] = dict.fromkeys(
        ("EnvRet", "PolicyResponse", "BatchedData"), f"{_ROOT}.types"
    )
    homes["EnvConfig"] = f"{_ROOT}.utils.config"
    homes["ENVS"] = f"{_ROOT}.utils.registry"
    homes["default_env_preprocess_fn"] = f"{_ROOT}.env.utils.utils"
    assert own or all(home in ALIASED for home in homes.values())
    found = {name: getattr(importlib.import_module(home), name) for name, home in homes.items()}
    return Names(**found, own=own)
