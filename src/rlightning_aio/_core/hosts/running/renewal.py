"""`Renewal`: decides in a worker when it is to be replaced (`EnvConfig.recycle`).

It looks before each reset, as the env is between two episodes then. A worker that is due doesn't
execute the reset: it hands it on, with the env's generators, for the next worker.
Left out: what the group does then (see `supervision.renewals`). An env that is made again in the
same worker, as after an exception, is another matter (`EnvRunner.is_spent`).
"""

from __future__ import annotations

import math
import os
from collections import deque
from typing import TYPE_CHECKING, Final

from rlightning_aio._core.hosts.processes import resident_mb

if TYPE_CHECKING:
    from rlightning_aio.config import EnvConfig

_AHEAD: Final = 0.8
"""The part of its time after which the next worker is started, so that it is ready at the end."""


class HandedOn(Exception):
    """A reset is not executed here, but by the next worker, if there is one.

    Args:
        arguments: of the reset there, packed: seed, options, and the env's generators.
        is_due: this worker is due; else the next is only to be started.
        resident_mb: of this worker.
    """

    def __init__(self, arguments: bytes, *, is_due: bool, resident_mb: float) -> None:
        super().__init__()
        self.arguments = arguments
        self.is_due = is_due
        self.resident_mb = resident_mb


class Renewal:
    """See the module.

    Args:
        config: of the entry.
        num_envs: of the worker.
    """

    def __init__(self, config: EnvConfig, num_envs: int) -> None:
        self._most_episodes = config.recycle.get("episodes", math.inf)
        self._most_mb = config.recycle.get("memory_mb", math.inf)
        self._num_envs = num_envs
        self._begun = 0
        self._is_ahead = False
        # The last measurements: during about one episode of each env.
        self._measured = deque[float](maxlen=num_envs + 1)

    def begin(self) -> None:
        """Count an episode that begins here."""
        self._begun += 1

    def resident_mb(self) -> float:
        """Return the memory of the worker, as `is_due` has just measured it if it has to."""
        return self._measured[-1] if self._measured else resident_mb(os.getpid())

    def is_due(self) -> bool | None:
        """Return whether the worker is due before another episode; False once, some time ahead of
        that, and None if nothing needs to be done.
        """
        part = self._begun / self._most_episodes
        if self._most_mb < math.inf and self._begun >= self._num_envs:  # Each has begun one.
            resident, growth = resident_mb(os.getpid()), 0.0
            self._measured.append(resident)
            if len(self._measured) > self._num_envs:
                growth = max(resident - self._measured[0], 0.0)
            part = max(part, (resident + growth) / self._most_mb)
        if part >= 1:
            return True
        is_near = part >= _AHEAD or self._begun + 1 >= self._most_episodes
        if self._is_ahead or not is_near:
            return None
        self._is_ahead = True
        return False
