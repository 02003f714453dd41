"""PufferLib's multiprocessing backend as a contender.

Rule: as in `contenders`; a reset replaces the step after the end of an episode. Its wrapper for
statistics keeps infos until an episode ends, as PufferLib's own recipes do; without it each step's
are pickled.
"""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from typing import Any

from contenders import Stepped, Work, sampled


@dataclass(frozen=True)
class Emulated:
    """Makes one env of `work`, as PufferLib has it."""

    work: Work

    def __call__(self, buf: Any = None, seed: int = 0) -> Any:
        from pufferlib.emulation import GymnasiumPufferEnv
        from pufferlib.pufferlib import EpisodeStats

        return GymnasiumPufferEnv(env=EpisodeStats(self.work.make()), buf=buf, seed=seed)


@dataclass
class PufferLib(Stepped):
    """`pufferlib.vector.Multiprocessing`: workers that spin, as many as there are cores.

    Attributes:
        batch_size: results it hands out at a time; all envs if None.
        num_workers: processes; one for each core if None.
    """

    batch_size: int | None = None
    num_workers: int | None = None

    package = "pufferlib"

    def setup(self) -> None:
        from pufferlib import vector

        self._envs = vector.make(
            Emulated(self.work),
            backend=vector.Multiprocessing,
            num_envs=self.work.num_envs,
            num_workers=self.num_workers or len(os.sched_getaffinity(0)),
            batch_size=self.batch_size or self.work.num_envs,
            overwork=True,  # It refuses more workers than physical cores.
            zero_copy=False,  # Results of the first ready workers.
            sync_traj=False,
        )
        single = self.work.make()
        self._actions = sampled(single.action_space, self.work.num_envs)
        single.close()
        self._envs.async_reset(0)

    def step(self) -> int:
        _, rewards, *_ = self._envs.recv()
        self._envs.send(next(self._actions)[: len(rewards)])
        return len(rewards)

    def round(self, seconds: float) -> float:
        # Its workers spin for another half second, at the expense of the next contender.
        self._signal(signal.SIGCONT)
        try:
            return super().round(seconds)
        finally:
            self._signal(signal.SIGSTOP)

    def _signal(self, number: int) -> None:
        for process in self._envs.processes:
            os.kill(process.pid, number)

    def teardown(self) -> None:
        super().teardown()
        if self._envs is not None:
            self._signal(signal.SIGCONT)
            for process in self._envs.processes:
                process.join()
