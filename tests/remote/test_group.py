"""Clients in a group, which are envs like any other."""

from __future__ import annotations

import asyncio
import time
from contextlib import contextmanager
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from kit.counting import ClientThread, CountingEnv, served
from patience import HANG

import rlightning_aio
from rlightning_aio import sync
from rlightning_aio.errors import (
    BadAction,
    ClientRefused,
    EnvAway,
    EnvError,
    GroupClosed,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.types import EnvRet


CARTPOLE = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 2}


def entry(count: int = 1, **env_kwargs: Any) -> dict[str, Any]:
    names = [f"c{k}" for k in range(count)]
    return served(clients=names, **env_kwargs)


@contextmanager
def clients(group: Any, *envs: CountingEnv, server: str = "robots-0") -> Iterator[list[Any]]:
    """Yield clients c0, c1, … of the envs; they end when the block closes the group."""
    threads = [ClientThread(group[server].address, f"c{k}", env) for k, env in enumerate(envs)]
    yield threads
    for thread in threads:
        thread.join()


def actions(batch: Any) -> np.ndarray[Any, Any]:
    return np.zeros((len(batch), 2), np.float32)


def test_results_have_the_time_of_their_clients_clock() -> None:
    """However wrong that clock is and however late the trainer reads; statistics use its own."""
    year_ns = 365 * 24 * 3600 * 10**9

    class Behind(CountingEnv):
        def ret(self) -> EnvRet:
            ret = super().ret()
            ret.ts_env_sent_ns = time.time_ns() - 10 * year_ns
            return ret

    with sync.build_env_group(entry()) as group, clients(group, Behind()):
        batch, _ = group.reset()
        for _ in range(3):
            before = time.time_ns()
            group.step_async(batch.respond(action=actions(batch)))
            batch, _ = group.collect_async(deadline=HANG)
            (ret,) = batch.values()
            assert before <= ret.ts_env_sent_ns + 10 * year_ns <= time.time_ns()
        assert all(0 <= v < 1e6 * HANG for v in group.get_stats()["latency_us"].values())
        group.close()


def test_options_that_cannot_be_sent_to_a_client_are_refused_before_anything_is_sent() -> None:
    """Although local envs would accept them; all envs can be reset again."""
    with (
        sync.build_env_group([CARTPOLE, entry()], mixed_actions=True) as group,
        clients(group, CountingEnv()),
    ):
        group.reset()
        resets = group.reset, group.reset_async, group["robots-0/c0"].reset
        options: list[Any] = [{"goal": object()}, {0: "x"}, {"x": {"y": 2**70}}]
        for reset, wrong in product(resets, options):
            with pytest.raises(TypeError, match=r"reset of robots-0/c0: .*; nothing was sent"):
                reset(options=wrong)
        batch, _ = group.reset(options={"goal": 1})
        assert len(batch) == 3
        group.close()


def test_extras_that_are_too_large_together_are_refused_before_anything_is_sent() -> None:
    """Although each of them alone is small enough; the clients can be stepped with less."""
    large = ["x" * (3 << 20)] * 2
    with (
        sync.build_env_group(entry(2)) as group,
        clients(group, CountingEnv(0), CountingEnv(1)),
    ):
        batch, _ = group.reset()
        with pytest.raises(BadAction, match=r"for robots-0/c.: .* are allowed"):
            group.step_async(batch.respond(action=actions(batch), one=large, other=large))
        group.step_async(batch.respond(action=actions(batch), one=["x"] * 2))
        batch, _ = group.collect_async(wait_all=True, deadline=HANG)
        assert batch.observation[:, 2].tolist() == [1, 1]
        group.close()


def test_lengths_count_each_server_once() -> None:
    """However many places it has."""
    with (
        sync.build_env_group([CARTPOLE, entry(2)], mixed_actions=True) as group,
        clients(group, CountingEnv(), CountingEnv()),
    ):
        group.reset()
        assert (len(group), group.size()) == (3, 2)
        assert group.env_ids == ["pole-0", "pole-1", "robots-0/c0", "robots-0/c1"]
        group.close()


def test_a_client_that_raises_is_reset_where_exceptions_are_borne() -> None:
    """By `on_env_error: restart`; the result is marked, as of an env that is rebuilt."""
    env = CountingEnv(0)

    def fail_once() -> None:
        env.on_step = lambda: None
        raise EnvError("not there", blame="policy")

    fields = entry() | {"on_env_error": "restart"}
    with sync.build_env_group(fields) as group, clients(group, env):
        batch, _ = group.reset()
        env.on_step = fail_once
        batch, _ = group.step(batch.respond(action=actions(batch)))
        assert batch.restarted.tolist() == [True]
        assert batch.outcome[0].blame == "policy"
        assert batch.observation.tolist() == [[0, -1, 0]]
        batch, _ = group.step(batch.respond(action=actions(batch)))
        assert (batch.restarted.tolist(), batch.is_reset.tolist()) == ([False], [False])
        assert group.metrics()["envs/restarts"] == 1
        group.close()


def test_a_server_that_is_restarted_gets_its_clients_back() -> None:
    """Clients reconnect; `on_disconnect` is called once for each lost server."""
    env = CountingEnv(0)
    env.stays = True
    with sync.build_env_group(entry()) as group:
        address = group["robots-0"].address
        thread = ClientThread(address, "c0", env)
        group.reset()
    port = int(address.rpartition(":")[2])
    with sync.build_env_group(entry(port=port)) as group:
        batch, _ = group.reset(seed=1)
        assert batch.observation.tolist() == [[0, 1, 0]]
        assert env.disconnects == 1
        env.stays = False
    thread.join()
    assert env.disconnects == 2


def test_a_client_with_other_actions_than_the_local_envs_is_refused() -> None:
    """It receives the reason, and so does a reset that waits; the place is free for another."""
    with sync.build_env_group([CARTPOLE, entry(connect_timeout=0.2)]) as group:
        other = ClientThread(group["robots-0"].address, "c0")
        while other.error is None:
            with pytest.raises(EnvAway, match="no client has dialled in"):
                group.reset()
        with pytest.raises(EnvAway, match=r"refused 'c0': .*different action spaces"):
            group.reset()
        group.close()
        with pytest.raises(ClientRefused, match="different action spaces"):
            other.join()


def test_a_client_that_ended_in_its_first_reset_is_named() -> None:
    """The error says that one came, and why it is gone."""

    class Ending(CountingEnv):
        def reset(self, **arguments: Any) -> Any:
            raise SystemExit("no power at the arm")

    with sync.build_env_group(entry(connect_timeout=0.2)) as group:
        ending = ClientThread(group["robots-0"].address, "c0", Ending())
        while ending.error is None:
            with pytest.raises(EnvAway):
                group.reset()
        with pytest.raises(EnvAway, match=r"c0.*no power at the arm"):
            group.reset()
        group.close()
        with pytest.raises(SystemExit):
            ending.join()


def test_offloading_skips_clients() -> None:
    with sync.build_env_group(entry()) as group, clients(group, CountingEnv()):
        group.reset()
        group.offload()
        group.reload()
        group.close()


async def test_closing_a_group_ends_a_reset_that_waits_for_clients() -> None:
    group = rlightning_aio.build_env_group(entry())
    await group.init()
    waiting = asyncio.create_task(group.reset())
    await asyncio.sleep(0)
    await group.close()
    with pytest.raises(GroupClosed):
        await waiting
