"""`Renewal`: decides in a worker when it is to be replaced (`EnvConfig.recycle`).

It looks before each reset, as the env is between two episodes then. A worker that is due doesn't
execute the reset: it gives the env's seed, options and generators back, for the next worker.
Left out: what the group does then (see `supervision.renewals`).
"""

from __future__ import annotations

import math
import os
from collections import deque
from typing import TYPE_CHECKING, Final

from rlightning_aio._core.hosts.completion_frames import SENDER
from rlightning_aio._core.hosts.memory import resident_mb
from rlightning_aio._core.hosts.messages import Due, Moved
from rlightning_aio._core.hosts.running.runner import loaded
from rlightning_aio.protocol.entries import Operation, op_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from rlightning_aio._core.hosts.messages import Completion, StartOrder
    from rlightning_aio._core.hosts.running.runner import EnvRunner

__all__ = ["Renewal"]

_AHEAD: Final = 0.8
"""The part of its time after which the next worker is started, so that it is ready at the end."""


class Renewal:
    """See the module.

    Args:
        order: of the worker.
        post: sends a completion.
    """

    def __init__(self, order: StartOrder, post: Callable[[Completion], None]) -> None:
        self._most_episodes = order.config.recycle.get("episodes", math.inf)
        self._most_mb = order.config.recycle.get("memory_mb", math.inf)
        self._post = post
        self._is_asked_for = bool(order.config.recycle)
        self._num_envs = len(order.worker_indices)
        self._begun = 0
        self._is_told = self._is_due = False
        # The last measurements: during about one episode of each env.
        self._measured = deque[float](maxlen=self._num_envs + 1)

    def passed_on(self, runner: EnvRunner, request: int, arguments: Any) -> Moved | None:
        """Return what a reset becomes if the worker is due; None if it is to be executed.

        Args:
            runner: of the env.
            request: its entry; of any operation.
            arguments: as of `EnvRunner.execute`.
        """
        if not self._is_asked_for or op_of(request) != Operation.RESET:
            return None
        given = loaded(arguments)
        is_sent_back = given is not None and len(given) > 2
        if given is not None and given[1] and "reset_mask" in given[1]:
            return None  # Some of its sub-environments go on.
        self._look()
        if self._is_due and not is_sent_back:
            return Moved(SENDER, request, runner.handed_on(given), resident_mb(os.getpid()))
        self._begun += 1
        return None

    def _look(self) -> None:
        """Note whether the worker is due, and tell the trainer ahead of that."""
        resident = growth = 0.0
        if self._most_mb < math.inf and self._begun >= self._num_envs:  # Each has begun one.
            resident = resident_mb(os.getpid())
            self._measured.append(resident)
            if len(self._measured) > self._num_envs:
                growth = max(resident - self._measured[0], 0.0)
        self._is_due |= self._begun >= self._most_episodes or resident + growth > self._most_mb
        is_near = self._begun + 1 >= _AHEAD * self._most_episodes
        is_near |= resident + growth >= _AHEAD * self._most_mb
        if not self._is_told and (is_near or self._is_due):
            self._is_told = True
            self._post(Due(SENDER, resident or resident_mb(os.getpid())))
