"""Runs RLightning's envs in our workers and sends their results back.

Rule: a program gets exactly what its env returned. A result travels in its row if the row can hold
all of it, and is pickled otherwise.
"""

from __future__ import annotations

import copy
import dataclasses
import pickle
import re
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import create_empty_array

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.envs.fast_path import BareReset, BareStep, FastPath
from rlightning_aio.envs.tensors import as_numpy, holds_tensor
from rlightning_aio.legacy.names import names_in_use
from rlightning_aio.legacy.tensors import on_cpu
from rlightning_aio.protocol.columns import index, leaves
from rlightning_aio.protocol.pickling import dumped_with_code
from rlightning_aio.types import EnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.legacy.names import Names
    from rlightning_aio.protocol.columns import Leaf

__all__ = ["ARGUMENTS", "ActionForm", "EnvMaker", "HostedEnv", "restored"]

ARGUMENTS: Final = "rlightning"
"""Key in a reset's options for the arguments of RLightning's `reset`."""
WHOLE: Final = "rlightning"
"""Key in a result's ``_extra`` for the pickled result."""

_MADE_ID: Final = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}-")
_ANYTHING: Final = gym.spaces.Text(1)
"""A space for any values, which travel pickled."""


@dataclasses.dataclass
class EnvMaker:
    """Makes an env of RLightning's. It travels to a worker as bytes, which are unpickled only once
    ``import rlightning`` works there.

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
        values = tuple(getattr(self, field.name) for field in dataclasses.fields(self))
        return _PackedMaker, (dumped_with_code(values),)


class _PackedMaker:
    """A pickled `EnvMaker`."""

    def __init__(self, packed: bytes) -> None:
        self._packed = packed

    def __call__(self) -> HostedEnv:
        names_in_use()
        return EnvMaker(*pickle.loads(self._packed))()


class HostedEnv(FastPath, BaseEnv):
    """An env of RLightning's as one of ours.

    Actions that fit the action space travel in the row. Any other is sent as a whole
    `PolicyResponse`.
    """

    transforms_actions = True

    def __init__(self, env: Any) -> None:
        super().__init__(EnvConfig(name="rlightning", backend="callable"))
        self.env = env
        self._names = names_in_use()
        self._observation_space = _space_of(env.get_observation_space)
        self._action_space = _space_of(env.get_action_space)
        self._leaves = leaves(self._observation_space)
        self._blank: Any = None
        if self._leaves is not None:
            self._blank = index(cast("Any", create_empty_array(self._observation_space, 1)), 0)

    def get_observation_space(self) -> gym.Space[Any]:
        return self._observation_space

    def get_action_space(self) -> gym.Space[Any]:
        return self._action_space

    # -- steps

    @property
    def _is_bare(self) -> bool:
        """Return True if a step calls Gymnasium's env without any code of the program."""
        names = self._names
        if names.own:
            return False
        from rlightning_aio.legacy import backends  # noqa: PLC0415  # It imports what we host.

        return (
            type(self.env) in (backends.MujocoEnv, backends.ALEEnv)
            and self.env._preprocess_fn is names.default_env_preprocess_fn
        )

    def bare_step(self) -> BareStep | None:
        if not self._is_bare:
            return None
        step, response = self.env.env.step, self._names.PolicyResponse

        def bare(action: Any) -> Any:
            return step(action.action if isinstance(action, response) else action)

        return bare

    def bare_reset(self) -> BareReset | None:
        return self.env.env.reset if self._is_bare else None

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        del seed  # `options` contains all of RLightning's arguments.
        args, kwargs = (options or {}).get(ARGUMENTS, ((), {}))
        return self._as_ours(self.env._reset(*args, **kwargs))  # noqa: SLF001

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        given = policy_resp.action
        if not isinstance(given, self._names.PolicyResponse):
            given = self._names.PolicyResponse(env_id=self.env.env_id, action=given)
        return self._as_ours(self.env._step(given))  # noqa: SLF001

    def _as_ours(self, ret: Any) -> EnvRet:
        if self._fits_row(ret):
            return EnvRet.model_construct(
                env_id=self.env_id,
                observation=ret.observation,
                last_reward=ret.last_reward,
                last_terminated=ret.last_terminated,
                last_truncated=ret.last_truncated,
                info=ret.info,
            )
        return EnvRet(env_id=self.env_id, observation=self._blank, _extra={WHOLE: ret})

    def _fits_row(self, ret: Any) -> bool:
        """Return True if the row can hold all of the result, with the same dtypes."""
        return (
            self._leaves is not None
            and type(ret) is self._names.EnvRet
            and not ret._extra
            and isinstance(ret.last_reward, float)
            and isinstance(ret.last_terminated, bool | np.bool_)
            and isinstance(ret.last_truncated, bool | np.bool_)
            and not holds_tensor(ret.info)
            and _parts_in_row(ret.observation, self._leaves)
        )

    # -- other calls

    def action_form(self) -> ActionForm:
        """Return the form in which responses are sent to this env."""
        return ActionForm(leaves(self._action_space), self._is_bare)

    def look(self, name: str) -> tuple[bool, Any]:
        """Return (True, None) if RLightning's env has a method `name`, else (False, its value)."""
        value = getattr(self.env, name)
        return (True, None) if callable(value) else (False, value)

    def of_env(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Call method `name` of RLightning's env and return its value."""
        return getattr(self.env, name)(*args, **kwargs)

    def close(self) -> None:
        self.env.close()


@dataclasses.dataclass(frozen=True)
class ActionForm:
    """The form in which responses are sent to an env.

    Attributes:
        leaves: the leaves of the action space; None if its values don't fit a row.
        action_only: the env uses nothing but the numbers of the action.
    """

    leaves: tuple[Leaf, ...] | None
    action_only: bool

    def of(self, response: Any, names: Names) -> Any:
        """Return `response` as an action of ours: an array that fits the row exactly, or else
        the response itself.
        """
        data: dict[str, Any] = response.__dict__
        action: Any = data.get("action")
        if self.action_only:
            action = np.asarray(as_numpy(action))
        elif type(response) is not names.PolicyResponse or data.keys() - {"env_id", "action"}:
            return _on_cpu(response)
        if self.leaves is not None and _parts_in_row(action, self.leaves):
            return action
        if self.action_only:
            return names.PolicyResponse(env_id=response.env_id, action=action)
        return _on_cpu(response)


def _on_cpu(response: Any) -> Any:
    """Return `response`, or a copy of it with its tensors on the CPU."""
    data: dict[str, Any] = response.__dict__
    if not holds_tensor(data):
        return response
    moved = copy.copy(response)
    for name, value in data.items():
        setattr(moved, name, on_cpu(value))
    return moved


def _space_of(read: Callable[[], Any]) -> gym.Space[Any]:
    """Return an env's space, or None if it does not have one yet."""
    try:
        space = read()
    except Exception:  # noqa: BLE001  # It may well make its simulator later, in `init`.
        return _ANYTHING
    return cast("gym.Space[Any]", space) if isinstance(space, gym.Space) else _ANYTHING


def _parts_in_row(value: Any, space_leaves: tuple[Leaf, ...]) -> bool:
    """Return True if `value` consists of arrays that fit a row of these leaves exactly."""
    arrays = list(_arrays(value))
    if len(arrays) != len(space_leaves):
        return False
    return all(
        type(array) is np.ndarray
        and (path, array.shape, array.dtype) == (leaf.path, leaf.shape, leaf.dtype)
        for (path, array), leaf in zip(arrays, space_leaves, strict=True)
    )


def _arrays(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Return the leaves of `value`, in the order of a space's leaves."""
    if type(value) is dict:
        parts = cast("dict[Any, Any]", value)
        for key in parts:
            yield from _arrays(parts[key], (*path, key))
    elif type(value) is tuple:
        for key, part in enumerate(cast("tuple[Any, ...]", value)):
            yield from _arrays(part, (*path, key))
    else:
        yield path, value


def restored(names: Names, part: ResultColumns, row: int, env_id: str) -> Any:
    """Return RLightning's result for one of ours that a worker or client has sent.

    Args:
        names: the names in use, with the class `EnvRet`.
        part: columns of our results.
        row: the position of the result in them.
        env_id: RLightning's id.
    """
    extra: dict[str, Any] = part.out_of_band_of(row).get("extra") or {}
    ret = extra.get(WHOLE)
    if ret is None:
        return names.EnvRet(
            env_id,
            part.observation_of(row),
            part.head_of(part.reward, row),
            part.head_of(part.terminated, row),
            part.head_of(part.truncated, row),
            part.reported_info_of(row),
            extra,
            part.sent_ns_of(row),
        )
    if part.restarted is not None and part.restarted[row] and dataclasses.is_dataclass(ret):
        info = {**cast("Any", ret).info, **part.reported_info_of(row)}
        return dataclasses.replace(cast("Any", ret), last_truncated=True, info=info)
    return ret
