"""The one hint that a group logs about a slow setting."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kit.scripted import Counts

from rlightning_aio import EnvConfig, sync
from rlightning_aio._core.group.state.host_record import HostRecord
from rlightning_aio._core.group.supervision.hint import Hint, advice
from rlightning_aio._core.hosts.base import Host

MS = 1e-3


@dataclass
class Worker(Host):
    """A worker with some envs."""

    first_slot: int
    num_envs: int
    host_id: int = 0

    def _not_asked(self, *args: Any) -> Any:
        raise AssertionError

    current_request = traffic = catch_up = kill = destroy = _not_asked  # See `Killable`.


def workers(count: int, together: int, **fields: object) -> list[HostRecord]:
    entry = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", **fields}
    config = EnvConfig.model_validate({**entry, "num_workers": count * together})
    return [HostRecord(Worker(k * together, together), config) for k in range(count)]


def spent(
    records: list[HostRecord],
    step: float,
    computing: float | None = None,
    trainer: float = 0.0,
    exchange: float = 0.0,
    times: int = 64,
) -> dict[str, float]:
    """What sums grow by in some steps of all envs, which take turns in their workers.

    Beside the steps, a turn has the way to the workers and back, and the trainer's own time.
    """
    envs = sum(len(record.slots) for record in records)
    busy = times * envs * step
    queued = busy * (len(records[0].slots) - 1)
    found = {"results": times * envs, "seconds_in_envs": busy, "seconds_queued": queued}
    found |= {"seconds_uncollected": times * envs * exchange, "batches": times}
    found |= {"seconds_idle": times * envs * trainer}
    return found if computing is None else {**found, "seconds_computing": times * envs * computing}


def said(records: list[HostRecord], **numbers: Any) -> tuple[str, float] | None:
    """Return the setting that is advised on two cores, and its gain."""
    found = advice(records, spent(records, **numbers), 2)
    return None if found is None else (found.setting, round(found.gain, 1))


def test_envs_that_share_workers_and_wait_get_a_hint() -> None:
    records = workers(2, 4)
    found = advice(records, spent(records, 10 * MS, MS), 2)
    assert found is not None
    assert "4 envs share each worker" in found.why
    assert "one takes 10 ms, and computes for 10 % of that" in found.why
    assert (found.setting, round(found.gain, 1)) == ("envs_per_process: 1", 4.0)
    assert "VectorEnv" in found.more


OTHERS: dict[str, dict[str, Any]] = {
    "they compute": {"step": 10 * MS, "computing": 9 * MS},
    "they compute half of the time": {"step": 10 * MS, "computing": 5 * MS},
    "the cores would be busy": {"step": 10 * MS, "computing": 4.5 * MS, "trainer": 30 * MS},
    "nobody knows what they compute": {"step": 10 * MS},
    "their trainer is slow": {"step": 10 * MS, "computing": MS, "trainer": 400 * MS},
    "their steps are short": {"step": 0.25 * MS, "computing": 0.01 * MS, "times": 2},
}


@pytest.mark.parametrize("case", OTHERS)
def test_other_envs_that_share_workers_get_none(case: str) -> None:
    assert said(workers(2, 4), **OTHERS[case]) is None


def test_envs_that_wait_at_the_same_time_get_none() -> None:
    """Awaitable ones."""
    records = workers(1, 4)
    records[0].started = [SimpleNamespace(is_awaitable=True)] * 4  # type: ignore[list-item]
    assert said(records, step=10 * MS, computing=MS) is None


US = 1e-6
LIMITS: dict[str, Any] = {"step_timeout": 5}


@pytest.mark.parametrize(
    ("count", "step", "exchange", "fields", "wanted"),
    [
        # Turns of a worker for each env on two quiet cores; a wake-up takes 25 µs of one of them.
        (1, 2, 100, {}, "placement: inline"),
        (1, 2, 100, LIMITS, None),
        (1, 100, 90, {}, None),
        (4, 2, 160, {}, "placement: inline"),
        (4, 20, 180, {}, "envs_per_process: 2"),
        (16, 2, 400, {}, "placement: inline"),
        (16, 20, 500, {}, "envs_per_process: 8"),
        (16, 20, 500, {"envs_per_process": 1}, None),
        (32, 2, 700, {}, "envs_per_process: 16"),
        (32, 100, 2200, {}, None),
        (32, 2000, 33000, {}, None),
    ],
)
def test_the_fastest_setting_is_advised_where_it_gains_half(
    count: int, step: float, exchange: float, fields: dict[str, Any], wanted: str | None
) -> None:
    """Own envs that compute; only what the entry allows."""
    records = workers(count, 1, **fields)
    numbers = {"step": step * US, "computing": (step + 25) * US, "exchange": exchange * US}
    found = said(records, **numbers, times=1000)
    assert (found and found[0]) == wanted
    assert found is None or found[1] >= 1.5


def test_the_first_ready_are_answered_more_often_in_this_process() -> None:
    """Where four of eight are enough, a policy of 100 µs is asked twice for a turn of all."""
    records = workers(8, 1)
    numbers = spent(records, 2 * US, trainer=100 * US, exchange=250 * US, times=1000)
    all_of_them = advice(records, numbers, 8)
    half = advice(records, {**numbers, "batches": 2000}, 8)
    assert all_of_them is not None
    assert half is None


def test_one_look_is_no_reason(caplog: pytest.LogCaptureFixture) -> None:
    """The next one must find the same: a machine may be busy for a moment."""
    records, sums = workers(1, 1), SimpleNamespace(num_batches=0)
    tables: Any = SimpleNamespace(
        records=records, num_cores=2, sums=sums, slots_of=lambda record: record.slots
    )
    so_far = dict.fromkeys(spent(records, US), 0.0)
    sums.of = lambda _: dict(so_far)
    hint = Hint(tables)
    hint.look()

    def look(exchange: float) -> str:
        for key, value in spent(records, 2 * US, exchange=exchange, times=500).items():
            so_far[key] += value
        sums.num_batches += 500
        hint.look()
        return caplog.text

    assert not look(100 * US)
    assert not look(10 * US)
    assert not look(100 * US)
    assert "entry 'pole': a step takes 2 µs" in (text := look(100 * US))
    assert "times as fast, set placement: inline (in VectorEnv" in text
    assert "SyncVectorEnv is faster still" in text
    assert hint.due == float("inf")


class Sleeper(Counts):
    """Waits in each step."""

    def does(self, action: Any) -> None:
        time.sleep(0.02)


def test_a_group_gives_one_hint_in_its_life(caplog: pytest.LogCaptureFixture) -> None:
    """A sleep takes hardly any time of a core, however slow the machine is."""
    configs = [
        {"name": name, "task": Sleeper, "num_workers": 2, "envs_per_process": 2}
        for name in ("bed", "sofa")
    ]

    def warned() -> list[str]:
        return [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]

    with sync.build_env_group(configs) as group:
        batch, _ = group.reset()
        while not warned():
            batch, _ = group.step(batch.respond(action=np.zeros(4, np.int64)))
        for _ in range(40):
            batch, _ = group.step(batch.respond(action=np.zeros(4, np.int64)))
    (text,) = warned()
    assert "entry 'bed': 2 envs share each worker" in text
    assert "envs_per_process: 1" in text
