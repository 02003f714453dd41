"""`EnvGroup.metrics`: numbers of a running group, in every place and against a plain model."""

from __future__ import annotations

import asyncio
import math
import os
import random
import signal
import threading
import time
from collections import Counter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from group.sample_envs import Gate
from group.test_stepping import DO_NOTHING, END, ENTRY, TRUNCATE, one_driver, responses
from hosts.awaited import GATE, OWN, STEP, Scripted
from kit.scripted import CUT, DIE, GO, RAISE
from kit.scripted import END as FAIL_END
from kit.scripted import HANG as HANG_UP
from patience import HANG

import rlightning_aio
from rlightning_aio import BatchedData, EnvRaised, PolicyResponse, sync
from rlightning_aio._core.group.state import stats
from rlightning_aio._core.group.state.episode_counts import OUTCOMES
from rlightning_aio._core.group.state.samples import EnvTimes, Sample, Window

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

OF_LOOP = {"loop_lag_seconds_p99", "loop_lag_seconds_max"}
OF_GROUP = {"batch_size", "seconds_waiting_for_envs", "seconds_in_trainer"} | OF_LOOP
OF_ENVS = [
    *("seconds_in_envs", "seconds_queued"),
    *("seconds_waiting_to_be_collected", "seconds_waiting_for_actions"),
]


NAMES = {
    *OF_GROUP,
    *OF_ENVS,
    *("steps", "steps_per_second", "envs", "idle", "in_flight", "uncollected", "queued"),
    *("oldest_request_seconds", "step_seconds_p50", "step_seconds_p99"),
    *("slowest_env", "slowest_env_seconds", "restarts"),
    *("episode_return_mean", "episode_length_mean"),
    *(f"outcomes_{kind}" for kind in OUTCOMES),
}


def numbers(group: Any, entry: str = "") -> SimpleNamespace:
    """The numbers of a group, or of one of its entries, as attributes."""
    prefix = f"envs/{entry}/" if entry else "envs/"
    found = group.metrics(by_entry=bool(entry))
    own = {k.removeprefix(prefix): v for k, v in found.items() if k.startswith(prefix)}
    return SimpleNamespace(**{name: value for name, value in own.items() if "/" not in name})


def assert_adds_up(found: SimpleNamespace, envs: int) -> None:
    """The envs' seconds are the trainer's; they begin with the first request, a little later."""
    of_envs = sum(getattr(found, name) for name in OF_ENVS)
    of_trainer = found.seconds_in_trainer + found.seconds_waiting_for_envs
    assert 0 <= of_trainer - of_envs / envs < 0.3


@one_driver
async def test_names_are_stable_and_values_plain_numbers(start: Any, place: Any) -> None:
    """The same before the first step, after it, by entry, and after the group is closed."""
    group = await start([ENTRY, {**ENTRY, "name": "more", "num_workers": 1}])
    before = group.metrics()
    assert before["envs/steps_per_second"] == before["envs/steps"] == 0
    await group.reset()
    await group.step(responses(group.env_ids, 1, 2, 3, 4, 5, what=END))
    after = group.metrics(by_entry=True)
    expected = NAMES - (OF_LOOP if place.synchronous else set())
    everyone = {f"envs/{name}" for name in expected}
    own = {f"envs/{entry}/{name}" for entry in ("probe", "more") for name in expected - OF_GROUP}
    assert set(before) < set(after) == everyone | own
    assert {type(value) for value in after.values()} <= {int, float}
    assert all(map(math.isfinite, after.values()))
    for name in ("steps", "envs", "idle", *OF_ENVS):
        parts = sum(after[f"envs/{entry}/{name}"] for entry in ("probe", "more"))
        assert after[f"envs/{name}"] == pytest.approx(parts)
    await group.close()
    closed = group.metrics()
    await asyncio.sleep(0.01)
    assert repr(closed) == repr(group.metrics())
    assert closed["envs/steps"] == 5


