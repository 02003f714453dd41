"""HalfCheetah-v5 by EnvPool, 32 envs: what does a group around a batched simulator cost?

EnvPool alone, and as a backend in the trainer's own process (``placement: inline``), all 32 at a
time and 16 of 32, by ``step`` and by ``step_async`` and ``collect_async``. Its threads are pinned
to cores in all cases; otherwise the figures would depend on where the system puts them.
"""

from __future__ import annotations

from dataclasses import dataclass

from contenders import EnvPool, Stepped, Work, sampled
from harness import Question, Target, main

WORK = Work("HalfCheetah-v5", num_envs=32)


@dataclass
class Pooled(Stepped):
    """The `envpool` backend, one batched env in a synchronous group.

    Attributes:
        batch_size: results it hands out at a time; all envs if None.
        collects: by `step_async` and `collect_async` instead of `step`.
    """

    batch_size: int | None = None
    collects: bool = False

    package = "envpool"

    def setup(self) -> None:
        from rlightning_aio.sync import build_env_group

        env_kwargs = {"thread_affinity_offset": 0}
        if self.batch_size is not None:
            env_kwargs["batch_size"] = self.batch_size
        self._envs = build_env_group(
            {
                "name": "pool",
                "backend": "envpool",
                "task": self.work.task,
                "num_envs": self.work.num_envs,
                "placement": "inline",
                "env_kwargs": env_kwargs,
            }
        )
        self._envs.init()
        self._batch, _ = self._envs.reset(seed=0)
        self._actions = sampled(self._envs.get_action_spaces()[0], 1)

    def step(self) -> int:
        responses = self._batch.respond(action=next(self._actions))
        if self.collects:
            self._envs.step_async(responses)
            self._batch, _ = self._envs.collect_async()
        else:
            self._batch, _ = self._envs.step(responses)
        _ = self._batch.observation
        return self._batch.reward.size


ALONE, GROUP = "EnvPool, 32 at a time", "rlightning_aio inline, 32 at a time"
HALF_ALONE, HALF_GROUP = "EnvPool, 16 of 32", "rlightning_aio inline, 16 of 32"
COLLECTED = "rlightning_aio inline, 16 of 32, collect_async"

QUESTION = Question(
    name="pool",
    title="HalfCheetah-v5 by EnvPool, 32 envs",
    unit="env steps/s",
    contenders=[
        EnvPool(ALONE, WORK, thread_affinity_offset=0),
        Pooled(GROUP, WORK),
        EnvPool(HALF_ALONE, WORK, batch_size=16, thread_affinity_offset=0),
        Pooled(HALF_GROUP, WORK, batch_size=16),
        Pooled(COLLECTED, WORK, batch_size=16, collects=True),
    ],
    targets=[
        Target(GROUP, ALONE, 0.95),
        Target(HALF_GROUP, HALF_ALONE, 0.95),
        Target(COLLECTED, HALF_ALONE, 0.95),
    ],
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
