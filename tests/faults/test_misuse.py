"""An invalid request is refused with a reason before any part of it is sent."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from itertools import product
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pytest
from kit.driven import Driven, on_one_driver
from kit.processes import stop
from kit.tokens import Tokens, entry, two_workers

import rlightning_aio
from rlightning_aio import BatchedData, PolicyResponse
from rlightning_aio.errors import (
    BadAction,
    EnvBusy,
    GroupClosed,
    NothingPending,
    RLightningError,
    UnknownEnv,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio import EnvGroup

    Start: TypeAlias = Callable[..., Driven]

# For each, the four actions and the message. The action space is Box(2, float64).
BAD_ACTIONS: dict[str, tuple[Any, str]] = {
    "shape": (np.zeros((4, 3)), r"expected shape \(4, 2\) .* found shape \(4, 3\)"),
    "shape of each": (np.zeros((4, 2, 1)), r"expected shape \(4, 2\) .* found shape \(4, 2, 1\)"),
    "dtype": (np.zeros((4, 2), complex), "dtype float64, found .* dtype complex128"),
    "text": (np.full((4, 2), "x"), "dtype float64, found .* dtype <U1"),
    "nothing": ([None] * 4, "found .* dtype object"),
    "NaN": ([[0.0, 1.0], [0.0, 1.0], [0.0, np.nan], [0.0, 1.0]], "faulty-2.*holds nan"),
    "ragged": ([[1.0], [1.0, 2.0], [1.0], [1.0]], "action"),
}


def responses(env_ids: list[str], chosen: Any) -> BatchedData:
    """Return the same actions as separate responses."""
    values = [PolicyResponse(id_, action) for id_, action in zip(env_ids, chosen, strict=True)]
    return BatchedData(env_ids, values)


@on_one_driver
def test_bad_actions_are_refused_and_nothing_is_sent(start: Start) -> None:
    """As columns and as responses, synchronous or not; the next request is answered correctly."""
    group, tokens = start(two_workers()), Tokens()
    env_ids = group.group.env_ids
    first, _ = group.step(tokens.steps(env_ids))
    for send, (chosen, message) in product((group.step, group.step_async), BAD_ACTIONS.values()):
        with pytest.raises(BadAction, match=message):
            send(first.respond(action=chosen))
        with pytest.raises(BadAction, match="action"):
            send(responses(env_ids, chosen))
        with pytest.raises(NothingPending):
            group.collect_async()
        tokens.check(group.step(tokens.steps(env_ids))[0])


@on_one_driver
def test_one_bad_action_of_many_is_named(start: Start) -> None:
    """The message names the env of the wrong action, and no other env has stepped."""
    group, tokens = start(two_workers()), Tokens()
    batch = tokens.steps(group.group.env_ids)
    batch.values()[2].action = np.zeros(7)
    with pytest.raises(BadAction, match=r"faulty-2.*found shape \(7,\).*nothing was sent"):
        group.step(batch)
    found, _ = group.step(tokens.steps(group.group.env_ids))
    tokens.check(found)
    assert found.observation[:, 3].tolist() == [1, 1, 1, 1]


@on_one_driver
def test_responses_must_be_as_many_as_the_batch(start: Start) -> None:
    """A column of another length is refused where it is attached."""
    group, tokens = start(two_workers()), Tokens()
    batch, _ = group.step(tokens.steps(group.group.env_ids))
    for count in (0, 3, 5):
        with pytest.raises(BadAction, match="action"):
            group.step(batch.respond(action=np.zeros((count, 2))))
    with pytest.raises(BadAction, match="PolicyResponse"):
        group.step(BatchedData(["faulty-0"], [7]))
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


@on_one_driver
def test_values_that_are_no_batch_of_responses_are_refused(start: Start) -> None:
    """The error says what to pass; a handle refuses responses to other envs."""
    group, tokens = start(two_workers()), Tokens()
    for ask in (group.step, group.step_async):
        for odd in (np.zeros((4, 2)), None, [PolicyResponse("faulty-0", np.zeros(2))]):
            with pytest.raises(BadAction, match=r"not a \w+: .*batch.respond\(action=...\)"):
                ask(odd)
    with pytest.raises(BadAction, match=r"response is for env 'faulty-1'.*handle of 'faulty-0'"):
        group.group["faulty-0"].step(PolicyResponse("faulty-1", np.zeros(2)))
    found, _ = group.step(tokens.steps(group.group.env_ids))
    tokens.check(found)
    assert found.observation[:, 3].tolist() == [1, 1, 1, 1]


@on_one_driver
def test_unknown_and_repeated_ids_are_named(start: Start) -> None:
    """In every call; nothing is sent."""
    group, tokens = start(two_workers()), Tokens()
    for ids, error, message in (
        (["faulty-0", "faulty-9"], UnknownEnv, "'faulty-9'; its envs are faulty-0, faulty-1"),
        (["faulty-0", "faulty-1", "faulty-0"], EnvBusy, "'faulty-0' appears twice"),
    ):
        chosen = responses(ids, np.zeros((len(ids), 2)))
        with pytest.raises(error, match=message):
            group.step(chosen)
        with pytest.raises(error, match=message):
            group.step_async(chosen)
        with pytest.raises(error, match=message):
            group.reset(env_ids=ids)
        tokens.check(group.step(tokens.steps(group.group.env_ids))[0])
    with pytest.raises(UnknownEnv, match="faulty-9"):
        group.call("faulty-9", "do", "nothing")
    with pytest.raises(UnknownEnv, match="faulty-9"):
        group.reset(seed={"faulty-9": 1})


def test_busy_env_refuses_the_whole_batch(start: Start) -> None:
    """The other envs of the batch get no request, either."""
    group, tokens = start(two_workers()), Tokens()
    group.step_async(tokens.steps(["faulty-1"]))
    everyone = responses(group.group.env_ids, np.zeros((4, 2)))
    for ask in (
        lambda: group.step_async(everyone),
        lambda: group.step(everyone),
        group.reset,
        lambda: group.call("faulty-1", "do", "nothing"),
    ):
        with pytest.raises(EnvBusy, match=r"faulty-1.*collect it first.*nothing was sent"):
            ask()
    batch, _ = group.collect_async()
    tokens.check(batch)
    assert batch.ids() == ["faulty-1"]
    found, _ = group.step(tokens.steps(group.group.env_ids))
    assert found.observation[:, 3].tolist() == [1, 2, 1, 1]


@on_one_driver
def test_values_that_cannot_be_sent_are_refused_first(start: Start) -> None:
    """An argument of a call, options of a reset, an extra of one response among many."""
    group, tokens = start(two_workers(), preprocess_fn=lambda response: response.action), Tokens()
    lock = threading.Lock()
    with pytest.raises(TypeError, match=r"faulty-1.*can't be sent.*nothing was sent"):
        group.call("faulty-1", "do", lock)
    with pytest.raises(TypeError, match=r"can't be sent.*nothing was sent"):
        group.reset(options={"lock": lock})
    batch = tokens.steps(group.group.env_ids)
    batch.values()[3].lock = lock
    with pytest.raises(BadAction, match=r"faulty-3.*can't be sent.*nothing was sent"):
        group.step(batch)
    found, _ = group.step(tokens.steps(group.group.env_ids))
    tokens.check(found)
    assert found.observation[:, 3].tolist() == [1, 1, 1, 1]


USES: dict[str, Callable[[Any], Any]] = {
    "reset": lambda group: group.reset(),
    "step": lambda group: group.step(Tokens().steps(group.group.env_ids)),
    "step_async": lambda group: group.step_async(Tokens().steps(group.group.env_ids)),
    "collect_async": lambda group: group.collect_async(),
    "call": lambda group: group.call("faulty-0", "do", "nothing"),
    "offload": lambda group: group.offload(),
    "get_action_spaces": lambda group: group.get_action_spaces(),
}


def test_options_for_each_env_are_refused_with_the_way_to_give_them(build: Start) -> None:
    """They would reach each env as a whole. Nothing is sent."""
    group = build(two_workers())
    group.init()
    options: Any = [{"level": k} for k in range(4)]
    for reset in (group.reset, group.reset_async):
        with pytest.raises(TypeError, match=r"options must be a dict.*not a list.*env_ids="):
            reset(options=options)
    assert group.group.pending == []
    group.reset(options={"fault": "nothing"})


def test_use_before_init_and_after_close_is_refused(build: Start) -> None:
    """It doesn't hang, and the error says what to do."""
    group = build(entry())
    for use in USES.values():
        with pytest.raises(RLightningError, match="call init"):
            use(group)
    group.init()
    group.close()
    for use in USES.values():
        with pytest.raises(GroupClosed, match="build a new one") as raised:
            use(group)
        assert type(raised.value) is GroupClosed
    with pytest.raises(GroupClosed, match="build a new one"):
        group.init()


