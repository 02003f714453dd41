"""Runs programs that were written for RLightning; users import it as `rlightning_aio.legacy`.

Where RLightning is not installed, this
package provides its names for envs and groups. Where it is installed, its own builder makes our
groups, which return its own `EnvRet` and `BatchedData`. docs/rlightning.md lists the differences
from rlightning_aio's own interface, which new programs should use.

Rule: every difference in RLightning's behaviour is handled in this package and in no other.
"""

from __future__ import annotations

import importlib

from rlightning_aio.plugins.legacy.names import names_in_use

__all__ = ["install"]


def install() -> None:
    """Make ``import rlightning`` use groups of rlightning_aio, in this process and in workers.

    Call it before anything imports names from RLightning: names that were imported earlier keep
    their old values. Idempotent.
    """
    if not names_in_use().own:
        return
    group = importlib.import_module("rlightning_aio.plugins.legacy.group").EnvGroup
    remote = importlib.import_module("rlightning_aio.plugins.legacy.remote")
    replaced = {
        "EnvGroup": (group, ("env", "env.env_group", "utils.builders")),
        "RemoteEnvClient": (remote.RemoteEnvClient, ("env.remote_env.env_client",)),
    }
    for name, (ours, homes) in replaced.items():
        for home in homes:
            setattr(importlib.import_module(f"rlightning.{home}"), name, ours)
