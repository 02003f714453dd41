"""Programs written for RLightning, on this runtime.

``python -m rlightning_aio.legacy script.py …`` runs a script; `install` does the same for a
program that calls it before it imports ``rlightning``. Where RLightning is not installed, its names
for envs and groups are found here; where it is, its own builder makes groups of ours, and they hand
out its own `EnvRet` and `BatchedData`. docs/rlightning.md says what differs from rlightning_aio's
own interface, which is what new programs should use.

Rule: whatever RLightning does another way is settled in this package, and nowhere else.
"""

from __future__ import annotations

import importlib

from rlightning_aio.legacy.names import names_in_use

__all__ = ["install"]


def install() -> None:
    """Have ``import rlightning`` bring groups of rlightning_aio, in this process and in workers.

    Call it before anything imports names from RLightning: what was imported before stays as it
    was. Idempotent.
    """
    if not names_in_use().own:
        return
    group = importlib.import_module("rlightning_aio.legacy.group").EnvGroup
    remote = importlib.import_module("rlightning_aio.legacy.remote")
    replaced = {
        "EnvGroup": (group, ("env", "env.env_group", "utils.builders")),
        "RemoteEnvClient": (remote.RemoteEnvClient, ("env.remote_env.env_client",)),
    }
    for name, (ours, homes) in replaced.items():
        for home in homes:
            setattr(importlib.import_module(f"rlightning.{home}"), name, ours)