async def test_second_collect_is_refused_and_the_first_continues() -> None:
    """Two would take each other's results."""
    tokens = Tokens()
    async with rlightning_aio.build_env_group(two_workers()) as group:
        await group.reset()
        # Stopped workers keep the first collect waiting.
        pids = [worker["pid"] for worker in group.get_workers()]
        for pid in pids:
            stop(pid)
        try:
            group.step_async(tokens.steps(group.env_ids))
            first = asyncio.ensure_future(group.collect_async(wait_all=True))
            await asyncio.sleep(0)  # The first collect has begun to wait.
            with pytest.raises(RLightningError, match="one collector at a time"):
                await group.collect_async()
        finally:
            for pid in pids:
                os.kill(pid, signal.SIGCONT)
        batch, _ = await first
        tokens.check(batch)
        assert len(batch) == 4


async def test_many_calls_at_once_each_get_their_own_replies() -> None:
    """Steps, calls and one collect in parallel; no reply is mixed up."""

    async def drive(group: EnvGroup, env_id: str) -> None:
        tokens = Tokens()
        for _ in range(50):
            batch, _ = await group.step(tokens.steps([env_id]))
            tokens.check(batch)
            assert await group[env_id].call("do", "nothing") == f"{env_id} did nothing"

    async with rlightning_aio.build_env_group(two_workers()) as group:
        await group.reset()
        collected = Tokens()

        async def collect() -> None:
            for _ in range(50):
                group.step_async(collected.steps(["faulty-3"]))
                collected.check((await group.collect_async())[0])

        await asyncio.gather(*(drive(group, f"faulty-{k}") for k in range(3)), collect())