@one_driver
async def test_counts_of_envs_steps_and_outcomes(start: Any) -> None:
    """Requests in flight, results that nobody has collected, ends by their kind."""
    group = await start(ENTRY)
    await group.reset()
    await group.step(responses(["probe-0"], 1.0, what=END))
    await group.step(responses(["probe-1", "probe-2"], 2.0, 5.0, what=TRUNCATE))
    await group.reset()
    group.step_async(responses(["probe-0", "probe-3"], 1.0, 1.0, what=DO_NOTHING))
    found = numbers(group)
    assert (found.envs, found.idle, found.in_flight + found.uncollected) == (4, 2, 2)
    assert found.oldest_request_seconds >= 0
    await group.collect_async(wait_all=True)
    found = numbers(group)
    assert (found.idle, found.in_flight, found.uncollected, found.queued) == (4, 0, 0, 0)
    assert found.oldest_request_seconds == 0
    assert (found.steps, found.outcomes_terminated, found.outcomes_truncated) == (5, 1, 2)
    assert (found.episode_return_mean, found.episode_length_mean) == (8 / 3, 1)
    assert 0 <= found.slowest_env < 4
    assert found.slowest_env_seconds > 0
    assert found.batch_size == pytest.approx((4 + 1 + 2 + 4 + 2) / 5)


@one_driver
async def test_each_moment_of_an_env_is_somewhere(start: Any) -> None:
    """While all envs are idle, their seconds add up to those of the trainer."""
    group = await start(ENTRY)
    batch, _ = await group.reset()
    until = time.monotonic() + 0.2
    while time.monotonic() < until:
        group.step_async(responses(group.env_ids, 1, 1, 1, 1))
        await asyncio.sleep(0.001)
        batch, _ = await group.collect_async(wait_all=True)
    assert len(batch) == 4
    found = numbers(group)
    assert min(found.seconds_in_trainer, found.seconds_waiting_for_envs) > 0
    assert_adds_up(found, envs=4)


def sample(rng: random.Random, at: int, slots: list[int], sent: list[int]) -> Sample:
    done = [rng.randint(s, at) for s in sent]
    busy = [rng.randint(0, d - s) for d, s in zip(done, sent, strict=True)]
    resets = rng.choice([None, np.array([rng.random() < 0.5 for _ in slots])])
    return Sample(
        batch=at,
        at_ns=at,
        slots=np.array(slots),
        sent_ns=np.array(sent),
        times=np.array([done, busy]).T,
        num_envs=1,
        resets=resets,
        synchronous=True,
        since_ns=0,
        needed=0,
    )


@pytest.mark.parametrize("seed", range(30))
def test_sums_of_times_are_those_of_a_plain_loop(seed: int) -> None:
    """Whenever they are read, and however many results are summed at once."""
    rng = random.Random(seed)
    size, num_entries = 5, rng.choice([1, 2])
    entries = np.array([slot % num_entries for slot in range(size)])
    names = SimpleNamespace(entries=entries, entry_names=["a", "b"][:num_entries])
    envs: Any = SimpleNamespace(names=names, local_ids=list(range(size)))
    envs_type = type("Envs", (SimpleNamespace,), {"__len__": lambda _: size})
    requests: Any = SimpleNamespace(state=np.zeros(size, np.int8), sent_ns=np.zeros(size, int))
    times = EnvTimes(envs_type(**vars(envs)), requests)
    most_kept = rng.randint(1, 20)
    kept: list[Sample] = []

    def settle() -> None:
        if kept:
            times.add(kept)
            kept.clear()

    expected = np.zeros((num_entries, 5))
    taken: dict[int, int] = {}
    now = 10**12
    for _ in range(100):
        slots = rng.sample(range(size), rng.randint(1, size))
        sent = [now + rng.randint(0, 1000) for _ in slots]
        requests.sent_ns[slots], requests.state[slots] = sent, 1
        now += 2000
        one = sample(rng, now, slots, sent)
        kept.append(one)
        if len(kept) >= most_kept:
            settle()
        requests.state[slots] = 0
        for k, (slot, s) in enumerate(zip(slots, sent, strict=True)):
            done, busy = one.times[k].tolist()
            row = expected[entries[slot]]
            row += [
                one.resets is None or not one.resets[k],
                *(busy / 1e9, (done - busy - s) / 1e9, (now - done) / 1e9),
                (s - taken[slot]) / 1e9 if slot in taken else 0,
            ]
            taken[slot] = now
        if rng.random() < 0.1:
            until_now = expected.copy()
            for slot, at in taken.items():
                until_now[entries[slot], 4] += (now + 500 - at) / 1e9
            until = times.waiting_until(now + 500)
            settle()
            np.testing.assert_allclose(times.so_far(until), until_now, atol=1e-12)
        if rng.random() < 0.05:
            settle()
            times.forget(slot := rng.randrange(size))
            taken.pop(slot, None)
    assert len(taken) > 0


