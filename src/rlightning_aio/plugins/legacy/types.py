"""RLightning's values: results of envs, responses of policies, and batches of both.

Rule: names, fields, defaults and order are RLightning's; programs build these by position.
"""

from __future__ import annotations

import dataclasses
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Self

from rlightning_aio.plugins.legacy.tensors import to_device, to_numpy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import gymnasium as gym

__all__ = [
    "BatchedData",
    "EnvMeta",
    "EnvRet",
    "MultiAgentEnvRet",
    "MultiAgentPolicyResponse",
    "PolicyResponse",
    "Processed_EnvRet_fields",
]

Processed_EnvRet_fields = ("next_observation", "reward", "terminated", "truncated", "info")

_NOT_DATA = ("env_id", "_extra", "ts_env_sent_ns")


def _seconds_since(sent_ns: Any, now_ns: int | None) -> float:
    if not isinstance(sent_ns, int):
        return 0.0
    return max(0.0, ((time.time_ns() if now_ns is None else now_ns) - sent_ns) / 1e9)


@dataclasses.dataclass
class EnvRet:
    """The result of a reset or a step.

    Attributes:
        env_id: the id of the env.
        observation: the observation after the reset or step.
        last_reward, last_terminated, last_truncated: reward and end of the step.
        info: the env's info.
        _extra: free for extensions; `to_dict` includes its items.
        ts_env_sent_ns: the time when the env sent it, in ns since the epoch.
    """

    env_id: str
    observation: Any
    last_reward: Any = 0.0
    last_terminated: Any = False
    last_truncated: Any = False
    info: dict[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    _extra: dict[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    ts_env_sent_ns: int = dataclasses.field(default_factory=time.time_ns)

    @classmethod
    def fields(cls) -> tuple[str, ...]:
        """Return the names of its data fields: all but id, extras and time."""
        return tuple(f.name for f in dataclasses.fields(cls) if f.name not in _NOT_DATA)

    @classmethod
    def get_defaults(cls) -> dict[str, Any]:
        """Return the defaults of those `fields` that have a plain one."""
        return {
            f.name: f.default
            for f in dataclasses.fields(cls)
            if f.name in cls.fields() and f.default is not dataclasses.MISSING
        }

    def mark_env_sent(self) -> Self:
        """Record the present time as the time of sending."""
        self.ts_env_sent_ns = time.time_ns()
        return self

    def compute_sent_latency(self, now_ns: int | None = None) -> float:
        """Return the seconds since it was sent, or 0.0 if that is unknown."""
        return _seconds_since(self.ts_env_sent_ns, now_ns)

    def to_dict(self) -> dict[str, Any]:
        """Return the data fields together with the items of ``_extra``.

        Raises:
            KeyError: an item of ``_extra`` has the name of a field.
        """
        result = {name: getattr(self, name) for name in self.fields()}
        for name, value in self._extra.items():
            if name in result:
                raise KeyError(f"{name!r} is both in _extra and the name of a field")
            result[name] = value
        return result

    def cpu(self) -> Self:
        """Return a copy with arrays and tensors as CPU tensors; without torch, as arrays."""
        return self._converted(lambda value: to_device(value, "cpu"))

    def cuda(self, device: int | str | None = None) -> Self:
        """Return a copy with arrays and tensors as tensors on a CUDA device."""
        return self._converted(lambda value: to_device(value, "cuda" if device is None else device))

    def numpy(self) -> Self:
        """Return a copy with tensors as arrays."""
        return self._converted(to_numpy)

    def _converted(self, convert: Callable[[Any], Any]) -> Self:
        names = (*self.fields(), "_extra")
        return dataclasses.replace(self, **{name: convert(getattr(self, name)) for name in names})

    def __hash__(self) -> int:
        return hash(self.env_id)


@dataclasses.dataclass
class MultiAgentEnvRet(EnvRet):
    """The result of a multi-agent env: rewards and ends are dicts by agent."""

    __hash__ = EnvRet.__hash__


class PolicyResponse(SimpleNamespace):
    """A policy's response for one env: any attributes, usually with an ``action``."""

    env_id: str

    def __init__(self, env_id: str, **data: Any) -> None:
        super().__init__(**data)
        self.env_id = env_id

    @property
    def _fields(self) -> set[str]:
        return set(vars(self)) - {"env_id", "ts_policy_sent_ns"}

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes that the policy attached."""
        return {name: getattr(self, name) for name in self._fields}

    def cpu(self) -> Self:
        """Convert arrays and tensors to CPU tensors; without torch, keep arrays."""
        return self._convert(lambda value: to_device(value, "cpu"))

    def cuda(self, device: int | str | None = None) -> Self:
        """Convert arrays and tensors to tensors on a CUDA device."""
        return self._convert(lambda value: to_device(value, "cuda" if device is None else device))

    def numpy(self) -> Self:
        """Convert tensors to arrays."""
        return self._convert(to_numpy)

    def _convert(self, convert: Callable[[Any], Any]) -> Self:
        for name in self._fields:
            setattr(self, name, convert(getattr(self, name)))
        return self

    def mark_policy_sent(self) -> Self:
        """Record the present time as the time of sending."""
        self.ts_policy_sent_ns = time.time_ns()
        return self

    def compute_sent_latency(self, now_ns: int | None = None) -> float:
        """Return the seconds since it was sent, or 0.0 if that is unknown."""
        return _seconds_since(getattr(self, "ts_policy_sent_ns", None), now_ns)

    def __reduce__(self) -> Any:
        return type(self).__new__, (type(self),), vars(self)

    @staticmethod
    def make_example(
        action_space: gym.Space[Any], env_id: str | None = None, **data: Any
    ) -> PolicyResponse:
        """Return a response with a random action."""
        return PolicyResponse(env_id or "", action=action_space.sample(), **data)


class MultiAgentPolicyResponse(PolicyResponse):
    """A policy's response for a multi-agent env: ``action`` is a dict by agent."""

    @staticmethod
    def make_example(  # pyright: ignore[reportIncompatibleMethodOverride]  # As RLightning's.
        action_spaces: Mapping[str, gym.Space[Any]], env_id: str | None = None, **data: Any
    ) -> MultiAgentPolicyResponse:
        """Return a response with a random action for each agent."""
        action = {agent: space.sample() for agent, space in action_spaces.items()}
        return MultiAgentPolicyResponse(env_id or "", action=action, **data)


class BatchedData:
    """Ids with a value for each, in order; an id may occur more than once.

    Attributes:
        is_future: always False, because no value is a Ray reference.
    """

    is_future = False

    def __init__(self, ids: Sequence[Any], data: Sequence[Any]) -> None:
        if len(ids) != len(data):
            raise ValueError(f"{len(ids)} ids for {len(data)} values")
        self._ids = tuple(ids)
        self._data = tuple(data)

    def ids(self) -> tuple[Any, ...]:
        """Return the ids, in order."""
        return self._ids

    def values(self) -> tuple[Any, ...]:
        """Return the values, in order."""
        return self._data

    def items(self) -> Iterator[tuple[Any, Any]]:
        """Return an iterator over pairs of id and value, in order."""
        return zip(self._ids, self._data, strict=True)

    def __iter__(self) -> Iterator[tuple[Any, Any]]:
        return self.items()

    def __len__(self) -> int:
        return len(self._ids)

    def __getitem__(self, id_: Any) -> Any:
        """Return the value of `id_`: the first one, if it occurs more than once.

        Raises:
            ValueError: the batch has no such id.
        """
        return self._data[self._ids.index(id_)]

    @staticmethod
    def from_dict(data_dict: Mapping[Any, Any]) -> BatchedData:
        """Return a batch of the mapping's items, in its order."""
        return BatchedData(list(data_dict), list(data_dict.values()))


@dataclasses.dataclass
class EnvMeta:
    """The metadata of an env."""

    env_id: str | None = None
    action_space: gym.Space[Any] | None = None
    observation_space: gym.Space[Any] | None = None
    num_envs: int | None = None

    @property
    def _fields(self) -> tuple[str, ...]:
        return tuple(f.name for f in dataclasses.fields(self))
