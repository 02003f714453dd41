"""Awaitable envs that misbehave when their action says so; workers import them from here."""

from __future__ import annotations

import asyncio
import time
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from rlightning_aio import ENVS, BaseEnv, EnvRet, PolicyResponse

OWN = {"backend": "scripted", "task": "-", "imports": ["hosts.awaited"]}
STEP, END, HANG, IGNORE, CANCELLED, BLOCK, GATE, RAISE, EXIT, INTERRUPT, BIG = range(11)
BIG_BYTES = 1 << 22
"""More than a socket holds."""


def _exit() -> None:
    raise SystemExit(5)


def _interrupt() -> None:
    raise KeyboardInterrupt


LEAVING = {EXIT: _exit, INTERRUPT: _interrupt}


@ENVS.register("scripted")
class Scripted(BaseEnv):
    """Observes [how many of it were built here, episodes, steps, seed]; see the actions above.

    Attributes:
        built: how often an env of this id was built, in this process.
        closed: ids of envs that were closed, in order.
        gates: what a step with the action `GATE` waits for, by env.
        at_gate: how many of them wait now.
        let_go: ends the steps that ignore that they are cancelled.
    """

    built: ClassVar[dict[str, int]] = {}
    closed: ClassVar[list[str]] = []
    gates: ClassVar[dict[str, asyncio.Event]] = {}
    at_gate: ClassVar[set[str]] = set()
    let_go: ClassVar[asyncio.Event]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.built[self.env_id] = self.built.get(self.env_id, 0) + 1
        self.episodes = self.steps = 0
        self.seed: Any = -1
        if self.built[self.env_id] > self.config.env_kwargs.get("builds", 100):
            raise RuntimeError("no more of these")

    def get_observation_space(self) -> Any:
        return spaces.Box(-np.inf, np.inf, (4,), np.float64)

    def get_action_space(self) -> Any:
        return spaces.Discrete(11)

    def _result(self, **fields: Any) -> EnvRet:
        shown = [self.built[self.env_id], self.episodes, self.steps, self.seed]
        return EnvRet(env_id=self.env_id, observation=np.array(shown, float), **fields)

    async def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:
        await asyncio.sleep(0)
        self.episodes, self.steps = self.episodes + 1, 0
        self.seed = -1 if seed is None else seed
        if options == {"hang": self.built[self.env_id]}:
            await asyncio.Event().wait()
        return self._result()

    async def step(self, policy_resp: PolicyResponse) -> EnvRet:
        action = int(policy_resp.action)
        await asyncio.sleep(0)
        if action == HANG:
            await asyncio.Event().wait()
        elif action == IGNORE:
            await self._ignore_cancellation()
        elif action == CANCELLED:
            raise asyncio.CancelledError("its own")
        elif action == BLOCK:
            time.sleep(0.12)  # noqa: ASYNC251  # As it should not.
        elif action == GATE:
            self.at_gate.add(self.env_id)
            await self.gates[self.env_id].wait()
            self.at_gate.discard(self.env_id)
            await asyncio.sleep(0)
        elif action == RAISE:
            raise ValueError("as it was asked to")
        elif action in LEAVING:
            LEAVING[action]()
        self.steps += 1
        info = {"blob": bytes(BIG_BYTES)} if action == BIG else {}
        return self._result(last_reward=float(action), last_terminated=action == END, info=info)

    async def _ignore_cancellation(self) -> None:
        let_go = getattr(self, "let_go", None) or asyncio.Event()  # None in a worker.
        while True:
            try:
                await let_go.wait()
            except asyncio.CancelledError:
                continue
            return

    async def wait(self) -> None:
        await self.gates[self.env_id].wait()

    async def double(self, value: Any) -> Any:
        await asyncio.sleep(0)
        return 2 * value

    async def close(self) -> None:
        await asyncio.sleep(0)
        self.closed.append(self.env_id)
        if self.config.env_kwargs.get("close") == "hangs":
            await asyncio.Event().wait()


@ENVS.register("half awaitable")
class HalfAwaitable(Scripted):
    def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:  # type: ignore[override]
        return self._result()
