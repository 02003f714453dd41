"""Resets, steps, handles and errors, in every placement and with every driver."""

from __future__ import annotations

import copy
import pickle
import time
from typing import Any

import numpy as np
import pytest

from rlightning_aio import (
    BadAction,
    BatchedData,
    EnvBusy,
    EnvRaised,
    EnvRet,
    NothingPending,
    PolicyResponse,
    UnknownEnv,
)
from rlightning_aio.batch import joined

# For decisions before any wait, and for handling results that have come.
one_driver = pytest.mark.one_driver_for_each_place

DO_NOTHING, END, TRUNCATE, RAISE = range(4)
ENTRY = {"name": "probe", "backend": "probe", "task": "x", "num_workers": 4}
IDS = [f"probe-{k}" for k in range(4)]


def actions(*rewards: float, what: int = DO_NOTHING) -> np.ndarray:
    return np.array([[what, reward] for reward in rewards])


def responses(ids: list[str], *rewards: float, what: int = DO_NOTHING) -> BatchedData:
    return BatchedData(
        ids,
        [PolicyResponse(id_, np.array([what, r])) for id_, r in zip(ids, rewards, strict=True)],
    )


@one_driver
async def test_init_describes_every_env_in_order(start: Any) -> None:
    """Ids, spaces and counts, before any reset; a second call returns the same."""
    group = await start([ENTRY, {**ENTRY, "name": "more", "num_workers": 1}])
    metas = await group.init()
    assert [meta.env_id for meta in metas] == group.env_ids == [*IDS, "more-0"]
    assert len(group) == group.size() == 5
    assert [space.shape for space in group.get_observation_spaces()] == [(4,)] * 5
    assert [space.shape for space in group.get_action_spaces()] == [(2,)] * 5
    assert {(meta.num_envs, meta.agents, meta.max_episode_steps) for meta in metas} == {
        (1, (), None)
    }


@one_driver
async def test_seeds_are_an_int_or_a_list(start: Any) -> None:
    """An int counts over the whole group, whichever envs are reset."""
    group = await start(ENTRY)

    async def seeds(**how: Any) -> list[float]:
        batch, _ = await group.reset(**how)
        return batch.observation[:, 3].tolist()

    assert await seeds(seed=100) == [100, 101, 102, 103]
    assert await seeds(seed=100, env_ids=["probe-2", "probe-0"]) == [102, 100]
    assert await seeds(seed=np.int64(7), env_ids=["probe-1"]) == [8]
    assert await seeds(seed=[4, 3, 2, 1]) == [4, 3, 2, 1]
    assert await seeds(seed=(9, 8), env_ids=["probe-3", "probe-1"]) == [9, 8]
    assert await seeds(seed=np.array([5, 6, 7, 8])) == [5, 6, 7, 8]
    assert await seeds(seed={"probe-1": 3}) == [-1, 3, -1, -1]
    assert await seeds(seed={"probe-3": 0}, env_ids=["probe-3"]) == [0]
    with pytest.raises(UnknownEnv, match="'nobody'"):
        await group.reset(seed={"nobody": 1})
    before, _ = await group.reset()
    wrong = (-2, [0, 1, 2, -2], {"probe-0": -2}, 1.5, [0.5] * 4, True, "0123", [None] * 4, 2**63)
    for seed in wrong:
        with pytest.raises(ValueError, match="the seed must be an int from 0"):
            await group.reset(seed=seed)
    with pytest.raises(ValueError, match="3 seeds for 4 envs"):
        await group.reset(seed=[1, 2, 3])
    batch, flags = await group.reset(env_ids=[])
    assert (len(batch), flags) == (0, [])
    batch, _ = await group.reset()
    assert batch.observation[:, 3].tolist() == [-1] * 4
    assert (batch.observation[:, 1] == before.observation[:, 1] + 1).all(), "nothing was sent"


@one_driver
async def test_options_reach_every_env_of_a_reset(start: Any) -> None:
    """Together with its seed."""
    group = await start(ENTRY)
    batch, _ = await group.reset(seed=3, options={"pose": [1, 2]})
    assert batch.info() == [{"options": {"pose": [1, 2]}}] * 4
    assert batch.observation[:, 3].tolist() == [3, 4, 5, 6]
    assert (await group.reset(options={}))[0].info() == [{"options": {}}] * 4


