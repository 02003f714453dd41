"""`EnvGroup.metrics`: numbers of a running group, in every place and against a plain model."""

from __future__ import annotations

import asyncio
import math
import os
import random
import signal
import time
from collections import Counter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pytest
from group.test_stepping import DO_NOTHING, END, ENTRY, TRUNCATE, one_driver, responses
from hosts.awaited import GATE, OWN, STEP, Scripted
from kit.scripted import CUT, DIE, GO, RAISE, Counts
from kit.scripted import END as FAIL_END
from kit.scripted import HANG as HANG_UP
from kit.scripted import Scripted as Failing

import rlightning_aio
from rlightning_aio import BatchedData, EnvRaised, PolicyResponse, sync
from rlightning_aio._core.group.state import sums
from rlightning_aio._core.group.state.request_states import State
from rlightning_aio._core.group.state.sums import Sums
from rlightning_aio.outcomes import OutcomeKind
from rlightning_aio.protocol.slab import IS_RESET

if TYPE_CHECKING:
    from collections.abc import Iterator

SECONDS = ("seconds_in_envs", "seconds_queued", "seconds_uncollected", "seconds_idle")
NAMES = {
    *("steps", "results", "episodes", "episode_returns", "episode_lengths", *SECONDS),
    *(f"outcomes_{kind}" for kind in get_args(OutcomeKind)),
    *("envs", "idle", "busy", "uncollected", "restarts"),
    *("recycled", "recycle_waits", "largest_resident_mb"),
}
COMPUTING = "seconds_computing"


def numbers(group: Any, entry: str = "") -> SimpleNamespace:
    """The numbers of a group, or of one of its entries, as attributes."""
    prefix = f"envs/{entry}/" if entry else "envs/"
    found = group.metrics(by_entry=bool(entry))
    own = {k.removeprefix(prefix): v for k, v in found.items() if k.startswith(prefix)}
    return SimpleNamespace(**{name: value for name, value in own.items() if "/" not in name})


@one_driver
async def test_names_are_stable_and_values_plain_numbers(start: Any) -> None:
    """The same before the first step, after it, by entry, and after the group is closed."""
    group = await start([ENTRY, {**ENTRY, "name": "more", "num_workers": 1}])
    before = group.metrics()
    assert before["envs/steps"] == before["envs/seconds_idle"] == 0
    await group.reset()
    await group.step(responses(group.env_ids, 1, 2, 3, 4, 5, what=END))
    after = group.metrics(by_entry=True)
    names = NAMES | ({COMPUTING} if f"envs/{COMPUTING}" in before else set())
    everyone = {f"envs/{name}" for name in names}
    own = {f"envs/{entry}/{name}" for entry in ("probe", "more") for name in names}
    assert set(before) == everyone
    assert set(after) == everyone | own
    assert {type(value) for value in after.values()} <= {int, float}
    assert all(map(math.isfinite, after.values()))
    # The envs wait while they are asked, and the largest of two is no sum.
    for name in NAMES - {"seconds_idle", "largest_resident_mb"}:
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
    assert (found.envs, found.idle, found.busy + found.uncollected) == (4, 2, 2)
    await group.collect_async(wait_all=True)
    found = numbers(group)
    assert (found.idle, found.busy, found.uncollected) == (4, 0, 0)
    assert (found.steps, found.results) == (5, 13)
    assert (found.outcomes_terminated, found.outcomes_truncated) == (1, 2)
    assert (found.episodes, found.episode_returns, found.episode_lengths) == (3, 8, 3)


@one_driver
async def test_each_moment_of_an_env_is_in_one_sum(start: Any) -> None:
    """From its first request: while all envs are idle, their seconds are those that passed."""
    group = await start(ENTRY)
    began = time.monotonic()
    batch, _ = await group.reset()
    asked = time.monotonic()
    for _ in range(100):
        group.step_async(responses(group.env_ids, 1, 1, 1, 1))
        await asyncio.sleep(0)
        batch, _ = await group.collect_async(wait_all=True)
    assert len(batch) == 4
    least = time.monotonic() - asked
    found = vars(numbers(group))
    most = time.monotonic() - began
    assert 4 * least <= sum(found[name] for name in SECONDS) <= 4 * most
    assert min(found[name] for name in SECONDS) >= 0


def part(rng: random.Random, slots: list[int], sent: list[int], at: int) -> Any:
    """A part of a batch: which results are resets is in its flags, if any is one."""
    done = [rng.randint(s, at) for s in sent]
    busy = [rng.randint(0, d - s) for d, s in zip(done, sent, strict=True)]
    flags = np.zeros((len(slots), 4), np.bool_)
    has_flags = rng.random() < 0.5
    flags[:, IS_RESET] = [has_flags and rng.random() < 0.5 for _ in slots]
    zeros = np.zeros(len(slots), int) if has_flags else None
    return SimpleNamespace(
        slots=np.array(slots), times=np.array([done, busy]).T, flags=flags, agents=(),
        reward=np.zeros(len(slots)), episode_return=zeros, episode_length=zeros,
        info_marks=None, out_of_band={}, restarted=None,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(30))
