"""`Clock`: measures the times of a rollout (`Rollout.seconds`)."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData

__all__ = ["Clock"]


class Clock:
    """Sums times in nanoseconds of the monotonic clock."""

    def __init__(self) -> None:
        self._began = 0
        # When `collect` last returned, and when it was called after that.
        self._left = 0
        self._entered = 0
        # True if results may have been ready before that call.
        self._awaited = False
        self._start()

    def _start(self) -> None:
        self._collecting = self._policy = self._busy = 0
        self._for_learner = self._for_policy = 0

    def enter(self) -> None:
        """Record that `collect` was called."""
        self._entered = time.monotonic_ns()
        self._awaited = True
        if not self._began:
            self._began = self._left = self._entered

    def leave(self) -> None:
        """Record that `collect` returns or raises."""
        self._left = time.monotonic_ns()
        self._collecting += self._left - self._entered

    def note_policy(self, duration_ns: int) -> None:
        """Record the duration of a call of the policy."""
        self._policy += duration_ns

    def note_answered(self, batch: BatchedData) -> None:
        """Record that the envs of `batch` have just been sent their next request."""
        now = time.monotonic_ns()
        ready = batch.ready_ns
        waited = now * len(ready) - int(np.add.reduce(ready))
        learner = 0
        if self._awaited:
            # `collect` returned at most once since a result was ready.
            outside = self._entered - np.maximum(ready, self._left)
            learner = int(np.add.reduce(outside[outside > 0]))
            self._awaited = learner > 0
        self._for_learner += learner
        self._for_policy += waited - learner
        self._busy += int(np.add.reduce(batch.busy_ns))

    def seconds(self) -> dict[str, float]:
        """Return the sums since the last call. Call this right before `collect` returns."""
        now = time.monotonic_ns()
        found = {
            "elapsed": (now - self._began) / 1e9,
            "collecting": (self._collecting + now - self._entered) / 1e9,
            "policy": self._policy / 1e9,
            "env_busy": self._busy / 1e9,
            "waited_for_policy": self._for_policy / 1e9,
            "waited_for_learner": self._for_learner / 1e9,
        }
        self._began = now
        self._start()
        # Compensates for the time before `now`, which `leave` will add.
        self._collecting = -(now - self._entered)
        return found
