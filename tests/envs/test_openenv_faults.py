"""The `openenv` backend against a server that misbehaves, driven by a state machine.

Its 20 examples have 20 steps each. With RLIGHTNING_AIO_EXAMPLES=200 and RLIGHTNING_AIO_STEPS=100
more than 10,000 actions are sent, and `pytest -s` prints how many. No request has a time limit: the
time of one is up when a rule says so, or when the server will never answer it.
"""

# pyright: reportPrivateUsage=false

from __future__ import annotations

import asyncio
import math
import os
from typing import TYPE_CHECKING, Any

import pytest
from envs.misbehaving_openenv import CONNECT_ERRORS, FATES, Misbehaving, numbers
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)
from patience import HANG

import rlightning_aio as rl
from rlightning_aio._core.hosts.awaiting.awaited_envs import AwaitedEnvs
from rlightning_aio.errors import EnvRaised
from rlightning_aio.plugins.openenv import session as openenv_session

if TYPE_CHECKING:
    from collections.abc import Iterable

ENVS = 4
CAUSES = (".ServerGone", ".ServerRefused")
EACH = st.sets(st.integers(0, ENVS - 1), min_size=1)


def chosen(env_ids: list[str], which: set[int]) -> list[str]:
    """At least one of them, if there are any."""
    return [env_ids[k] for k in sorted({k % len(env_ids) for k in which})] if env_ids else []


made: list[AwaitedEnvs] = []
"""The envs of groups, as they are made."""


def give_up_on(envs: AwaitedEnvs, env_id: str) -> None:
    """Let the time be up of the request that an env executes, if it does."""
    for record in envs._records:  # noqa: SLF001
        if record.name == env_id and record.due < math.inf:
            envs._expire(record)  # noqa: SLF001