def test_sums_of_times_are_those_of_a_plain_loop(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whenever they are read, and however many results are added at once."""
    rng, size, now = random.Random(seed), 5, 10**12
    monkeypatch.setattr(sums, "_MOST_ROWS", rng.randint(1, 20))
    monkeypatch.setattr(sums, "_LEAST_ROWS", 1)
    monkeypatch.setattr(time, "monotonic_ns", lambda: now)
    envs: Any = type("Envs", (), {"__len__": lambda _: size})()
    requests: Any = SimpleNamespace(state=np.zeros(size, np.int8), sent_ns=np.zeros(size, int))
    found = Sums(envs, requests, [])
    expected, taken = np.zeros((size, 5)), dict[int, int]()
    for _ in range(100):
        slots = rng.sample(range(size), rng.randint(1, size))
        sent = [now + rng.randint(0, 1000) for _ in slots]
        requests.sent_ns[slots], requests.state[slots] = sent, int(State.BUSY)
        now += 2000
        one = part(rng, slots, sent, now)
        found.add([one])
        requests.state[slots] = int(State.IDLE)
        for k, (slot, s) in enumerate(zip(slots, sent, strict=True)):
            done, busy = one.times[k].tolist()
            waited = s - taken[slot] if slot in taken else 0
            parts = (busy, done - busy - s, now - done, waited)
            expected[slot] += [not one.flags[k, IS_RESET], *(ns / 1e9 for ns in parts)]
            taken[slot] = now
        if rng.random() < 0.1:
            now += 500
            until_now = expected.copy()
            for slot, at in taken.items():
                until_now[slot, 4] += (now - at) / 1e9
            chosen = np.array(rng.sample(range(size), rng.randint(1, size)))
            read = found.added(chosen)
            shown = [read[name] for name in ("steps", *SECONDS)]
            np.testing.assert_allclose(shown, until_now[chosen].sum(axis=0), atol=1e-12)
    assert len(taken) == size


class Busy(Counts):
    """Computes in each step."""

    def does(self, action: Any) -> None:
        until = time.process_time() + 0.05
        while time.process_time() < until:
            pass


def test_what_workers_compute_is_a_sum() -> None:
    """It goes on growing when a worker is replaced."""
    with sync.build_env_group({"name": "b", "task": Busy, "num_workers": 1}) as group:
        before = numbers(group)
        if not hasattr(before, COMPUTING):
            pytest.skip("this system keeps no accounts of processors")
        batch, _ = group.reset()
        group.step(batch.respond(action=[0]))
        after = numbers(group)
        assert after.seconds_computing >= before.seconds_computing + 0.05
        os.kill(group.get_workers()[0]["pid"], signal.SIGKILL)
        group.step(batch.respond(action=[0]))
        assert numbers(group).seconds_computing > after.seconds_computing


@pytest.fixture
def gates() -> Iterator[None]:
    for kept in (Scripted.built, Scripted.closed, Scripted.gates, Scripted.at_gate):
        kept.clear()
    yield
    Scripted.gates.clear()


@pytest.mark.usefixtures("gates")
async def test_requests_that_no_env_executes_yet_are_busy() -> None:
    """Behind `max_concurrency`; aborted, they are idle, and their steps count nowhere."""
    entry = {"name": "e", "placement": "loop", "num_workers": 6, "max_concurrency": 2, **OWN}
    async with rlightning_aio.build_env_group(entry) as group:
        batch, _ = await group.reset()
        group.step_async(batch.respond(action=np.full(6, GATE)))
        while len(Scripted.at_gate) < 2:  # noqa: ASYNC110
            await asyncio.sleep(0.001)
        found = numbers(group)
        assert (found.busy, found.idle) == (6, 0)
        await group.abort()
        batch, _ = await group.reset()
        await group.step(batch.respond(action=np.full(6, STEP)))
        found = numbers(group)
        assert (found.busy, found.idle) == (0, 6)
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


def test_a_loss_that_an_error_has_told_of_is_counted_once() -> None:
    """By that error, and not by the reset that is marked for it."""
    task = {"backend": "gymnasium", "task": "kit.scripted:Scripted-v0", "placement": "inline"}
    rules = {"on_env_error": "restart", "max_restarts": 0}
    with sync.build_env_group({"name": "f", **task, **rules}) as group:
        batch, _ = group.reset()
        with pytest.raises(EnvRaised):
            group.step(
                batch.respond(action=np.full((1, *group.get_action_spaces()[0].shape), RAISE))
            )
        batch, _ = group.reset()
        assert (batch.restarted.all(), batch.outcome[0].kind) == (True, "env_raised")
        assert numbers(group).outcomes_env_raised == 1


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
                    note(group.reset(env_ids=[one.env_id for one in (error, *error.others)])[0])
        note(group.reset()[0])
        group.step_async(BatchedData(group.env_ids, values))
        group.abort()
        found = vars(numbers(group))
    counted["cancelled"] += 4
    kinds = {name.removeprefix("outcomes_") for name in found if name.startswith("outcomes_")}
    assert {kind: found[f"outcomes_{kind}"] for kind in kinds if counted[kind]} == counted
    assert set(counted) >= {"terminated", "truncated", "env_raised", "env_died", "env_hung"}
    assert sum(found[f"outcomes_{kind}"] for kind in kinds) == counted.total()


@pytest.mark.parametrize("num_aborts", [1, 2])
async def test_an_episode_that_is_aborted_counts_once(num_aborts: int) -> None:
    """However often that is asked for meanwhile, and though the next result tells of it."""
    async with rlightning_aio.build_env_group(Failing) as group:
        batch, _ = await group.reset()
        group.step_async(batch.respond(action=[HANG_UP]))
        await asyncio.gather(*(group.abort() for _ in range(num_aborts)))
        batch, _ = await group.step(batch.respond(action=[GO]))
        assert [(one.kind, one.blame) for one in batch.outcome] == [("cancelled", "caller")]
        assert numbers(group).outcomes_cancelled == 1
