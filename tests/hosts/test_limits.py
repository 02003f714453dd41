"""How many losses an entry bears in a row, and how long its envs may take to close."""

from __future__ import annotations

from rlightning_aio import EnvConfig
from rlightning_aio._core.hosts.limits import RestartPolicy, close_seconds


def test_losses_are_counted_in_a_row() -> None:
    config = EnvConfig(task="CartPole-v1", max_restarts=2)
    count = RestartPolicy(config, "on_worker_death", "replaced").count
    assert count(1) == (True, "restart 1 of 2 in a row")
    assert count(2) == (True, "restart 2 of 2 in a row, in 0.1 s")
    assert count(2, pauses=False) == (True, "restart 2 of 2 in a row")
    is_borne, then = count(3)
    assert (is_borne, then) == (
        False, "it is not replaced after 2 restarts in a row (max_restarts)",
    )  # fmt: skip


def test_where_deaths_are_raised_none_is_borne() -> None:
    config = EnvConfig(task="CartPole-v1", on_worker_death="raise")
    is_borne, then = RestartPolicy(config, "on_worker_death", "replaced").count(1)
    assert (is_borne, then) == (False, "on_worker_death is 'raise', so it is not replaced")


def test_only_awaitable_envs_get_time_to_cancel_requests_in_addition() -> None:
    given = EnvConfig(task="CartPole-v1", close_timeout=3.0)
    assert close_seconds(given, awaits=False) == 3.0
    assert close_seconds(given, awaits=True) > 3.0
    assert close_seconds(EnvConfig(task="CartPole-v1"), awaits=False) == 1.5
