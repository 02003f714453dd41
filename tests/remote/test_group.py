"""Clients in a group, asynchronous and synchronous."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from kit.counting import ClientThread, CountingEnv
from patience import HANG

import rlightning_aio
from rlightning_aio import BatchedData, registry, sync
from rlightning_aio.errors import (
    BadAction,
    ClientRefused,
    EnvAway,
    EnvError,
    EnvRaised,
    GroupClosed,
    UnknownEnv,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rlightning_aio.types import EnvRet, PolicyResponse

HEARTBEAT = 5.0
"""Seconds; a client that only waits must not count as dead."""
TRAJECTORY_STEPS = int(os.environ.get("RLIGHTNING_AIO_TRAJECTORY_STEPS", "800"))
"""Steps to compare, of all clients together."""


def entry(name: str = "robots", **env_kwargs: Any) -> dict[str, Any]:
    kwargs = {"heartbeat": HEARTBEAT, "connect_timeout": HANG, **env_kwargs}
    return {"name": name, "backend": "env_server", "env_kwargs": kwargs}


CARTPOLE = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 2}


@contextmanager
def clients(group: Any, *envs: CountingEnv, server: str = "robots-0") -> Iterator[list[Any]]:
    """Yield clients c0, c1, … of the envs; they end when the block closes the group."""
    threads = [ClientThread(group[server].address, f"c{k}", env) for k, env in enumerate(envs)]
    yield threads
    for thread in threads:
        thread.join()


def actions(batch: Any) -> np.ndarray[Any, Any]:
    return np.zeros((len(batch), 2), np.float32)


def test_clients_are_reset_with_their_seeds_and_stepped_by_their_names() -> None:
    """The batch has the server's id for each result, and the result has the client's."""
    envs = [CountingEnv(k) for k in range(3)]
    with sync.build_env_group(entry(min_clients=3)) as group, clients(group, *envs):
        batch, flags = group.reset(seed=10)
        assert flags == [False] * 3
        assert batch.ids() == ["robots-0"] * 3
        assert sorted(ret.env_id for ret in batch.values()) == [f"robots-0/c{k}" for k in range(3)]
        assert batch.observation[:, :2].tolist() == [[0, 10], [1, 11], [2, 12]]
        for _ in range(20):
            group.step_async(batch.respond(action=actions(batch)))
            batch, _ = group.collect_async(wait_all=True, deadline=HANG)
        assert batch.observation[:, 2].tolist() == [20] * 3
        group.close()
    assert all(env.disconnects == 1 and env.closed for env in envs)


async def test_an_asynchronous_group_sees_the_same_clients() -> None:
    """With the same results, on either event loop."""
    envs = [CountingEnv(k) for k in range(3)]
    async with rlightning_aio.build_env_group(entry(min_clients=3)) as group:
        with clients(group, *envs):
            batch, _ = await group.reset(seed=10)
            steps = dict.fromkeys(batch.env_ids(), 0)
            for _ in range(60):
                group.step_async(batch.respond(action=actions(batch)))
                batch, _ = await group.collect_async(deadline=HANG)
                for ret in batch.values():
                    steps[ret.env_id] += 1
                    assert ret.observation.tolist()[2] == steps[ret.env_id]
            await group.close()


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


def test_a_step_of_clients_waits_for_their_answers() -> None:
    """In the given order, beside local envs, and by a handle."""
    with (
        sync.build_env_group([entry(min_clients=2), CARTPOLE], mixed_actions=True) as group,
        clients(group, CountingEnv(), CountingEnv()),
    ):
        parts = group.reset()[0].by_entry()
        robots = parts["robots"].respond(action=np.zeros((2, 2), np.float32))
        poles = parts["pole"].respond(action=np.zeros(2, int))
        mixed = BatchedData([*robots.ids(), *poles.ids()], [*robots.values(), *poles.values()])
        for count in (1.0, 2.0):
            batch, flags = group.step(mixed)
            assert batch.env_ids() == [*robots.env_ids(), "pole-0", "pole-1"]
            assert flags is None
            seen = [ret.observation.tolist()[2] for ret in batch.values()[:2]]
            assert seen == [count] * 2
        ret = group["robots-0"].step(robots.values()[1])
        assert (ret.env_id, ret.observation.tolist()[2]) == (robots.env_ids()[1], 3.0)
        group.close()


def test_a_step_of_a_client_that_is_lost_ends_with_a_marked_result() -> None:
    """The caller that waits isn't left waiting."""
    robot = CountingEnv()
    with sync.build_env_group(entry()) as group, clients(group, robot):
        batch, _ = group.reset()
        robot.finished = True
        batch, _ = group.step(batch.respond(action=actions(batch)))
        assert batch.truncated.tolist() == [True]
        assert "client_lost" in batch.info()[0]
        group.close()


