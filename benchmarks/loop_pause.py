"""The longest pause of an event loop with and without 256 Humanoids that step in its process.

A task that repeatedly sleeps for a millisecond measures how late it is called.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass

import numpy as np
from contenders import Work, group_config
from harness import Contender, Question, main

HUMANOIDS = Work("Humanoid-v5", 256, backend="mujoco", together=256, placement="inline")
SLEEP = 0.001


@dataclass
class Pause(Contender):
    """The longest pause, in ms.

    Attributes:
        steps: True if the Humanoids step.
    """

    name: str
    steps: bool

    requires = ("rlightning_aio",)

    def round(self, seconds: float) -> float:
        return asyncio.run(self.measure(seconds))

    async def measure(self, seconds: float) -> float:
        async with AsyncExitStack() as stack:
            stepping = None
            if self.steps:
                from rlightning_aio import build_env_group

                group = await stack.enter_async_context(
                    build_env_group(group_config(HUMANOIDS, "auto"))
                )
                first, _ = await group.reset(seed=0)
                stepping = asyncio.create_task(self.step(group, first))
            longest, last = 0.0, time.perf_counter()
            until = last + seconds
            while last < until:
                await asyncio.sleep(SLEEP)
                now = time.perf_counter()
                longest, last = max(longest, now - last - SLEEP), now
            if stepping is not None:
                stepping.cancel()
                await asyncio.wait([stepping])
        return 1e3 * longest

    async def step(self, group: object, batch: object) -> None:
        (space,) = group.get_action_spaces()  # type: ignore[attr-defined]
        while True:
            action = np.stack([space.sample()])
            batch, _ = await group.step(batch.respond(action=action))  # type: ignore[attr-defined]


QUESTION = Question(
    name="loop_pause",
    title="Longest pause of the event loop",
    unit="ms",
    contenders=[Pause("256 Humanoids step", steps=True), Pause("nothing steps", steps=False)],
    counts_steps=False,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