def lags(needed: int, since: int, *done: int) -> list[float]:
    times = np.array([[d, 0] for d in done])
    slots, sent = np.arange(len(done)), np.zeros(len(done), int)
    one = Sample(1, 1000, slots, sent, times, 1, None, False, since, needed)
    return (Window([one], 1000).lags() * 1e9).round().tolist()


def test_a_call_is_due_with_the_last_result_that_it_needs() -> None:
    """Not with the first that is there, nor with those that come while it is late."""
    assert lags(2, 0, 100, 900, 400) == [600]
    assert lags(3, 0, 100, 900, 400) == [100]
    assert lags(2, 500, 100, 900, 400) == []  # It did not have to wait.
    assert lags(0, 0, 100, 900, 400) == []  # It had a window.
    assert lags(9, 0, 100, 900, 400) == [100]


def test_a_batch_of_several_layouts_is_one() -> None:
    """Its size, its lag, and its part in the rate, of which the first batch is none."""

    def part(batch: int, at: int, needed: int, *done: int) -> Sample:
        times = np.array([[d, 0] for d in done])
        sent = np.zeros(len(done), int)
        return Sample(batch, at, np.arange(len(done)), sent, times, 1, None, False, 0, needed)

    parts = [part(1, 1000, 3, 100, 900), part(1, 1000, 3, 800), part(2, 2000, 1, 1500)]
    window = Window(parts, 10**9 + 1000)
    assert window.batch_sizes().tolist() == [3, 1]
    assert (window.lags() * 1e9).round().tolist() == [100, 500]
    assert window.rate(np.ones(4, np.bool_)) == pytest.approx(1)
    parts[0].needed = parts[1].needed = 2
    assert (Window(parts, 0).lags() * 1e9).round().tolist() == [200, 500]
    assert len(Window([], 0).lags()) == len(Window([], 0).batch_sizes()) == 0
    assert Window(parts[:2], 10**9).rate(np.ones(3, np.bool_)) == 0


async def test_the_lag_of_the_loop_is_how_late_calls_return() -> None:
    """Something else blocks the loop while workers have done their part."""

    async def block() -> None:
        while True:
            await asyncio.sleep(0.02)
            time.sleep(0.1)  # noqa: ASYNC251

    entry = {**ENTRY, "num_workers": 2, "envs_per_process": 2}
    async with rlightning_aio.build_env_group(entry) as group:
        await group.reset()
        blocking = asyncio.create_task(block())
        lag, until = 0.0, time.monotonic() + HANG
        while lag < 0.05 and time.monotonic() < until:
            await group.step(responses(group.env_ids, 1.0, 1.0))
            lag = vars(numbers(group)).get("loop_lag_seconds_max", 0.0)
        blocking.cancel()
        await asyncio.wait([blocking])
        assert 0.05 < lag < HANG


@pytest.fixture
def gates() -> Iterator[None]:
    for kept in (Scripted.built, Scripted.closed, Scripted.gates, Scripted.at_gate):
        kept.clear()
    yield
    Scripted.gates.clear()


@pytest.mark.usefixtures("gates")
async def test_requests_that_no_env_executes_yet_are_queued() -> None:
    """Behind `max_concurrency`; the oldest request shows an env that doesn't come back."""
    entry = {"name": "e", "placement": "loop", "num_workers": 6, "max_concurrency": 2, **OWN}
    async with rlightning_aio.build_env_group(entry) as group:
        batch, _ = await group.reset()
        group.step_async(batch.respond(action=np.full(6, GATE)))
        while len(Scripted.at_gate) < 2:  # noqa: ASYNC110
            await asyncio.sleep(0.001)
        found = numbers(group)
        assert (found.in_flight, found.queued, found.idle) == (6, 4, 0)
        assert 0 < found.oldest_request_seconds < HANG
        await group.abort()
        batch, _ = await group.reset()
        await group.step(batch.respond(action=np.full(6, STEP)))
        found = numbers(group)
        assert (found.in_flight, found.queued, found.idle) == (0, 0, 6)
        assert (found.steps, found.restarts) == (6, 0)


