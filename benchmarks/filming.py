"""What does a film cost the envs that aren't filmed (`video` of an entry)?

Beside the envs whose steps are counted there is one more, in a worker of its own, whose every
episode is filmed, or not. Whoever is ready is collected and stepped again. Envs that wait, as
those do whose simulator runs on a GPU or whose arm moves, leave the cores to the film; those that
compute share the cores with it, and with its ffmpeg.
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
    """`NUM_ENVS` envs of a task beside one more, and the steps of these per second.

    Attributes:
        share: how many of them have a worker together.
        filmed: the one more is.
    """

    name: str
    task: str
    share: int
    filmed: bool

    @property
    def requires(self) -> tuple[str, ...]:
        """Filming's own; rendering is the same either way."""
        return ("rlightning_aio", "imageio_ffmpeg", "pygame")

    def setup(self) -> None:
        """Build the envs, and send them their first steps."""
        from rlightning_aio import sync

        self._stack = ExitStack()
        folder = self._stack.enter_context(tempfile.TemporaryDirectory())
        entry = {"backend": "gymnasium", "task": self.task}
        others = {"name": "others", "num_workers": NUM_ENVS, "envs_per_process": self.share}
        extra: dict[str, Any] = {"name": "extra", "env_kwargs": {"render_mode": "rgb_array"}}
        if self.filmed:
            extra["video"] = {"folder": folder}
        group = sync.build_env_group([{**entry, **others}, {**entry, **extra}])
        self._group = self._stack.enter_context(group)
        self._batch, _ = group.reset(seed=0)
        self._stack.enter_context(group.auto_reset(max_episode_steps=200))
        self._actions = np.random.default_rng(0).integers(2, size=NUM_ENVS + 1)

    def step(self) -> int:
        """Answer whoever was ready; how many of the others are then."""
        action = self._actions[: len(self._batch)]
        self._group.step_async(self._batch.respond(action=action))
        self._batch, _ = self._group.collect_async(min_results=1)
        return int(np.count_nonzero(self._batch.index < NUM_ENVS))

    def round(self, seconds: float) -> float:
        """Their steps per second."""
        return throughput(self.step, seconds)

    def teardown(self) -> None:
        """Close the envs; a film under way ends."""
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
