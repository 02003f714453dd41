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
from rlightning_aio._core.group.supervision.hint import LAST_LOOK, Hint, advice
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
    times: int = 32,
) -> dict[str, float]:
    """What sums grow by in some steps of each env, which take turns in their workers."""
    envs = sum(len(record.slots) for record in records)
    busy, queued = times * envs * step, times * (envs - len(records)) * step
    found = {"results": times * envs, "seconds_in_envs": busy, "seconds_queued": queued}
    found |= {"seconds_uncollected": 0.0, "seconds_idle": times * envs * trainer}
    return found if computing is None else {**found, "seconds_computing": times * envs * computing}


def test_envs_that_share_workers_and_wait_get_a_hint() -> None:
    """It has the setting."""
    records = workers(2, 4)
    said = advice(records, spent(records, 10 * MS, MS), 2)
    assert said is not None
    assert "4 envs share each worker" in said
    assert "one takes 10 ms, and computes for 10 % of that" in said
    assert "up to 4.0 times as fast, set envs_per_process: 1 (in VectorEnv, " in said


OTHERS: dict[str, dict[str, Any]] = {
    "they compute": {"step": 10 * MS, "computing": 9 * MS},
    "they compute half of the time": {"step": 10 * MS, "computing": 5 * MS},
    "nobody knows what they compute": {"step": 10 * MS},
    "their trainer is slow": {"step": 10 * MS, "computing": MS, "trainer": 400 * MS},
    "their steps are short": {"step": 0.05 * MS, "computing": 0.001 * MS},
}


@pytest.mark.parametrize("case", OTHERS)
def test_other_envs_that_share_workers_get_none(case: str) -> None:
    records = workers(2, 4)
    assert advice(records, spent(records, **OTHERS[case]), 2) is None


def test_envs_that_wait_at_the_same_time_get_none() -> None:
    """Awaitable ones."""
    records = workers(1, 4)
    records[0].started = [SimpleNamespace(is_awaitable=True)] * 4  # type: ignore[list-item]
    assert advice(records, spent(records, 10 * MS, MS), 2) is None


@pytest.mark.parametrize(
    ("step", "said", "cores", "wanted"),
    [
        (0.05, "auto", 2, "set envs_per_process: 3 (in VectorEnv, max_concurrency=2)"),
        (0.25, "auto", 2, None),
        (0.05, 1, 2, None),
        (0.05, "auto", 6, None),
    ],
    ids=["short steps", "longer ones", "as its user wants it", "a core each"],
)
def test_envs_that_compute_with_a_worker_each_get_a_hint(
    step: float, said: int | str, cores: int, wanted: str | None
) -> None:
    records = workers(6, 1, envs_per_process=said)
    found = advice(records, spent(records, step * MS, step * MS, times=1000), cores)
    if wanted is None:
        assert found is None
    else:
        assert found is not None
        assert "each of 6 envs has a worker, 3.0 times as many as cores" in found
        assert "a step takes 50 µs" in found
        assert wanted in found


def test_steps_that_cost_less_than_the_exchange_get_a_hint() -> None:
    """If they are all that a turn of the only worker does, and no time limit needs a worker."""
    for count, together, step, fields, wanted in (
        (1, 1, 8, {}, True),
        (1, 2, 8, {}, True),
        (1, 4, 8, {}, False),
        (2, 1, 8, {}, False),
        (1, 1, 40, {}, False),
        (1, 1, 8, {"step_timeout": 5}, False),
    ):
        records = workers(count, together, **fields)
        said = advice(records, spent(records, step / 1e6, step / 1e6, times=1000), 2)
        assert (said is not None and "placement: inline" in said) == wanted


def test_few_results_are_no_reason() -> None:
    records = workers(1, 1)
    assert advice(records, spent(records, 0.01 * MS, times=1000), 2) is not None
    assert advice(records, spent(records, 0.01 * MS, times=999), 2) is None
    records = workers(1, 2)
    numbers = spent(records, 10 * MS, MS)
    assert advice(records, numbers, 2) is not None
    assert advice(records, {**numbers, "results": 15}, 2) is None


def test_looks_come_early_and_then_ever_more_rarely() -> None:
    tables: Any = SimpleNamespace(records=[], num_cores=2)
    hint, found = Hint(tables), []
    while hint.due < float("inf"):
        found.append(hint.due)
        hint.look()
    assert found == [8, 16, 32, 64, 128, 256, 512, LAST_LOOK]


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