def test_options_that_cannot_be_sent_to_a_client_are_refused_before_anything_is_sent() -> None:
    """Although local envs would accept them; all envs can be reset again."""
    with (
        sync.build_env_group([CARTPOLE, entry()], mixed_actions=True) as group,
        clients(group, CountingEnv()),
    ):
        group.reset()
        for reset in (group.reset, group.reset_async, group["robots-0"].reset):
            with pytest.raises(TypeError, match=r"reset of robots-0/c0: .*; nothing was sent"):
                reset(options={"goal": object()})
        batch, _ = group.reset(options={"goal": 1})
        assert len(batch) == 3
        group.close()


def test_extras_that_are_too_large_together_are_refused_before_anything_is_sent() -> None:
    """Although each of them alone is small enough; the clients can be stepped with less."""
    large = ["x" * (3 << 20)] * 2
    with (
        sync.build_env_group(entry(min_clients=2)) as group,
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
    """However many clients have joined."""
    with (
        sync.build_env_group([CARTPOLE, entry(min_clients=2)], mixed_actions=True) as group,
        clients(group, CountingEnv(), CountingEnv()),
    ):
        group.reset()
        assert (len(group), group.size()) == (3, 2)
        assert group.env_ids == ["pole-0", "pole-1", "robots-0"]
        group.close()


def test_a_client_with_other_actions_than_the_local_envs_is_refused() -> None:
    """It receives the reason; the group waits for one that fits."""
    with sync.build_env_group([CARTPOLE, entry(connect_timeout=0.2)]) as group:
        other = ClientThread(group["robots-0"].address, "c0")
        while other.error is None:
            with pytest.raises(TimeoutError, match="0 of 1 clients"):
                group.reset()
        group.close()
        with pytest.raises(ClientRefused, match="different action spaces"):
            other.join()


def test_local_envs_and_clients_mix_in_one_batch() -> None:
    """First ready, first served; by_entry() makes stackable parts."""
    envs = [CountingEnv(k) for k in range(2)]
    seen: dict[str, int] = {}
    with (
        sync.build_env_group([CARTPOLE, entry(min_clients=2)], mixed_actions=True) as group,
        clients(group, *envs),
    ):
        batch, _ = group.reset(seed=0)
        # On a busy machine a worker may not run for a while.
        for _ in range(20_000):
            for name, part in batch.by_entry().items():
                for ret in part.values():
                    seen[ret.env_id] = seen.get(ret.env_id, 0) + 1
                action = actions(part) if name == "robots" else np.zeros(len(part), np.int64)
                group.step_async(part.respond(action=action))
            batch, _ = group.collect_async(deadline=HANG)
            if len(seen) == 4 and min(seen.values()) > 1:
                break
        group.close()
    assert set(seen) == {"pole-0", "pole-1", "robots-0/c0", "robots-0/c1"}
    assert min(seen.values()) > 1


def test_a_reset_waits_for_min_clients_and_no_longer_than_connect_timeout() -> None:
    """The message has the number of clients and the address."""
    with (
        sync.build_env_group(entry(min_clients=2, connect_timeout=0.3)) as group,
        clients(group, CountingEnv()),
        ExitStack() as stack,
    ):
        stack.callback(group.close)
        with pytest.raises(TimeoutError, match=r"of 2 clients have joined.*tcp://127\.0\.0\.1:"):
            group.reset()


def test_a_reset_without_seed_takes_the_reset_that_comes_with_joining() -> None:
    """A robot that has just been reset isn't reset again."""
    env = CountingEnv()
    with sync.build_env_group(entry()) as group, clients(group, env):
        group.reset()
        assert env.resets == 1
        group.reset(seed=3)
        assert (env.resets, env.seed) == (2, 3)
        group.close()


def test_a_client_that_joins_a_running_group_is_collected() -> None:
    """Its first result answers no request; then it is an env like the others."""
    with (
        sync.build_env_group(entry()) as group,
        clients(group, CountingEnv(7), CountingEnv(8)),
    ):
        batch, _ = group.reset()
        seen: set[str] = set()
        while len(seen) < 2:
            seen.update(ret.env_id for ret in batch.values())
            group.step_async(batch.respond(action=actions(batch)))
            batch, _ = group.collect_async(deadline=HANG)
        group.close()


def test_a_server_without_clients_does_not_disturb_the_next_one() -> None:
    """Actions reach their clients, whatever is attached to them."""

    class Telling(CountingEnv):
        def step(self, policy_resp: PolicyResponse) -> EnvRet:
            ret = super().step(policy_resp)
            ret.last_reward = float(policy_resp.action[0])
            return ret

    with (
        sync.build_env_group([entry("early"), entry("late")]) as group,
        clients(group, Telling(), server="late-0"),
    ):
        batch, _ = group.collect_async(deadline=HANG)
        for step, extras in enumerate(({}, {"value": np.zeros(1)}), start=1):
            action = np.full((1, 2), step / 4, np.float32)
            group.step_async(batch.respond(action=action, **extras))
            batch, _ = group.collect_async(deadline=HANG)
            assert batch.observation[0, 2] == step
            assert batch.reward.tolist() == [step / 4]
        group.close()


def test_a_client_that_finishes_leaves_one_marked_result_and_no_hang() -> None:
    """One step of the client that left is answered; then the others continue alone."""
    leaver, stayer = CountingEnv(0), CountingEnv(1)

    def leave_after_three() -> None:
        leaver.finished = leaver.steps == 2

    leaver.on_step = leave_after_three
    marked: list[Any] = []
    with (
        sync.build_env_group(entry(min_clients=2)) as group,
        clients(group, leaver, stayer),
    ):
        batch, _ = group.reset()
        for _ in range(50):
            group.step_async(batch.respond(action=actions(batch)))
            batch, _ = group.collect_async(deadline=HANG)
            marked += [ret for ret in batch.values() if "client_lost" in ret.info]
        group.close()
    (ret,) = marked
    assert ret.env_id == "robots-0/c0"
    assert ret.last_truncated
    assert ret.observation.tolist() == [0, -1, 3]
    assert "the env is finished" in ret.info["client_lost"]


def test_a_client_that_returns_starts_a_new_episode() -> None:
    """The trainer sees the end of the old episode first."""
    with sync.build_env_group(entry()) as group:
        address = group["robots-0"].address
        with clients(group, env := CountingEnv(0)):
            batch, _ = group.reset()
            env.on_step = lambda: setattr(env, "finished", True)
            group.step_async(batch.respond(action=actions(batch)))
            batch, _ = group.collect_async(deadline=HANG)
        again = ClientThread(address, "c0", CountingEnv(5))
        infos: list[dict[str, Any]] = []
        while not np.array_equal(batch.observation[0], [5, -1, 3]):
            group.step_async(batch.respond(action=actions(batch)))
            batch, _ = group.collect_async(deadline=HANG)
            infos += batch.info()
        assert sum("client_lost" in info for info in infos) == 1
        group.close()
        again.join()


def test_first_results_have_columns_for_what_was_sent_and_hold_nothing() -> None:
    """Also before the first response, and for a client that joins while another is stepped."""
    with (
        sync.build_env_group([entry(), entry("others")]) as group,
        clients(group, CountingEnv(0)),
    ):
        batch, _ = group.collect_async(deadline=HANG)
        assert batch.sent.action.shape == (1, 2)
        assert batch.sent.action.dtype == np.float32
        assert np.isnan(batch.sent.action).all()
        sent = batch.respond(action=actions(batch), log_prob=np.array([[0.5, 1.0]]), tag=["a"])
        group.step_async(sent)
        assert list(batch.sent) == ["action"]
        answer, _ = group.collect_async(deadline=HANG)
        assert answer.sent.log_prob.tolist() == [[0.5, 1.0]]
        with clients(group, CountingEnv(1), server="others-0"):
            joined, _ = group.collect_async(deadline=HANG)
            assert joined.ids() == ["others-0"]
            assert np.isnan(joined.sent.action).all()
            group.close()
        assert list(answer.sent) == ["action", "log_prob", "tag"]


def test_the_first_result_after_a_loss_carries_what_was_sent_while_the_client_was_away() -> None:
    """The marked result carries what was sent before; a reset that follows carries nothing."""
    with sync.build_env_group(entry()) as group:
        with clients(group, env := CountingEnv(0)):
            batch, _ = group.reset()
            env.on_step = lambda: setattr(env, "finished", True)
            while "client_lost" not in batch.info()[0]:
                group.step_async(batch.respond(action=actions(batch), tag=["before"]))
                batch, _ = group.collect_async(deadline=HANG)
        assert batch.sent.tag == ["before"]
        group.step_async(batch.respond(action=actions(batch), tag=["while away"]))
        with clients(group, env := CountingEnv(1)):
            batch, _ = group.collect_async(deadline=HANG)
            assert batch.observation.tolist() == [[1, -1, 0]]
            assert batch.sent.tag == ["while away"]
            batch, _ = group.reset(seed=1)
            assert batch.sent.tag == [None]
            group.close()


def test_a_client_that_takes_the_slot_of_another_takes_nothing_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Earlier batches, handles and statistics still name the earlier client."""
    place = replace(registry.placement_of("env_server", "process"), max_members=1)
    monkeypatch.setitem(registry._PLACED_BY_BACKEND, "env_server", place)
    with sync.build_env_group(entry()) as group:
        address = group["robots-0"].address
        with clients(group, env := CountingEnv(0)), group.auto_reset(2):
            first, _ = group.reset()
            group.step_async(first.respond(action=actions(first)))
            batch, _ = group.collect_async(deadline=HANG)
            env.on_step = lambda: setattr(env, "finished", True)
            group.step_async(batch.respond(action=actions(batch)))
            held, _ = group.collect_async(deadline=HANG)
        handle = group["robots-0/c0"]
        before = group.get_env_stats()["robots-0/c0"]
        assert (before["episodes"], before["mean_return"]) == (1, 3.0)
        other = ClientThread(address, "other", CountingEnv(5))
        batch, _ = group.collect_async(deadline=HANG)
        assert held.env_ids() == ["robots-0/c0"]
        assert held.values()[0].env_id == "robots-0/c0"
        assert batch.env_ids() == ["robots-0/other"]
        # Responses to the old client do not step the new one.
        for answered in (held, first):
            group.step_async(answered.respond(action=actions(answered)))
        with pytest.raises(UnknownEnv, match="robots-0/c0"):
            handle.step(np.zeros(2))
        with pytest.raises(UnknownEnv, match="robots-0/c0"):
            handle.call("get_wrapper_attr")
        group.step_async(batch.respond(action=actions(batch)))
        batch, _ = group.collect_async(deadline=HANG)
        assert batch.observation.tolist() == [[5, -1, 1]]
        # The sums are those of the place; the first result is one, too.
        ((env_id, after),) = group.get_env_stats().items()
        assert env_id == "robots-0/other"
        assert (after["episodes"], after["results"]) == (1, before["results"] + 2)
        group.close()
        other.join()


def test_a_response_to_a_client_that_is_away_disturbs_no_other() -> None:
    """Another client is stepped in the same call."""
    with sync.build_env_group(entry()) as group:
        address = group["robots-0"].address
        with clients(group, env := CountingEnv(0)):
            batch, _ = group.reset()
            env.on_step = lambda: setattr(env, "finished", True)
            while "client_lost" not in batch.info()[0]:
                group.step_async(batch.respond(action=actions(batch)))
                batch, _ = group.collect_async(deadline=HANG)
        other = ClientThread(address, "other", CountingEnv(5))
        joined, _ = group.collect_async(deadline=HANG)
        env_ids = [*batch.env_ids(), *joined.env_ids()]
        assert env_ids == ["robots-0/c0", "robots-0/other"]
        responses = [
            rlightning_aio.PolicyResponse(env_id, np.zeros(2, np.float32)) for env_id in env_ids
        ]
        group.step_async(rlightning_aio.BatchedData(["robots-0"] * 2, responses))
        batch, _ = group.collect_async(wait_all=True, deadline=HANG)
        assert batch.observation.tolist() == [[5, -1, 1]]
        with pytest.raises(EnvAway, match="robots-0/c0"):
            group.reset(env_ids=["robots-0/c0"])
        group.close()
        other.join()


async def test_a_client_that_returns_while_the_trainer_thinks_is_no_error() -> None:
    """A response to the last result of the old session does not step the new one."""
    async with rlightning_aio.build_env_group(entry()) as group:
        address = group["robots-0"].address
        with clients(group, env := CountingEnv(0)):
            batch, _ = await group.reset()
            env.on_step = lambda: setattr(env, "finished", True)
            group.step_async(batch.respond(action=actions(batch)))
            batch, _ = await group.collect_async(deadline=HANG)
        group.step_async(batch.respond(action=actions(batch)))
        marked, _ = await group.collect_async(deadline=HANG)
        assert "client_lost" in marked.info()[0]
        again = ClientThread(address, "c0", CountingEnv(5))
        async with asyncio.timeout(HANG):
            # The trainer is busy while the event loop runs.
            while not group["robots-0"].clients:  # noqa: ASYNC110  # There is no event for it.
                await asyncio.sleep(0)
        group.step_async(marked.respond(action=actions(marked), tag=["while back"]))
        batch, _ = await group.collect_async(deadline=HANG)
        assert batch.observation.tolist() == [[5, -1, 0]]
        assert batch.sent.tag == ["while back"]
        group.step_async(batch.respond(action=actions(batch)))
        batch, _ = await group.collect_async(deadline=HANG)
        assert batch.observation.tolist() == [[5, -1, 1]]
        await group.close()
        again.join()


async def test_a_step_of_a_client_that_is_back_returns_its_first_result() -> None:
    """Beside the results of others, in the given order, or by a handle."""
    leaver = CountingEnv(0)
    leaver.on_step = lambda: setattr(leaver, "finished", True)
    async with rlightning_aio.build_env_group(entry(min_clients=2)) as group:
        server = group["robots-0"]
        with clients(group, leaver, stays := CountingEnv(1)) as threads:
            batch, _ = await group.reset(seed=0)
            for back in (5, 6):
                batch, _ = await group.step(batch.respond(action=actions(batch)))
                threads[0].join()
                lost, _ = await group.step(batch.respond(action=actions(batch)))
                assert lost.restarted.tolist() == [True, False]
                threads[0] = ClientThread(server.address, "c0", again := CountingEnv(back))
                async with asyncio.timeout(HANG):
                    while len(server.clients) < 2:  # noqa: ASYNC110  # There is no event for it.
                        await asyncio.sleep(0)
                if back == 6:
                    ret = await group["robots-0/c0"].step(np.zeros(2, np.float32))
                    assert ret.observation.tolist() == [6, -1, 0]
                    break
                batch, _ = await group.step(lost.respond(action=actions(lost), tag=["a", "b"]))
                assert batch.env_ids() == lost.env_ids()
                assert batch.observation.tolist() == [[5, -1, 0], [1, 1, stays.steps]]
                assert batch.is_reset.tolist() == [True, False]
                assert batch.sent.tag == ["a", "b"]
                again.on_step = lambda again=again: setattr(again, "finished", True)
            assert group.pending == []
            await group.close()


async def test_a_client_that_returns_before_its_loss_is_collected_waits_its_turn() -> None:
    """The marked result comes first, then the first result of the new session."""

    def leave() -> None:
        raise SystemExit

    async with rlightning_aio.build_env_group(entry()) as group:
        address = group["robots-0"].address
        gone = ClientThread(address, "c0", CountingEnv(0, on_step=leave))
        batch, _ = await group.reset()
        group.step_async(batch.respond(action=actions(batch)))
        with pytest.raises(SystemExit):
            await asyncio.to_thread(gone.join)
        again = ClientThread(address, "c0", CountingEnv(5))
        async with asyncio.timeout(HANG):
            # Nothing is collected while the event loop runs.
            while not group["robots-0"].clients:  # noqa: ASYNC110  # There is no event for it.
                await asyncio.sleep(0)
        lost, _ = await group.collect_async(deadline=HANG)
        assert lost.observation.tolist() == [[0, -1, 0]]
        assert "client_lost" in lost.info()[0]
        assert lost.is_reset.all()
        assert lost.restarted.all()
        first, _ = await group.collect_async(deadline=HANG)
        assert first.observation.tolist() == [[5, -1, 0]]
        assert first.is_reset.all()
        assert not first.restarted.any()
        await group.close()
        again.join()


async def test_a_client_that_returns_before_its_absence_is_raised_joins() -> None:
    """Its first result waits until the call that asks it has ended."""
    go_on = threading.Event()
    slow, leaver = CountingEnv(0), CountingEnv(1)
    leaver.on_step = lambda: setattr(leaver, "finished", True)
    async with rlightning_aio.build_env_group(entry(min_clients=2)) as group:
        server, address = group["robots-0"], group["robots-0"].address
        with clients(group, slow, leaver) as threads:
            batch, _ = await group.reset()
            last = batch.env_ids().index("robots-0/c1")
            group.step_async(batch.take([last]).respond(action=np.zeros((1, 2), np.float32)))
            (step, _) = await group.collect_async(deadline=HANG)
            threads[1].join()
            lost, _ = await group.step(step.respond(action=actions(step)))
            assert "client_lost" in lost.info()[0]
            slow.on_step = lambda: go_on.wait(HANG)
            stepping = asyncio.create_task(group.step(batch.respond(action=actions(batch))))
            await asyncio.sleep(0)
            again = ClientThread(address, "c1", CountingEnv(5))
            async with asyncio.timeout(HANG):
                while len(server.clients) < 2:  # noqa: ASYNC110  # There is no event for it.
                    await asyncio.sleep(0)
            go_on.set()
            with pytest.raises(EnvAway, match="robots-0/c1") as caught:
                await stepping
            assert caught.value.results is not None
            assert caught.value.results.env_ids() == ["robots-0/c0"]
            first, _ = await group.collect_async(deadline=HANG)
            assert first.observation.tolist() == [[5, -1, 0]]
            await group.close()
        again.join()


def test_a_client_that_joins_changes_no_result_that_was_returned() -> None:
    """Although nobody has asked it, and observations are views."""
    with sync.build_env_group(entry(), zero_copy=True) as group:
        with clients(group, env := CountingEnv(0)):
            batch, _ = group.reset()
            env.on_step = lambda: setattr(env, "finished", True)
            group.step(batch.respond(action=actions(batch)))
            lost, _ = group.step(batch.respond(action=actions(batch)))
        again = ClientThread(group["robots-0"].address, "c0", CountingEnv(5))
        first, _ = group.collect_async(deadline=HANG)
        assert lost.observation.tolist() == [[0, -1, 1]]
        assert first.observation.tolist() == [[5, -1, 0]]
        group.close()
        again.join()


async def test_closing_a_group_ends_a_collect_that_waits_for_clients() -> None:
    """With time limits it checks all hosts again, although the env_server is gone by then."""
    released = threading.Event()
    env = CountingEnv(on_step=lambda: released.wait(HANG))
    timed = {**CARTPOLE, "num_workers": 1, "step_timeout": HANG}
    async with rlightning_aio.build_env_group([timed, entry()], mixed_actions=True) as group:
        with clients(group, env):
            batch, _ = await group.reset(env_ids=None)
            theirs = batch.by_entry()["robots"]
            group.step_async(theirs.respond(action=actions(theirs)))
            collecting = asyncio.create_task(group.collect_async())
            await asyncio.sleep(0)
            await group.close()
            with pytest.raises(GroupClosed):
                await collecting
            released.set()


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


def test_auto_reset_reaches_clients() -> None:
    """A limit of 3 gives a period of 4 calls."""
    with sync.build_env_group(entry()) as group, clients(group, CountingEnv(0)):
        batch, _ = group.reset()
        steps, flags = [], []
        with group.auto_reset(max_episode_steps=3):
            for _ in range(8):
                group.step_async(batch.respond(action=actions(batch)))
                batch, truncations = group.collect_async(deadline=HANG)
                steps.append(int(batch.observation[0, 2]))
                flags += truncations
        assert steps == [1, 2, 3, 0, 1, 2, 3, 0]
        assert flags == [False, False, True, False] * 2
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
    async with rlightning_aio.build_env_group(entry(min_clients=count)) as group:
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
                    ids = ["robots-0"] * len(ongoing)
                    group.step_async(rlightning_aio.BatchedData(ids, ongoing))
                    batch, _ = await group.collect_async(deadline=HANG)
            await group.close()


@pytest.mark.parametrize("signal_name", ["SIGKILL", "SIGSTOP"])
def test_a_client_process_that_dies_or_stops_is_found(
    signal_name: str,
) -> None:
    """Its request ends in one marked result; the other client continues."""
    import signal

    with (
        sync.build_env_group(entry(min_clients=2)) as group,
        client_processes(group["robots-0"].address, 2, "CartPole-v1") as pids,
    ):
        batch, _ = group.reset(seed=0)
        os.kill(pids[0], getattr(signal, signal_name))
        lost: list[Any] = []
        steps = 0
        while not lost or steps <= 10:
            if steps < 20:  # Then only the lost client is waited for.
                group.step_async(batch.respond(action=np.zeros(len(batch), np.int64)))
            batch, _ = group.collect_async(deadline=HANG)
            lost += [ret for ret in batch.values() if "client_lost" in ret.info]
            steps += sum("client_lost" not in ret.info for ret in batch.values())
        os.kill(pids[0], signal.SIGKILL)
        group.close()
    assert lost[0].env_id == "robots-0/c0"
    assert len(lost) == 1
    assert lost[0].last_truncated


def test_an_aborted_request_costs_its_client_the_session() -> None:
    """The env of the client comes to a safe stop, and joins again when its step has ended."""
    go_on = threading.Event()
    slow, quick = CountingEnv(0, on_step=lambda: go_on.wait(HANG)), CountingEnv(1)
    slow.stays = True
    with sync.build_env_group(entry(min_clients=2)) as group, clients(group, slow, quick):
        batch, _ = group.reset(seed=10)
        group.step_async(batch.respond(action=actions(batch)))
        (aborted,) = [ret.env_id for ret in batch.values() if ret.observation[0] == 0]
        group.abort([aborted])
        batch, _ = group.collect_async(wait_all=True, deadline=HANG)
        assert batch.observation.tolist() == [[1, 11, 1]]
        assert group.pending == []
        assert (slow.disconnects, slow.steps) == (0, 0)
        go_on.set()
        batch, _ = group.collect_async(deadline=HANG)
        assert batch.env_ids() == [aborted]
        assert (batch.is_reset.tolist(), batch.restarted.tolist()) == ([True], [False])
        assert (slow.disconnects, slow.steps) == (1, 0)
        group.step_async(batch.respond(action=actions(batch)))
        batch, _ = group.drain(deadline=HANG)
        assert batch.observation.tolist() == [[0, -1, 1]]
        slow.stays = False
        group.close()