class Machine(RuleBasedStateMachine):
    """Four envs at a server with four slots.

    Attributes:
        steps, sent, executed: how many steps all machines took; actions that were sent to envs,
            and those that the server executed.
        asked: the number of the action in flight, by env.
        raised: the envs that must be reset.
    """

    steps = sent = executed = 0

    @initialize(loses_pongs=st.booleans())
    def begin(self, *, loses_pongs: bool) -> None:
        self.runner = asyncio.Runner()
        self.asked: dict[str, int] = {}
        self.raised: set[str] = set()
        self.run(self._begin(loses_pongs=loses_pongs))

    @invariant()
    def count(self) -> None:
        Machine.steps += 1

    def run(self, coroutine: Any) -> Any:
        return self.runner.run(asyncio.wait_for(coroutine, HANG))

    async def _begin(self, *, loses_pongs: bool) -> None:
        self.server = await Misbehaving(ENVS).__aenter__()
        self.server.loses_pongs = loses_pongs
        self.server.on_never = self._give_up_on
        entry = {"name": "o", "backend": "openenv", "task": self.server.url, "num_workers": ENVS}
        entry |= {"placement": "loop", "step_timeout": HANG, "max_restarts": 10**6}
        self.group = rl.build_env_group(entry)
        await self.group.init()
        self.envs = made.pop()
        self.resetting = self.group.auto_reset(math.inf)
        self.resetting.__enter__()
        await self.group.reset()

    @property
    def unasked(self) -> list[str]:
        return [i for i in self.group.env_ids if i not in self.asked]

    @rule(fates=st.lists(st.sampled_from(FATES), min_size=1, max_size=6))
    def misbehave(self, fates: list[str]) -> None:
        self.server.fates.extend(fates)

    @rule(fates=st.lists(st.sampled_from(CONNECT_ERRORS), min_size=1, max_size=3))
    def refuse(self, fates: list[str]) -> None:
        self.server.connect_fates.extend(fates)

    @rule()
    def restart(self) -> None:
        self.server.restart()

    @rule(which=EACH)
    def step(self, which: set[int]) -> None:
        if not self.unasked:
            self.run(self._collect(1))
        ids = chosen(self.unasked, which)
        self.run(self._reset(self.raised.intersection(ids)))
        self.run(self._step([i for i in ids if i not in self.raised]))

    async def _step(self, ids: list[str]) -> None:
        if ids:
            steps = [rl.PolicyResponse(i, {"number": next(numbers)}) for i in ids]
            Machine.sent += len(ids)
            self.asked |= {one.env_id: one.action["number"] for one in steps}
            self.group.step_async(rl.BatchedData(ids, steps))

    @rule(which=EACH)
    def step_and_collect(self, which: set[int]) -> None:
        self.step(which)
        self.run(self._collect(len(self.asked)))

    @rule(which=EACH)
    def let_time_be_up(self, which: set[int]) -> None:
        """Of steps, wherever they are."""
        self.run(self._give_up_on_steps(chosen(list(self.asked), which)))

    async def _give_up_on_steps(self, ids: list[str]) -> None:
        for env_id in ids:
            give_up_on(self.envs, env_id)

    def _give_up_on(self, number: int) -> None:
        """Let the time be up of a step that is never answered."""
        for env_id in [i for i, asked in self.asked.items() if asked == number]:
            give_up_on(self.envs, env_id)

    @rule(count=st.integers(1, ENVS))
    def collect(self, count: int) -> None:
        self.run(self._collect(min(count, len(self.asked))))

    @rule()
    def collect_what_is_ready(self) -> None:
        """A deadline cancels nothing."""
        self.run(self._collect(len(self.asked), deadline=0.002))

    async def _collect(self, count: int, deadline: float | None = None) -> None:
        """Check that every request ends once, in a result for its own action or in an error."""
        target = len(self.asked) - count
        while len(self.asked) > target:
            try:
                batch, _ = await self.group.collect_async(min_results=1, deadline=deadline)
            except TimeoutError:
                return
            except EnvRaised as error:
                del self.asked[error.env_id]
                self.raised.add(error.env_id)
                continue
            no_answer = batch.restarted | batch.truncated | batch.is_reset
            for env_id, seen, none in zip(batch.ids(), batch.observation, no_answer, strict=True):
                number = self.asked.pop(env_id)
                assert none or seen["answers"] == number
            if deadline is not None:
                return

    @rule(which=EACH)
    def reset(self, which: set[int]) -> None:
        self.run(self._reset(chosen(self.unasked, which)))

    async def _reset(self, ids: Iterable[str]) -> None:
        for env_id in ids:
            try:
                batch, _ = await self.group.reset(env_ids=[env_id])
            except EnvRaised:
                self.raised.add(env_id)
                continue
            self.raised.discard(env_id)
            assert [one["answers"] for one in batch.observation] == [None]

    @rule(which=EACH)
    def call(self, which: set[int]) -> None:
        """Check that calls get their own replies, too."""
        self.run(self._call(chosen(self.unasked, which)))

    async def _call(self, ids: list[str]) -> None:
        for env_id in ids:
            number = next(numbers)
            try:
                reply = await self.group[env_id].call("mcp", "echo", {"number": number})
                assert reply == {"result": {"number": number}}
                assert "step_count" in await self.group[env_id].call("state")
            except EnvRaised as error:
                assert error.exception_type.endswith(CAUSES)  # noqa: PT017

    def teardown(self) -> None:
        if hasattr(self, "runner"):
            try:
                self.run(self._end())
            finally:
                self.runner.close()

    async def _end(self) -> None:
        """Check that every env is usable, no action has run twice, and no slot is taken."""
        await self._collect(len(self.asked))
        self.server.fates.clear()
        self.server.connect_fates.clear()
        ids = self.group.env_ids
        await self._reset(ids)
        await self._step(ids)
        asked = dict(self.asked)
        batch, _ = await self.group.collect_async(wait_all=True)
        assert not (batch.truncated | batch.is_reset).any()
        assert [one["answers"] for one in batch.observation] == [asked[i] for i in ids]
        self.resetting.__exit__(None, None, None)
        await self.group.close()
        assert set(self.server.executed.values()) <= {1}
        Machine.executed += len(self.server.executed)
        assert self.server.most <= ENVS
        self.server.reap()
        while self.server.sessions:  # noqa: ASYNC110  # It has still to see the sockets close.
            await asyncio.sleep(0.001)
        await self.server.__aexit__()


# On a busy machine a session may take longer to close than `close` waits.
@pytest.mark.filterwarnings("ignore:close.. of env .* took longer")
def test_whatever_a_server_does_each_request_ends_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """No reply answers another request, no action runs twice, no slot leaks, all envs recover."""
    make = AwaitedEnvs.__init__

    def noted(envs: AwaitedEnvs, *args: Any, **kwargs: Any) -> None:
        made.append(envs)
        make(envs, *args, **kwargs)

    monkeypatch.setattr(AwaitedEnvs, "__init__", noted)
    monkeypatch.setattr(openenv_session, "_KEEPALIVE_SECONDS", 0.002)
    monkeypatch.setattr(openenv_session, "_PAUSE_SECONDS", (0.001, 0.01))
    steps = int(os.environ.get("RLIGHTNING_AIO_STEPS", "20"))
    run_state_machine_as_test(Machine, settings=settings(stateful_step_count=steps))
    told = f"{Machine.steps} steps: {Machine.sent} actions, {Machine.executed} executed once"
    print(f"{told}; no slot was leaked")  # noqa: T201
