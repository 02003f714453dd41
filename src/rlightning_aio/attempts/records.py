"""`Attempt` and `AttemptGroup`: what became of an episode, and of all attempts at a task.

`success_of` reads from an info how far an episode has succeeded.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, cast, overload

import numpy as np

from rlightning_aio.attempts.spec import EpisodeSpec, plain, spec_of
from rlightning_aio.json_text import finite
from rlightning_aio.outcomes import Outcome

if TYPE_CHECKING:
    from collections.abc import Mapping

_KEYS: Final = ("success", "is_success")
"""In an info: Gymnasium's robotics and ManiSkill's name, and Stable-Baselines3's."""


@dataclass(slots=True)
class Attempt:
    """One attempt at a task, after its last try; or an episode of `evaluate`.

    Attributes:
        spec: the task.
        index: among the attempts at the task, from 0; of a number of episodes for each env, that of
            the episode.
        outcome: how it ended.
        reward: the undiscounted return, summed over agents; None if it has failed.
        length: number of steps.
        success_value: ``success`` or ``is_success`` of the last info as a number; NaN if that is
            no finite one; None if it has neither, or if the attempt has failed.
        sub_env: index of the sub-environment that played it; 0 if the env has only one.
        rewards: of each step, in order; empty if a policy played several envs at once.
        columns: what the agent gave to `step` with each action, and ``action`` itself: lists with
            an element for each step, None where a step had no such column.
        first, last: copies of the observations after the reset and after the newest step; None
            without, and if a policy played several envs at once. If `zero_copy` views are in use,
            an attempt that was cut during a step may have the observation of that step as its last
            one.
        result: what the agent returned.
        failures: outcomes of earlier tries, in order.
    """

    spec: EpisodeSpec
    index: int
    outcome: Outcome
    reward: float | None = None
    length: int = 0
    success_value: float | None = None
    sub_env: int = 0
    rewards: list[float] = field(default_factory=list[float])
    columns: dict[str, list[Any]] = field(default_factory=dict[str, list[Any]])
    first: Any = None
    last: Any = None
    result: Any = None
    failures: tuple[Outcome, ...] = ()

    @property
    def env_id(self) -> str:
        """Id of the env that played it last; empty if none did."""
        return self.outcome.env_id

    @property
    def success(self) -> bool | None:
        """`success_value` is above 0.5; None if it is unknown or NaN."""
        value = self.success_value
        return None if value is None or math.isnan(value) else value > 0.5

    def to_json(self) -> dict[str, Any]:
        """Return the attempt as a row of JSON, without observations.

        Columns and a result that JSON can't hold are null, and so are numbers that are not finite;
        but a success of NaN is the text ``"nan"``.
        """
        success = self.success_value
        if success is not None and math.isnan(success):
            success = "nan"
        row = {
            **self.spec.to_json(),
            "index": self.index,
            "reward": self.reward,
            "length": self.length,
            # A verdict as such, a share as a number.
            "success": self.success if success in (0, 1) else success,
            "sub_env": self.sub_env,
            "rewards": self.rewards,
            "outcome": self.outcome.to_json(),
            "failures": [outcome.to_json() for outcome in self.failures],
            "columns": {name: _json_or_none(column) for name, column in self.columns.items()},
            "result": _json_or_none(self.result),
        }
        return finite(row)


def attempt_of(row: Mapping[str, Any]) -> Attempt:
    """Make an attempt from what `Attempt.to_json` returned.

    Raises:
        TypeError, ValueError, KeyError: it is not such a row.
    """
    fields = {**row}
    spec = spec_of(fields)
    outcome = Outcome.from_json(fields.pop("outcome"))
    failures = tuple(map(Outcome.from_json, fields.pop("failures")))
    success = fields.pop("success")
    value = None if success is None else float(success)
    return Attempt(spec, outcome=outcome, failures=failures, success_value=value, **fields)


def _json_or_none(value: Any) -> Any:
    try:
        return json.loads(json.dumps(value, default=plain, allow_nan=False))
    except (TypeError, ValueError):
        return None


@dataclass(slots=True)
class AttemptGroup(Sequence[Attempt]):
    """All attempts at one task, in the order of their indices.

    Attributes:
        spec: the task.
        attempts: all of them, failed and cancelled ones included.
        is_complete: as many have not failed as the rules ask for.
    """

    spec: EpisodeSpec
    attempts: list[Attempt]
    is_complete: bool

    @property
    def rewards(self) -> list[float]:
        """Rewards of the attempts that have one."""
        return [attempt.reward for attempt in self.attempts if attempt.reward is not None]

    @overload
    def __getitem__(self, index: int) -> Attempt: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Attempt]: ...

    def __getitem__(self, index: int | slice) -> Attempt | Sequence[Attempt]:
        """The attempt of an index."""
        return self.attempts[index]

    def __len__(self) -> int:
        """The number of attempts."""
        return len(self.attempts)


def success_of(info: dict[str, Any], sub_env: int = 0) -> float | None:
    """Read the success of an episode from its last info, or from the ``final_info`` in it.

    None if it says nothing, or something that is neither a bool nor a number; NaN for infinity.
    """
    final: Any = info.get("final_info")
    marked: Any = info.get("_final_info")
    if isinstance(final, dict) and (marked is None or marked[sub_env]):
        info = cast("dict[str, Any]", final)  # The rest is about the next episode.
    for key in _KEYS:
        given, known = info.get(key), info.get(f"_{key}")
        if given is not None and (known is None or known[sub_env]):
            # It may be a tensor on another device.
            array = np.asarray(given.tolist() if hasattr(given, "tolist") else given).reshape(-1)
            if array.size and array.dtype.kind in "biuf":
                value = float(array[sub_env if array.size > 1 else 0])
                return value if math.isfinite(value) else math.nan
    return None
