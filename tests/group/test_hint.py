"""The hints that a group logs about slow settings, each once."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from kit.scripted import Counts

from rlightning_aio import EnvConfig, sync
from rlightning_aio._core.group.state.host_record import HostRecord
from rlightning_aio._core.group.state.stats import Stats
from rlightning_aio._core.group.supervision.hint import HINT_AFTER_BATCHES, Hints, hint
from rlightning_aio._core.hosts.base import Host


def latencies(step: float, transfer: float) -> dict[str, dict[str, float]]:
    return {"step": {"p50": step}, "transfer": {"p50": transfer}}


def entry(**fields: object) -> EnvConfig:
    return EnvConfig.model_validate(
        {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", **fields}
    )


def test_more_workers_than_cores_get_a_hint_to_share() -> None:
    """With short steps and one env in each worker, several envs in each worker are suggested."""
    said = hint([entry(num_workers=8)], {"pole": 8}, 2, latencies(50.0, 100.0))
    assert said is not None
    assert "envs_per_process: 4" in said


def test_a_tiny_env_in_a_worker_gets_a_hint_to_be_inline() -> None:
    """The trainer's process is suggested."""
    said = hint([entry()], {"pole": 1}, 2, latencies(8.0, 60.0))
    assert said is not None
    assert "placement: inline" in said


@pytest.mark.parametrize(
    ("workers", "step", "transfer"),
    [(2, 50.0, 100.0), (8, 20_000.0, 100.0)],
    ids=["as many workers as cores", "steps that wait"],
)
def test_good_settings_get_no_hint(workers: int, step: float, transfer: float) -> None:
    """Other settings would be no faster."""
    config = entry(num_workers=8)
    assert hint([config], {"pole": workers}, 2, latencies(step, transfer)) is None


