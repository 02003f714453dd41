"""RLightning's values: results of envs, responses of policies, and batches of both.

Rule: names, fields, defaults and order are RLightning's; programs build these by position.
"""

from __future__ import annotations

import dataclasses
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import gymnasium as gym


@dataclasses.dataclass
class EnvRet:
    """The result of a reset or a step.

    Attributes:
        env_id: the id of the env.
        observation: the observation after the reset or step.
        last_reward, last_terminated, last_truncated: reward and end of the step.
        info: the env's info.
        _extra: free for extensions.
        ts_env_sent_ns: the time when the env made it, in ns since the epoch.
    """

    env_id: str
    observation: Any
    last_reward: Any = 0.0
    last_terminated: Any = False
    last_truncated: Any = False
    info: dict[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    _extra: dict[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    ts_env_sent_ns: int = dataclasses.field(default_factory=time.time_ns)


class PolicyResponse(SimpleNamespace):
    """A policy's response for one env: any attributes, usually with an ``action``."""

    env_id: str

    def __init__(self, env_id: str, **data: Any) -> None:
        super().__init__(**data)
        self.env_id = env_id

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes that the policy attached."""
        return {name: value for name, value in vars(self).items() if name != "env_id"}

    def __reduce__(self) -> Any:
        return type(self).__new__, (type(self),), vars(self)


class BatchedData:
    """Ids with a value for each, in order; an id may occur more than once."""

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
        """Return pairs of id and value."""
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


@dataclasses.dataclass
class EnvMeta:
    """The metadata of an env."""

    env_id: str | None = None
    action_space: gym.Space[Any] | None = None
    observation_space: gym.Space[Any] | None = None
    num_envs: int | None = None
