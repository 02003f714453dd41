"""What does a film cost the envs that aren't filmed (`group.record_video`)?

In addition to the envs whose steps are counted there is another one, in its own worker, whose every
episode is filmed, or not. Ready envs are collected and stepped again. Envs that wait, for example
for a GPU or a robot, leave the cores to the film; envs that compute share the cores with it, and
with its ffmpeg.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
from harness import Contender, Question, Target, main, throughput
from uneven_pole import UNEVEN

NUM_ENVS = 8
RATE = 0.97


@dataclass
class Beside(Contender):
    """`NUM_ENVS` envs of a task and another one, and the steps of the former per second.

    Attributes:
        share: number of them in one worker.
        filmed: the other one is filmed.
    """

    name: str
    task: str
    share: int
    filmed: bool

    @property
    def requires(self) -> tuple[str, ...]:
        """Return the packages for filming; rendering is the same in either case."""
        return ("rlightning_aio", "imageio_ffmpeg", "pygame")

    def setup(self) -> None:
        """Build the envs and send them their first steps."""
        from rlightning_aio import sync

        self._stack = ExitStack()
        folder = self._stack.enter_context(tempfile.TemporaryDirectory())
        entry = {"backend": "gymnasium", "task": self.task}
        others = {"name": "others", "num_workers": NUM_ENVS, "envs_per_process": self.share}
        extra: dict[str, Any] = {"name": "extra", "env_kwargs": {"render_mode": "rgb_array"}}
        group = sync.build_env_group([{**entry, **others}, {**entry, **extra}])
        self._group = self._stack.enter_context(group)
        if self.filmed:
            group.record_video(folder, ["extra-0"])
        self._batch, _ = group.reset(seed=0)
        self._stack.enter_context(group.auto_reset(max_episode_steps=200))
        self._actions = np.random.default_rng(0).integers(2, size=NUM_ENVS + 1)

    def step(self) -> int:
        """Step the ready envs again; return the number of counted ones."""
        action = self._actions[: len(self._batch)]
        self._group.step_async(self._batch.respond(action=action))
        self._batch, _ = self._group.collect_async(min_results=1)
        return int(np.count_nonzero(self._batch.index < NUM_ENVS))

    def round(self, seconds: float) -> float:
        """Return the counted steps per second."""
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        """Close the envs, which ends a film in progress."""
        self._stack.close()


def _pair(name: str, task: str, share: int) -> tuple[Contender, Contender]:
    return (
        Beside(name, task, share, filmed=False),
        Beside(f"{name}, beside a film", task, share, filmed=True),
    )


WAITING = _pair("8 envs that wait", UNEVEN, 1)
COMPUTING = _pair("8 envs that compute", "CartPole-v1", NUM_ENVS)
QUESTION = Question(
    name="filming",
    title="Env steps of those that aren't filmed",
    unit="env steps/s",
    contenders=[*WAITING, *COMPUTING],
    targets=[Target(WAITING[1].name, WAITING[0].name, RATE)],
    rounds=11,
    seconds=1.5,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