def test_times_of_several_entries_are_no_reason_for_a_hint(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Short steps of envs on the event loop say nothing of other envs, in workers."""
    caplog.set_level(logging.INFO, "rlightning_aio")
    machine = Machine(per_worker=1, num_workers=3, envs_per_process=1)
    machine.hints.due = HINT_AFTER_BATCHES
    with patch.object(Machine, "summary", lambda *_: {"latency_us": latencies(8.0, 60.0)}):
        machine.look()
        assert "3 workers for 2 cores" in caplog.text
        caplog.clear()
        machine.hints.due = HINT_AFTER_BATCHES
        config = entry().model_copy(update={"name": "waiting", "placement": "loop"})
        machine.records.append(HostRecord(OnLoop(), config))
        machine.look()
    assert not caplog.records


def test_the_hint_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """At INFO, after some steps."""
    measured = {"latency_us": latencies(step=10.0, transfer=100.0)}
    with (
        caplog.at_level(logging.INFO, "rlightning_aio"),
        patch.object(Stats, "summary", lambda *_: measured),
        sync.build_env_group(entry()) as group,
    ):
        batch, _ = group.reset(seed=0)
        with group.auto_reset(max_episode_steps=100):
            for _ in range(2 * HINT_AFTER_BATCHES + 10):
                batch, _ = group.step(batch.respond(np.zeros(1, np.int64)))
    assert len([r for r in caplog.records if "rlightning-aio bench" in r.getMessage()]) == 1


MS = 1_000_000


@dataclass
class Worker(Host):
    """A host, and what the kernel's accounts say of its threads."""

    first_slot: int
    num_envs: int
    ran: int | None = 10 * MS
    queued: int = 0
    host_id: int = 0

    def processor_times(self) -> tuple[int, int] | None:
        return None if self.ran is None else (self.ran, self.queued)

    def _not_asked(self, *args: Any) -> Any:
        raise AssertionError

    current_request = traffic = catch_up = kill = destroy = _not_asked  # See `Killable`.


@dataclass
class OnLoop(Host):
    """A host of envs on the event loop, which is no process."""

    first_slot: int = 3
    num_envs: int = 1
    host_id: int = 3


@dataclass
class Machine:
    """Workers of a group, and the measurements of its results, in place of `Stats`.

    `at_ns` is the time.
    """

    per_worker: int = 4
    num_workers: int = 2
    envs_per_process: int | str = "auto"
    num_batches: int = 0
    at_ns: int = 5 * MS
    steps: list[tuple[int, int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        count = self.per_worker
        self.workers = [Worker(k * count, count) for k in range(self.num_workers)]
        total = self.num_workers * count
        config = entry(num_workers=total, envs_per_process=self.envs_per_process)
        self.records = [HostRecord(worker, config) for worker in self.workers]
        tables: Any = SimpleNamespace(records=self.records, stats=self, num_cores=2)
        self.hints = Hints(tables)

    def executed(self, since_ns: int) -> Any:
        return np.array([step for step in self.steps if step[1] >= since_ns]).reshape(-1, 3).T

    def summary(self, now_ns: int) -> Any:
        return {"latency_us": {}}

    def look(self) -> None:
        with patch.object(time, "monotonic_ns", lambda: self.at_ns):
            self.hints.look()

    def step_all(self, times: int, busy: int, *, ran: int, queued: int = 0, idle: int = 0) -> None:
        """Let each worker step its envs, one after the other; times in ns, of one step."""
        for _ in range(times):
            for k in range(self.per_worker):
                for worker in self.workers:
                    slot = worker.first_slot + k
                    self.steps.append((slot, self.at_ns, self.at_ns + busy))
                    worker.ran = (worker.ran or 0) + ran
                    worker.queued += queued
                self.at_ns += busy
            self.at_ns += idle


def warned(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]


@pytest.mark.parametrize("queued", [0, 70 * MS], ids=["alone", "on a busy machine"])
def test_envs_that_share_workers_and_wait_get_one_warning(
    queued: int, caplog: pytest.LogCaptureFixture
) -> None:
    """It has the setting, and comes before each env has made twenty steps."""
    machine = Machine()
    machine.look()
    for _ in range(3):
        machine.step_all(8, 10 * MS + queued, ran=MS, queued=queued)
        machine.look()
    (text,) = warned(caplog)
    assert "entry 'pole': 4 envs share each worker" in text
    takes = f"one takes {(10 * MS + queued) // MS} ms"
    assert f"{takes}, and keeps a core busy for 10 % of that" in text
    assert "up to 4.0 times as fast" in text
    assert "set envs_per_process: 1 (in VectorEnv, envs_per_process=1)" in text


@pytest.mark.parametrize("busy", [MS // 20, MS // 4], ids=["50 µs", "250 µs"])
@pytest.mark.parametrize("said", ["auto", 1])
def test_envs_with_a_worker_each_and_short_steps_get_one_warning(
    busy: int, said: int | str, caplog: pytest.LogCaptureFixture
) -> None:
    """It has the setting; steps above 200 µs, and a number that was asked for, get none."""
    machine = Machine(per_worker=1, envs_per_process=said, num_workers=6)
    machine.look()
    for _ in range(4):
        machine.step_all(4, busy, ran=busy)
        machine.look()
    warnings = warned(caplog)
    if busy > MS // 5 or said == 1:
        assert warnings == []
        return
    (text,) = warnings
    assert "entry 'pole': each of 6 envs has a worker, 3.0 times as many as cores" in text
    assert "a step takes 50 µs" in text
    assert "set envs_per_process: 3 (in VectorEnv, max_concurrency=2)" in text


OTHERS: dict[str, dict[str, Any]] = {
    "they compute": {"ran": 9 * MS},
    "they compute on a busy machine": {"ran": MS, "queued": 9 * MS},
    "they compute half of the time": {"ran": 5 * MS},
    "their trainer is slow": {"ran": MS, "idle": 400 * MS},
}


@pytest.mark.parametrize("case", OTHERS)
def test_other_envs_that_share_workers_get_no_warning(
    case: str, caplog: pytest.LogCaptureFixture
) -> None:
    machine = Machine()
    machine.look()
    for _ in range(3):
        machine.step_all(8, 10 * MS, **OTHERS[case])
        machine.look()
    assert not warned(caplog)


def test_too_few_measurements_are_no_reason(caplog: pytest.LogCaptureFixture) -> None:
    """Of few steps, of short ones, without accounts, or of a worker that was replaced."""
    few, short, unknown, replaced, alone = (Machine(k) for k in (1, 4, 4, 4, 1))
    few.records[0].slots = range(2)
    unknown.workers[1].ran = None
    for machine in (few, short, unknown, replaced, alone):
        machine.look()
    few.step_all(4, 100 * MS, ran=MS)
    short.step_all(8, MS // 10, ran=MS // 100)
    replaced.step_all(8, 10 * MS, ran=MS)
    replaced.records[0].restarts += 1
    alone.step_all(32, 10 * MS, ran=MS)
    for machine in (few, short, unknown, replaced, alone):
        machine.look()
    assert not warned(caplog)
    replaced.step_all(8, 10 * MS, ran=MS)
    replaced.look()
    assert len(warned(caplog)) == 1


def test_envs_that_wait_at_the_same_time_get_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    """Awaitable ones."""
    machine = Machine()
    machine.look()
    machine.step_all(8, 10 * MS, ran=MS)
    machine.steps = [(slot, begun - 8 * MS * (slot % 4), end) for slot, begun, end in machine.steps]
    machine.look()
    assert not warned(caplog)


def test_a_look_comes_early_and_then_ever_more_rarely() -> None:
    machine = Machine()
    found: list[float] = []
    while machine.hints.due < float("inf"):
        found.append(machine.hints.due)
        machine.look()
    assert found == [8, 16, 32, 64, 128, 256, 512, HINT_AFTER_BATCHES]


class Sleeper(Counts):
    """Waits in each step."""

    def does(self, action: Any) -> None:
        time.sleep(0.02)


def test_envs_that_truly_wait_get_the_warning(caplog: pytest.LogCaptureFixture) -> None:
    """A sleep takes hardly any time of a core, however slow the machine is."""
    config = {"name": "bed", "task": Sleeper, "num_workers": 2, "envs_per_process": 2}
    with sync.build_env_group(config) as group:
        batch, _ = group.reset()
        while not warned(caplog):
            batch, _ = group.step(batch.respond(action=np.zeros(2, np.int64)))
        for _ in range(40):
            batch, _ = group.step(batch.respond(action=np.zeros(2, np.int64)))
    (text,) = warned(caplog)
    assert "entry 'bed': 2 envs share each worker" in text
    assert "envs_per_process: 1" in text
