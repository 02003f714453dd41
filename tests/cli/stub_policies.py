"""Policies that tests name on the command line."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

not_callable = 3


def respond(batch: Any) -> Any:
    """Attach a column to the actions."""
    return batch.respond(action=[1] * len(batch), value=[0.5] * len(batch))


def too_few(batch: Any) -> list[int]:
    """Return an action too few."""
    return [0] * (len(batch) - 1)


def broken(batch: Any) -> list[int]:
    """Raise an exception."""
    raise LookupError("no such weights")


class Leftward:
    """A model that always pushes to the left."""

    def predict(
        self, observation: Any, state: Any, episode_start: Any, deterministic: bool
    ) -> tuple[Any, None]:
        assert deterministic
        return np.zeros(len(observation), np.int64), None


model = Leftward()
by_entry = {"pole": model}


calls_left = math.inf


def breaks_soon(batch: Any) -> list[int]:
    """Act for as many calls as a test lets it."""
    global calls_left  # noqa: PLW0603
    calls_left -= 1
    if calls_left < 0:
        raise LookupError("as asked for")
    return [0] * len(batch)


print("policies that print when they are imported")  # noqa: T201