def test_a_killed_worker_is_counted() -> None:
    """A restart for the group and its entry, and a lost episode for each env of the worker."""
    entries = [{**ENTRY, "envs_per_process": 2}, {**ENTRY, "name": "more", "num_workers": 1}]
    with sync.build_env_group(entries) as group:
        group.reset()
        os.kill(group.get_workers()[0]["pid"], signal.SIGKILL)
        batch, _ = group.step(responses(group.env_ids, 1, 1, 1, 1, 1))
        assert batch.restarted.sum() == 2
        for entry, lost in (("", 2), ("probe", 2), ("more", 0)):
            found = numbers(group, entry)
            assert (found.restarts, found.outcomes_env_died) == (lost // 2, lost)
            assert found.outcomes_truncated == found.outcomes_terminated == 0


@pytest.mark.parametrize("fields", [{"envs_per_process": 2}, {"num_envs": 2}], ids=repr)
def test_outcomes_are_those_that_the_caller_gets(fields: dict[str, Any]) -> None:
    """In batches and in errors, of every kind; steps that are aborted are cancelled."""
    rng, counted = random.Random(1), Counter[str]()
    task = {"backend": "gymnasium", "task": "kit.scripted:Scripted-v0", **fields}
    config = {"name": "f", **task, "step_timeout": 0.3, "max_restarts": 100}

    def note(batch: rlightning_aio.BatchedData | None) -> None:
        if batch is not None:
            counted.update(one.kind for one in np.ravel(batch.outcome) if one is not None)

    with sync.build_env_group({**config, "num_workers": 4}) as group:
        group.reset()
        with group.auto_reset(7):
            for turn in range(60):
                likely = [GO] * 8 + [FAIL_END, CUT, RAISE, DIE] + [HANG_UP] * (turn % 20 == 0)
                shape = group.get_action_spaces()[0].shape
                actions = [np.full(shape, rng.choice(likely)) for _ in range(4)]
                values = [PolicyResponse(*one) for one in zip(group.env_ids, actions, strict=True)]
                try:
                    note(group.step(BatchedData(group.env_ids, values))[0])
                except EnvRaised as error:
                    note(error.results)
                    counted.update(one.outcome.kind for one in (error, *error.others))
                    group.reset(env_ids=[one.env_id for one in (error, *error.others)])
        group.reset()
        group.step_async(BatchedData(group.env_ids, values))
        group.abort()
        found = vars(numbers(group))
    counted["cancelled"] += 4
    kinds = {name.removeprefix("outcomes_") for name in found if name.startswith("outcomes_")}
    assert {kind: found[f"outcomes_{kind}"] for kind in kinds if counted[kind]} == counted
    assert set(counted) >= {"terminated", "truncated", "env_raised", "env_died", "env_hung"}
    assert sum(found[f"outcomes_{kind}"] for kind in kinds) == counted.total()


@pytest.mark.parametrize("num_aborts", [1, 2])
async def test_an_episode_that_is_aborted_counts_once(num_aborts: int, tmp_path: Path) -> None:
    """However often that is asked for meanwhile, and though the next result tells of it."""
    Gate(str(tmp_path), "gated-0").make()
    config = {"name": "gated", "backend": "gated_where_there_is_one", "task": "-"}
    config["env_kwargs"] = {"gates": str(tmp_path)}
    async with rlightning_aio.build_env_group(config) as group:
        await group.reset()
        group.step_async(responses(["gated-0"], 1.0, what=DO_NOTHING))
        await asyncio.gather(*(group.abort() for _ in range(num_aborts)))
        (tmp_path / "gated-0").unlink()
        batch, _ = await group.step(responses(["gated-0"], 1.0, what=DO_NOTHING))
        assert [one.kind for one in batch.outcome] == ["cancelled"]
        assert numbers(group).outcomes_cancelled == 1


def test_other_threads_may_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """At any time; no result is counted twice or left out, and counts only grow."""
    monkeypatch.setattr(stats, "_MOST_ROWS", 3 * 16)
    entry = {**ENTRY, "envs_per_process": 4}
    with sync.build_env_group([entry, {**entry, "name": "more"}]) as group:
        group.reset()
        wrong: list[Any] = []
        ended = threading.Event()

        def read() -> None:
            last: dict[str, float] = {}
            while not ended.is_set():
                found = group.metrics(by_entry=True)
                counted = [key for key in found if key.endswith("/steps") or "/outcomes_" in key]
                wrong.extend(key for key in counted if found[key] < last.get(key, 0))
                last = found

        readers = [threading.Thread(target=read) for _ in range(2)]
        for reader in readers:
            reader.start()
        with group.auto_reset(4):
            for _ in range(300):
                group.step(responses(group.env_ids, *[1.0] * 8))
        ended.set()
        for reader in readers:
            reader.join()
        assert wrong == []
        found = numbers(group)
        assert (found.steps, found.outcomes_truncated) == (1920, 480)
        assert found.episode_length_mean == 4
        assert_adds_up(found, envs=8)
