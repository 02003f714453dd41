"""An awaitable env whose client spans requests, as clients of MCP do: a task group of anyio is
opened by a reset and left by the next one, or by `close`. anyio lets only the task that has entered
a scope leave it.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import Any

import anyio
from gymnasium import spaces

from rlightning_aio import ENVS, BaseEnv, EnvRet

OWN = {"backend": "spanning", "task": "-", "imports": ["hosts.spanning"]}
ADD, HANG, CRASH, RAISE, END = range(5)


class Crash(Exception):
    """What the background of the client raises."""


@ENVS.register("spanning")
class Spanning(BaseEnv):
    """Observes how many steps its client has answered since the reset; see the actions above.

    ``env_kwargs``: `file`, to which it appends a line when its client has been left properly.
    """

    stack: AsyncExitStack | None = None

    def get_observation_space(self) -> Any:
        return spaces.Discrete(1000)

    def get_action_space(self) -> Any:
        return spaces.Discrete(5)

    async def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:
        await self._leave()
        self.stack = AsyncExitStack()
        group = await self.stack.enter_async_context(anyio.create_task_group())
        self.asked, asked = anyio.create_memory_object_stream[int](1)
        answered, self.answers = anyio.create_memory_object_stream[int](1)
        for stream in (self.asked, asked, answered, self.answers):
            self.stack.callback(stream.close)
        group.start_soon(self._serve, asked, answered)
        self.stack.callback(group.cancel_scope.cancel)
        return EnvRet(env_id=self.env_id, observation=0, info={"seed": seed, "options": options})

    @staticmethod
    async def _serve(asked: Any, answered: Any) -> None:
        count = 0
        async for action in asked:
            if action == CRASH:
                await answered.send(count)
                raise Crash("the client's background has ended")
            if action == HANG:
                await anyio.sleep_forever()
            count += 1
            await answered.send(count)

    async def step(self, policy_resp: Any) -> EnvRet:
        action = int(policy_resp.action)
        if action == RAISE:
            raise ValueError("as it was asked to")
        await self.asked.send(action)
        count = await self.answers.receive()
        return EnvRet(env_id=self.env_id, observation=count, last_terminated=action == END)

    async def _leave(self) -> None:
        stack, self.stack = self.stack, None
        if stack is not None:
            await stack.aclose()
            await asyncio.sleep(0)
            with open(self.config.env_kwargs["file"], "a") as file:  # noqa: ASYNC230, PTH123
                file.write(f"{self.env_id} left\n")

    async def close(self) -> None:
        await self._leave()
