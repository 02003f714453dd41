"""`Clock`: where the time of a rollout goes; see `rollout.Seconds`."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from rlightning_aio.collecting.rollout import Seconds

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData

__all__ = ["Clock"]


class Clock:
    """Adds up what is asked for, in nanoseconds of the monotonic clock."""

    def __init__(self) -> None:
        self._began = 0
        # When `collect` was last left, and entered again after that.
        self._left = 0
        self._entered = 0
        # Whether results may have been ready before that.
        self._awaited = False
        self._start()

    def _start(self) -> None:
        self._collecting = self._policy = self._busy = 0
        self._for_learner = self._for_policy = 0

    def enter(self) -> None:
        """`collect` is called."""
        self._entered = time.monotonic_ns()
        self._awaited = True
        if not self._began:
            self._began = self._left = self._entered

    def leave(self) -> None:
        """`collect` ends, with a rollout or without."""
        self._left = time.monotonic_ns()
        self._collecting += self._left - self._entered

    def note_policy(self, seconds_ns: int) -> None:
        """A call of the policy took that long."""
        self._policy += seconds_ns

    def note_answered(self, batch: BatchedData) -> None:
        """The envs of `batch` were asked to go on just now."""
        now = time.monotonic_ns()
        ready = batch.ready_ns
        waited = now * len(ready) - int(ready.sum())
        learner = 0
        if self._awaited:
            # Since a result was ready, `collect` was left once at most.
            outside = self._entered - np.maximum(ready, self._left)
            learner = int(outside[outside > 0].sum())
            self._awaited = learner > 0
        self._for_learner += learner
        self._for_policy += waited - learner
        self._busy += int(batch.busy_ns.sum())

    def seconds(self) -> Seconds:
        """What was added up since the last call; `collect` is about to be left."""
        now = time.monotonic_ns()
        found = Seconds(
            elapsed=(now - self._began) / 1e9,
            collecting=(self._collecting + now - self._entered) / 1e9,
            policy=self._policy / 1e9,
            env_busy=self._busy / 1e9,
            waited_for_policy=self._for_policy / 1e9,
            waited_for_learner=self._for_learner / 1e9,
        )
        self._began = now
        self._start()
        # What `leave` adds for the time before `now`.
        self._collecting = -(now - self._entered)
        return found
