"""Runs programs that were written for RLightning; users import it as `rlightning_aio.legacy`.

Where RLightning is not installed, this package provides its names for envs and groups. Where it is
installed, its own builder makes our groups, which return its own `EnvRet` and `BatchedData`.
docs/rlightning.md lists the differences from rlightning_aio's own interface, which new programs
should use.

Rule: every difference in RLightning's behaviour is handled in this package and in no other.
"""

from __future__ import annotations

import importlib

from rlightning_aio.plugins.legacy.names import is_rlightning_installed, make_importable

__all__ = ["install"]


def install() -> None:
    """Make ``import rlightning`` use groups of rlightning_aio, in this process and in workers.

    Call it before anything imports names from RLightning: names that were imported earlier keep
    their old values. Idempotent.
    """
    make_importable()
    if not is_rlightning_installed():
        return
    replaced = {
        "group": ("EnvGroup", ("env", "env.env_group", "utils.builders")),
        "remote": ("RemoteEnvClient", ("env.remote_env.env_client",)),
    }
    for module, (name, homes) in replaced.items():
        ours = getattr(importlib.import_module(f"rlightning_aio.plugins.legacy.{module}"), name)
        for home in homes:
            setattr(importlib.import_module(f"rlightning.{home}"), name, ours)
