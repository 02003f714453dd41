"""Clients in a group, which are envs like any other."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
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
    EnvRaised,
    GroupClosed,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rlightning_aio.types import EnvRet

TRAJECTORY_STEPS = int(os.environ.get("RLIGHTNING_AIO_TRAJECTORY_STEPS", "800"))
"""Steps to compare, of all clients together."""


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
        for reset in (group.reset, group.reset_async, group["robots-0/c0"].reset):
            with pytest.raises(TypeError, match=r"reset of robots-0/c0: .*; nothing was sent"):
                reset(options={"goal": object()})
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


def test_an_env_that_raises_at_the_client_can_be_reset_and_used_again() -> None:
    """The group raises `EnvRaised` with the client's name and the remote traceback."""
    env = CountingEnv(0)

    def fail() -> None:
        raise ZeroDivisionError("no way")

    with sync.build_env_group(entry()) as group, clients(group, env):
        batch, _ = group.reset()
        env.on_step = fail
        group.step_async(batch.respond(action=actions(batch)))
        with pytest.raises(EnvRaised, match=r"'robots-0/c0' .* raised in step: ZeroDiv") as caught:
            group.collect_async(deadline=HANG)
        assert "in fail" in caught.value.traceback_text
        env.on_step = lambda: None
        batch, _ = group.reset(env_ids=["robots-0/c0"], seed=4)
        assert batch.observation.tolist() == [[0, 4, 0]]
        group.close()


def test_whom_a_client_blames_is_in_the_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of an env in a worker: `EnvError` has it, and a reset that raises has begun nothing."""
    env = CountingEnv(0)
    with sync.build_env_group(entry()) as group, clients(group, env):
        batch, _ = group.reset()
        env.on_step = raise_once(env)
        with pytest.raises(EnvRaised) as caught:
            group.step(batch.respond(action=actions(batch)))
        monkeypatch.setattr(env, "reset", None)
        with pytest.raises(EnvRaised) as again:
            group.reset(env_ids=["robots-0/c0"])
        group.close()
    outcome = caught.value.outcome
    assert (outcome.kind, outcome.blame) == ("env_raised", "policy")
    assert outcome.cause == "rlightning_aio.errors.EnvError: not there"
    assert (again.value.outcome.kind, again.value.outcome.blame) == ("not_started", "env")


def test_a_client_that_raises_is_reset_where_exceptions_are_borne() -> None:
    """By `on_env_error: restart`; the result is marked, as of an env that is rebuilt."""
    env = CountingEnv(0)
    fields = entry() | {"on_env_error": "restart"}
    with sync.build_env_group(fields) as group, clients(group, env):
        batch, _ = group.reset()
        env.on_step = raise_once(env)
        batch, _ = group.step(batch.respond(action=actions(batch)))
        assert batch.restarted.tolist() == [True]
        assert batch.outcome[0].blame == "policy"
        assert batch.observation.tolist() == [[0, -1, 0]]
        batch, _ = group.step(batch.respond(action=actions(batch)))
        assert (batch.restarted.tolist(), batch.is_reset.tolist()) == ([False], [False])
        assert group.metrics()["envs/restarts"] == 1
        group.close()


def raise_once(env: CountingEnv) -> Callable[[], None]:
    """What an env does in a step that fails by its policy."""

    def fail() -> None:
        env.on_step = lambda: None
        raise EnvError("not there", blame="policy")

    return fail


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


@contextmanager
def client_processes(address: str, count: int, task: str) -> Iterator[list[int]]:
    """Run `count` clients in their own processes; yield the pids."""
    script = Path(__file__).with_name("client_processes.py")
    process = subprocess.Popen(
        [sys.executable, str(script), address, str(count), task],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert process.stdout is not None
    try:
        yield [int(process.stdout.readline()) for _ in range(count)]
    finally:
        process.terminate()
        process.wait(HANG)
        process.stdout.close()


def local_path(task: str, seed: int, actions: np.ndarray[Any, Any]) -> list[Any]:
    """Return the observations of a plain env that is reset in place of the step after an end."""
    import gymnasium as gym

    env = gym.make(task)
    path = [env.reset(seed=seed)[0]]
    ended = False
    for action in actions:
        if ended:
            observation, ended = env.reset()[0], False
        else:
            observation, _, terminated, truncated, _ = env.step(action)
            ended = terminated or truncated
        path.append(observation)
    env.close()
    return path


async def test_trajectories_of_clients_equal_local_ones() -> None:
    """Eight simulators in other processes: same seeds and actions, same bits."""
    count, steps = 8, TRAJECTORY_STEPS // 8
    actions_of = np.random.default_rng(0).uniform(-1, 1, (count, steps, 6)).astype(np.float32)
    expected = {
        f"robots-0/c{k}": local_path("HalfCheetah-v5", 40 + k, actions_of[k]) for k in range(count)
    }
    async with rlightning_aio.build_env_group(entry(count)) as group:
        with client_processes(group["robots-0"].address, count, "HalfCheetah-v5"):
            batch, _ = await group.reset(seed=40)
            seen = dict.fromkeys(expected, 0)
            with group.auto_reset(10**9):
                while min(seen.values()) < steps:
                    ongoing = []
                    for env_id, ret in zip(batch.env_ids(), batch.values(), strict=True):
                        t = seen[env_id]
                        assert np.array_equal(ret.observation, expected[env_id][t])
                        if t < steps:
                            seen[env_id] = t + 1
                            action = actions_of[int(env_id[-1]), t]
                            ongoing.append(rlightning_aio.PolicyResponse(env_id, action))
                    ids = [one.env_id for one in ongoing]
                    group.step_async(rlightning_aio.BatchedData(ids, ongoing))
                    batch, _ = await group.collect_async(deadline=HANG)
            await group.close()


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


def test_calls_of_clients_are_refused() -> None:
    """Before anything is sent; offloading skips them."""
    with (
        sync.build_env_group(entry()) as group,
        clients(group, CountingEnv()),
    ):
        group.reset()
        for call in (
            lambda: group.call("render"),
            lambda: group["robots-0/c0"].get_attr("steps"),
            group.snapshot,
        ):
            with pytest.raises(NotImplementedError, match="clients answer resets and steps only"):
                call()
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
