"""The hint that a group logs once about slow settings."""

from __future__ import annotations

import logging
from unittest.mock import patch

import numpy as np
import pytest

from rlightning_aio import EnvConfig, sync
from rlightning_aio.group.hint import HINT_AFTER_BATCHES, hint
from rlightning_aio.group.stats import Stats


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


def test_the_hint_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """At INFO, after some steps."""
    measured = {"latency_us": latencies(step=10.0, transfer=100.0)}
    with (
        caplog.at_level(logging.INFO, "rlightning_aio"),
        patch.object(Stats, "summary", lambda _: measured),
        sync.build_env_group(entry()) as group,
    ):
        batch, _ = group.reset(seed=0)
        with group.auto_reset(max_episode_steps=100):
            for _ in range(2 * HINT_AFTER_BATCHES + 10):
                batch, _ = group.step(batch.respond(np.zeros(1, np.int64)))
    assert len([r for r in caplog.records if "rlightning-aio tune" in r.getMessage()]) == 1
