"""Runs RLightning's envs in our workers and sends their results back.

Rule: a program gets exactly what its env returned, and an env what the program sent: both are
plain Python values to us, and pickled.
"""

from __future__ import annotations

import copy
import dataclasses
import re
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio import Anything, BaseEnv, EnvConfig, EnvRet
from rlightning_aio.plugins.legacy.names import names_in_use
from rlightning_aio.plugins.legacy.tensors import on_cpu
from rlightning_aio.trees import holds_tensor

if TYPE_CHECKING:
    from rlightning_aio import PolicyResponse

__all__ = ["ARGUMENTS", "EnvMaker", "HostedEnv", "off_device"]

ARGUMENTS: Final = "rlightning"
"""Key in a reset's options for the arguments of RLightning's `reset`."""

_MADE_ID: Final = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}-")


class _Finder:
    """Makes ``import rlightning`` work where it is unpickled."""

    def __reduce__(self) -> Any:
        return names_in_use, ()


@dataclasses.dataclass
class EnvMaker:
    """Makes an env of RLightning's.

    Attributes:
        kind: the env's class.
        config: the entry, an `EnvConfig` of RLightning's.
        worker_index: the env's position in its group.
        preprocess_fn: the preprocess function, or None.
        env_id: the id that `BaseEnv` made, to be kept after a restart.
        computes: its steps are known to keep a core busy.
    """

    kind: Any
    config: Any
    worker_index: int
    preprocess_fn: Any
    env_id: str
    computes: bool = False

    def __call__(self) -> HostedEnv:
        """Make the env and wrap it as one of ours."""
        env = self.kind(
            self.config, worker_index=self.worker_index, preprocess_fn=self.preprocess_fn
        )
        if _MADE_ID.match(str(env.env_id)):
            env.env_id = self.env_id
        return HostedEnv(env)

    def __reduce__(self) -> Any:
        # The first argument is unpickled first, and the others may need RLightning's names.
        values = tuple(getattr(self, field.name) for field in dataclasses.fields(self))
        return _unpickled, (_Finder(), *values)


def _unpickled(_names: Any, *values: Any) -> EnvMaker:
    return EnvMaker(*values)


class HostedEnv(BaseEnv):
    """An env of RLightning's as one of ours.

    Its observations are RLightning's whole results, its actions RLightning's whole responses.
    """

    transforms_actions = True

    def __init__(self, env: Any) -> None:
        super().__init__(EnvConfig(name="rlightning", backend="callable"))
        self.env = env

    def get_observation_space(self) -> Anything:
        return Anything()

    def get_action_space(self) -> Anything:
        return Anything()

    # -- steps

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        del seed  # `options` contains all of RLightning's arguments.
        args, kwargs = (options or {}).get(ARGUMENTS, ((), {}))
        return EnvRet(env_id=self.env_id, observation=self.env._reset(*args, **kwargs))  # noqa: SLF001

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        return EnvRet(env_id=self.env_id, observation=self.env._step(policy_resp.action))  # noqa: SLF001

    # -- other calls

    def look(self, name: str) -> tuple[bool, Any]:
        """Return (True, None) if RLightning's env has a method `name`, else (False, its value)."""
        value = getattr(self.env, name)
        return (True, None) if callable(value) else (False, value)

    def of_env(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Call method `name` of RLightning's env and return its value."""
        return getattr(self.env, name)(*args, **kwargs)

    def close(self) -> None:
        self.env.close()


def off_device(response: Any) -> Any:
    """Return `response`, or a copy of it with its tensors on the CPU."""
    data: dict[str, Any] = response.__dict__
    if not holds_tensor(data):
        return response
    moved = copy.copy(response)
    for name, value in data.items():
        setattr(moved, name, on_cpu(value))
    return moved