async def test_a_step_returns_the_same_ids_in_the_same_order(start: Any) -> None:
    """For columns and single responses, for all envs and some; there are no flags."""
    group = await start(ENTRY)
    batch, _ = await group.reset()
    batch, flags = await group.step(batch.respond(action=actions(1, 2, 3, 4)))
    assert flags is None
    assert (batch.ids(), batch.reward.tolist()) == (IDS, [1, 2, 3, 4])
    some = ["probe-2", "probe-0"]
    batch, flags = await group.step(responses(some, 7, 8))
    assert flags is None
    assert (batch.ids(), batch.reward.tolist()) == (some, [7, 8])
    assert batch.observation[:, 2].tolist() == [2, 2]
    batch, _ = await group.step(batch.respond(action=actions(5, 6)))
    assert (batch.ids(), batch.reward.tolist()) == (some, [5, 6])
    by_hand = BatchedData.from_dict({"probe-1": PolicyResponse("probe-1", [0, 9])})
    assert (await group.step(by_hand))[0].reward.tolist() == [9]


@one_driver
async def test_flags_extras_and_times_of_a_result(start: Any) -> None:
    """Each part of an `EnvRet` arrives as the env returned it."""
    group = await start(ENTRY)
    batch, _ = await group.reset()
    batch, _ = await group.step(responses(["probe-0", "probe-1"], 0.5, 1.5, what=END))
    assert (batch.terminated.tolist(), batch.truncated.tolist()) == ([True] * 2, [False] * 2)
    batch, _ = await group.step(responses(["probe-0", "probe-1"], 0.5, 1.5, what=TRUNCATE))
    assert (batch.terminated.tolist(), batch.truncated.tolist()) == ([False] * 2, [True] * 2)
    ret = batch["probe-1"]
    assert isinstance(ret, EnvRet)
    assert (ret.env_id, ret.last_reward, ret._extra) == ("probe-1", 1.5, {"steps": 2})
    assert abs(ret.ts_env_sent_ns - time.time_ns()) < 60e9


@one_driver
async def test_a_bad_batch_is_refused_as_a_whole(start: Any) -> None:
    """Nothing is sent: no env has moved, and each can be stepped afterwards."""
    group = await start(ENTRY)
    batch, _ = await group.reset()
    good = actions(1, 2, 3, 4)
    for bad, error, said in (
        (batch.respond(action=np.zeros((4, 3))), BadAction, r"\(4, 2\).*\(4, 3\)"),
        (batch.respond(action=good.astype(complex)), BadAction, "float64.*complex128"),
        (batch.respond(action=[[0, 1], [0, 1], [0, 1], [0]]), BadAction, "not an array"),
        (batch.respond(action=np.full((4, 2), "x")), BadAction, "float64, found .* dtype <U1"),
        (batch.respond(action=[None] * 4), BadAction, "found .* dtype object"),
        (np.zeros((4, 2)), BadAction, r"not a \w+: .*batch.respond\(action=...\)"),
        (None, BadAction, r"not a \w+: .*batch.respond\(action=...\)"),
        ([PolicyResponse("probe-0", [0, 1])], BadAction, r"not a \w+: .*batch.respond"),
        (responses([*IDS, "probe-9"], 1, 2, 3, 4, 5), UnknownEnv, "'probe-9'.*probe-0"),
        (responses([*IDS, "probe-1"], 1, 2, 3, 4, 5), EnvBusy, "'probe-1' appears twice"),
        (batch.take([1, 1]).respond(action=good[:2]), EnvBusy, "'probe-1' appears twice"),
        (batch.respond(action=good).take([0, 2, -4]), EnvBusy, "'probe-0' appears twice"),
        (joined([batch, batch]).respond(action=[*good, *good]), EnvBusy, "'probe-0' appears twice"),
        (BatchedData(IDS[:2], [PolicyResponse("probe-0", [0, 1]), 3]), BadAction, "int"),
        (
            BatchedData(IDS[:1], [PolicyResponse("probe-1", [0, 1])]),
            BadAction,
            "under the id 'probe-0' there is a response of 'probe-1'",
        ),
        (
            BatchedData(IDS[:2], [PolicyResponse("probe-0", [0, 1]), PolicyResponse("probe-1")]),
            BadAction,
            r"'probe-1' .*task 'x'.*\(2,\).*\(\)",
        ),
    ):
        with pytest.raises(error, match=said):
            group.step_async(bad)
        with pytest.raises(error, match=said):
            await group.step(bad)
    for count in (0, 3, 5):  # Refused where it is attached.
        with pytest.raises(BadAction, match="action"):
            batch.respond(action=np.zeros((count, 2)))
    with pytest.raises(BadAction, match="no column can be called 'env_id'"):
        batch.respond(action=good, env_id=IDS)
    with pytest.raises(BadAction, match=r"'probe-0' there is a response of 'probe-1'.* handle"):
        await group["probe-0"].step(PolicyResponse("probe-1", [0, 1]))
    for ids, error, said in (
        ([*IDS, "probe-9"], UnknownEnv, "'probe-9'; its envs are probe-0, probe-1"),
        ([*IDS, "probe-1"], EnvBusy, "'probe-1' appears twice"),
    ):
        with pytest.raises(error, match=said):
            await group.reset(env_ids=ids)
    with pytest.raises(UnknownEnv, match="probe-9"):
        _ = group["probe-9"]
    batch, _ = await group.step(batch.respond(action=good))
    assert batch.observation[:, 2].tolist() == [1] * 4


