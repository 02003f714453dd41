"""Envs in the trainer's process: interrupts reach the program."""

from __future__ import annotations

import asyncio
import signal
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import gymnasium as gym
import numpy as np
import pytest
from kit.driven import Driven
from kit.tokens import Tokens, entry

import rlightning_aio as rl
from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from collections.abc import Callable

    Start: TypeAlias = Callable[..., Driven]


def test_interrupt_in_an_inline_step_comes_out_and_ends_its_request() -> None:
    """Ctrl-C reaches the program; the interrupted env has an error, the others have results."""
    group, tokens = Driven("sync", entry(3, placement="inline")), Tokens()
    group.init()
    group.reset()
    group.call("faulty-1", "answer_with", info=lambda: signal.raise_signal(signal.SIGINT))
    group.step_async(tokens.steps(group.group.env_ids))
    with pytest.raises(KeyboardInterrupt):
        group.collect_async(wait_all=True)
    with pytest.raises(EnvRaised, match=r"faulty-1.*KeyboardInterrupt"):
        group.collect_async(wait_all=True)
    batch, _ = group.collect_async(wait_all=True)
    assert sorted(batch.ids()) == ["faulty-0", "faulty-2"]
    tokens.check(batch)
    group.reset()
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])
    group.end()


class Struck:
    """Is interrupted in a step, or hangs there; the second one, in its making or its reset.

    Attributes:
        where: it is interrupted.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Discrete(2)
    built: ClassVar[int] = 0
    where: ClassVar[str]

    def __init__(self) -> None:
        Struck.built += 1
        if Struck.built > 1 and self.where == "making":
            raise KeyboardInterrupt

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del seed, options
        if Struck.built > 1 and self.where == "reset":
            raise KeyboardInterrupt
        return np.zeros(1), {}

    async def step(self, action: Any) -> Any:
        del action
        if self.where == "step":
            raise KeyboardInterrupt
        await asyncio.Event().wait()


@pytest.mark.parametrize("where", ["step", "reset", "making"])
def test_an_interrupt_on_the_trainers_event_loop_reaches_the_program(where: str) -> None:
    """It may be the user's Ctrl-C, whatever an awaitable env executes then."""
    Struck.built, Struck.where = 0, where

    async def use() -> None:
        fields = {"name": "s", "task": Struck, "placement": "loop", "step_timeout": 0.1}
        async with rl.build_env_group(fields) as group:
            batch, _ = await group.reset()
            await group.step(batch.respond(action=np.zeros(1, int)))

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(use())
