"""How many losses an entry bears: in a row, or within a time."""

from __future__ import annotations

import pytest

from rlightning_aio import EnvConfig
from rlightning_aio._core.hosts.limits import RestartPolicy
from rlightning_aio.errors import ConfigError


def policy(max_restarts: int | str) -> RestartPolicy:
    config = EnvConfig(task="CartPole-v1", max_restarts=max_restarts)
    return RestartPolicy(config, "on_worker_death", "replaced")


def test_a_number_counts_losses_in_a_row() -> None:
    count = policy(2).count
    assert count(1, 0.0) == (True, "restart 1 of 2 in a row")
    assert count(2, 0.0) == (True, "restart 2 of 2 in a row, in 0.1 s")
    is_borne, then = count(3, 0.0)
    assert (is_borne, then) == (
        False, "it is not replaced after 2 restarts in a row (max_restarts)",
    )  # fmt: skip


def test_a_rate_counts_restarts_within_a_time() -> None:
    """However many steps came in between; a loss that was raised counts for nothing."""
    count = policy("2/hour").count
    assert count(1, 0.0) == (True, "restart 1 of 2 within the last hour")
    assert count(1, 60.0) == (True, "restart 2 of 2 within the last hour")
    for now in (120.0, 3599.0):
        assert count(1, now) == (
            False, "it is not replaced after 2 restarts within the last hour (max_restarts)",
        )  # fmt: skip
    assert count(1, 3600.0)[0]
    assert not count(1, 3601.0)[0]
    assert count(1, 3661.0)[0]


@pytest.mark.parametrize("rate", ["10", "10/week", "-1/hour", "/hour", "1.5/hour"])
def test_a_rate_looks_like_one(rate: str) -> None:
    with pytest.raises(ConfigError, match=r"should be a number or look like '10/hour', got"):
        EnvConfig(task="CartPole-v1", max_restarts=rate)