async def until_replied(group: Any, env_id: str, other: str) -> None:
    """Have the group read the reply of an env, by steps of another one, without collecting it."""
    while any(env_id in worker["owed"] for worker in group.get_workers()):
        await group.step(responses([other], 1))


@one_driver
async def test_an_abort_frees_an_env_whose_error_was_not_collected(start: Any) -> None:
    """The error is still raised by the next collect."""
    group = await start(ENTRY)
    await group.reset()
    group.step_async(responses(["probe-1"], 1, what=RAISE))
    await until_replied(group, "probe-1", "probe-2")
    await group.abort(["probe-1"])
    assert group.pending == []
    group.step_async(responses(["probe-1"], 1))
    assert group.pending == ["probe-1"]
    with pytest.raises(EnvRaised, match="'probe-1'"):
        await group.collect_async()
    batch, _ = await group.collect_async()
    assert batch.ids() == ["probe-1"]
    assert batch.restarted.tolist() == [True]
    with pytest.raises(NothingPending):
        await group.collect_async()


@one_driver
async def test_a_handle_is_one_env(start: Any) -> None:
    """It resets, steps and calls methods, with single actions and its own seeds."""
    group = await start(ENTRY)
    env = group["probe-2"]
    assert env.env_id == "probe-2"
    ret = await env.reset(seed=9, options={"a": 1})
    assert ret.observation.tolist() == [2, 1, 0, 9]
    assert ret.info == {"options": {"a": 1}}
    ret = await env.step([0, 3.5])
    assert (ret.env_id, ret.last_reward) == ("probe-2", 3.5)
    ret = await env.step(PolicyResponse("probe-2", [0, 4.5], tag=1))
    assert (ret.last_reward, ret.info) == (4.5, {"extras": {"tag": 1}})
    assert await env.call("double", 4) == 8
    assert await env.call("double", "ab", times=3) == "ababab"
    assert await env.call("stack") == "wrapped"
    assert await env.call("weigh", 2) == 6, "an attribute of the simulator, inside two wrappers"
    with pytest.raises(EnvRaised, match=r"nor its simulator.*has no_such_method\(\)"):
        await env.call("no_such_method")
    with pytest.raises(UnknownEnv, match="'probe-9'"):
        group["probe-9"]


@one_driver
async def test_a_method_of_many_envs_is_called_at_once(start: Any) -> None:
    """Values are in the order of the ids; errors are those of all envs."""
    group = await start(ENTRY)
    assert await group.call("double", 4) == [8] * 4
    assert await group.call("double", "ab", env_ids=IDS[:1:-1], times=3) == ["ababab"] * 2
    with pytest.raises(EnvBusy, match="probe-3"):
        await group.call("double", 1, env_ids=["probe-3", "probe-3"])
    with pytest.raises(UnknownEnv, match="probe_3"):
        await group.call("double", 1, env_ids=["probe_3"])
    with pytest.raises(EnvRaised, match=r"in the call of double\(\)") as caught:
        await group.call("double", "ab", times="ab")
    assert sorted(error.env_id for error in (caught.value, *caught.value.others)) == IDS
    await group.call("set_attr", "episodes", 7, env_ids=["probe-2"])
    assert await group.call("get_attr", "episodes") == [0, 0, 7, 0]


@one_driver
async def test_attributes_are_found_from_the_outside_in(start: Any) -> None:
    """A value is set where it is found, or else of the simulator, when the call returns."""
    group = await start(ENTRY)
    env = group["probe-1"]
    assert await env.get_attr("label") == "outer"
    assert await env.get_attr("depth") == 2
    await env.set_attr("label", ["newer"])
    assert await env.get_attr("label") == ["newer"]
    assert await group["probe-0"].get_attr("label") == "outer"
    await env.set_attr("other", 1)
    assert await env.get_attr("other") == 1
    with pytest.raises(EnvRaised, match="no_such"):
        await env.get_attr("no_such")


@one_driver
async def test_frames_memory_and_what_has_none(start: Any) -> None:
    """`render` returns a frame; offload and reload reach every env, or name one without them."""
    others = {**ENTRY, "name": "b", "backend": "batched"}
    group = await start([{**ENTRY, "num_workers": 2}, others], mixed_actions=True)
    frame = await group["probe-0"].render()
    assert (frame.dtype, frame.tolist()) == (np.uint8, np.full((2, 2, 3), 7).tolist())
    await group["probe-1"].offload()
    assert [await group[id_].call("__getattribute__", "offloaded") for id_ in IDS[:2]] == [
        False,
        True,
    ]
    await group["probe-1"].reload()
    with pytest.raises(
        EnvRaised, match=r"'b-.* of offload\(\).*NotImplementedError.*no offload"
    ) as caught:
        await group.offload()
    assert len(caught.value.others) == 3
    assert await group["probe-0"].call("__getattribute__", "offloaded") is True


@one_driver
async def test_results_are_never_overwritten(start: Any) -> None:
    """Neither arrays nor infos, even if envs return the same objects each time."""
    group = await start(
        [ENTRY, {**ENTRY, "name": "reusing", "backend": "reusing"}], mixed_actions=True
    )
    first, _ = await group.reset()
    probes, others = first.by_entry().values()
    before = probes.observation.copy()
    infos = others.info()
    values = others.values()
    for _ in range(3):
        await group.step(probes.respond(action=actions(1, 2, 3, 4)))
        await group.step(others.respond(action=np.zeros(4, int)))
    await group.reset()
    assert (probes.observation == before).all()
    assert all((info["array"] == 0).all() and info["nested"] == {"list": [0]} for info in infos)
    assert all((value.observation["array"] == 0).all() for value in values)
    assert all((value.observation["items"][0] == 0).all() for value in values)


@one_driver
async def test_a_sent_action_may_be_changed(start: Any) -> None:
    """The env is stepped with the action at the time of sending, even if it runs later."""
    group = await start([ENTRY, {**ENTRY, "name": "chunked", "backend": "chunked"}])
    batch, _ = await group.reset()
    probes, chunked = batch.by_entry().values()
    plain, chunk = actions(1, 2, 3, 4), np.ones((4, 5))
    group.step_async(probes.respond(action=plain))
    group.step_async(chunked.respond(action=chunk))
    plain[:] = chunk[:] = 50
    batch, _ = await group.collect_async(wait_all=True)
    found = batch.by_entry()
    assert sorted(found["probe"].reward.tolist()) == [1, 2, 3, 4]
    assert found["chunked"].reward.tolist() == [5] * 4


@one_driver
async def test_zero_copy_lends_read_only_views(start: Any) -> None:
    """They are valid until the env's next request; without the option, observations are copies."""
    group = await start(ENTRY, zero_copy=True)
    batch, _ = await group.reset()
    lent = batch.observation
    with pytest.raises(ValueError, match="read-only"):
        lent[0, 0] = 1.0
    copies = [copy.deepcopy(batch), pickle.loads(pickle.dumps(batch))]
    await group.step(batch.respond(action=actions(1, 2, 3, 4)))
    assert lent[:, 2].tolist() == [1] * 4, "the observation is a view of the rows"
    for owned in copies:
        assert owned.observation[:, 2].tolist() == [0] * 4
        owned.observation[0, 0] = 7.0
        answered, _ = await group.step(owned.respond(action=actions(1, 2, 3, 4)))
        assert answered.ids() == batch.ids()
    owned, _ = await group.step(responses(["probe-3", "probe-0"], 1, 2))
    assert owned.observation[:, 0].tolist() == [3, 0]
    assert len((await group.step(BatchedData()))[0]) == 0


@one_driver
async def test_statistics_of_a_group(start: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """Throughput by entry, batch sizes, mean times, and episodes by env."""
    group = await start([ENTRY, {**ENTRY, "name": "more", "num_workers": 1}])
    assert group.get_stats()["steps_per_second"] == 0.0
    await group.reset()
    for what, reward in ((DO_NOTHING, 1.0), (END, 2.0)):
        await group.step(responses(["probe-0", "more-0"], reward, reward, what=what))
    await group.reset(env_ids=["probe-0"])
    group.step_async(responses(["probe-0"], 5.0, what=TRUNCATE))
    batch, _ = await group.collect_async()
    assert batch.info()[0]["episode"] == {"r": 5.0, "l": 1}
    stats = group.get_stats()
    assert stats["steps_per_second"] > 0
    assert set(stats["entries"]) == {"probe", "more"}
    assert stats["entries"]["probe"] == pytest.approx(3 / 2 * stats["entries"]["more"])
    assert stats["batch_size"] == (5 + 2 + 2 + 1 + 1) / 5
    assert set(stats["latency_us"]) == {"step", "wait", "transfer"}
    assert min(stats["latency_us"].values()) >= 0
    by_env = group.get_env_stats()
    assert list(by_env) == group.env_ids
    assert (by_env["probe-0"]["episodes"], by_env["probe-0"]["mean_return"]) == (2, 4.0)
    assert (by_env["more-0"]["episodes"], by_env["more-0"]["mean_length"]) == (1, 2.0)
    assert by_env["probe-1"]["episodes"] == 0
    assert by_env["probe-1"]["mean_return"] is None
    assert by_env["probe-0"]["outcomes_terminated"] == by_env["probe-0"]["outcomes_truncated"] == 1
    group.print_timing_summary()
    printed = capsys.readouterr().out
    assert "steps per second" in printed
    assert "probe" in printed


@one_driver
async def test_a_seed_of_an_env_that_is_not_reset_is_refused(start: Any) -> None:
    """A misprint would leave a run without seeds."""
    group = await start(ENTRY)
    for reset in (group.reset, later(group.reset_async)):
        with pytest.raises(ValueError, match="seeds for 'probe-1', which this call doesn't reset"):
            await reset({"probe-0": 1, "probe-1": 2}, env_ids=["probe-0"])
    batch, _ = await group.reset({"probe-1": 2}, env_ids=["probe-1"])
    assert batch.env_ids() == ["probe-1"]


def later(plain: Any) -> Any:
    async def call(*args: Any, **kwargs: Any) -> Any:
        return plain(*args, **kwargs)

    return call


@one_driver
async def test_ids_are_a_sequence_of_str(start: Any) -> None:
    """One str is one, too, of its characters."""
    group = await start(ENTRY)
    for call in (
        group.reset,
        later(group.reset_async),
        group.abort,
        group.snapshot,
        lambda env_ids: group.call("double", 1, env_ids=env_ids),
    ):
        with pytest.raises(TypeError, match=r"sequence of ids: give \['probe-0'\]"):
            await call(env_ids="probe-0")
    assert not group.pending
