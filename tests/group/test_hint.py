"""What a group says, once, of settings that cost time."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from rlightning_aio import EnvConfig, sync
from rlightning_aio.group import supervisor
from rlightning_aio.group.hint import HINT_AFTER_BATCHES, hint


def latencies(step: float, transfer: float) -> dict[str, dict[str, float]]:
    return {"step": {"p50": step}, "transfer": {"p50": transfer}}


def entry(**fields: object) -> EnvConfig:
    return EnvConfig.model_validate(
        {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", **fields}
    )


def test_more_workers_than_cores_are_told_to_share() -> None:
    """Short steps in a worker each: several envs in each worker are suggested."""
    said = hint([entry(num_workers=8)], {"pole": 8}, 2, latencies(50.0, 100.0))
    assert said is not None
    assert "envs_per_process: 4" in said


def test_an_env_that_takes_no_time_is_told_to_stay() -> None:
    """One tiny env in a worker of its own: the training process is suggested."""
    said = hint([entry()], {"pole": 1}, 2, latencies(8.0, 60.0))
    assert said is not None
    assert "placement: inline" in said


@pytest.mark.parametrize(
    ("workers", "step", "transfer"),
    [(2, 50.0, 100.0), (8, 20_000.0, 100.0)],
    ids=["as many workers as cores", "steps that wait"],
)
def test_good_settings_are_left_alone(workers: int, step: float, transfer: float) -> None:
    """Nothing is said where nothing would be gained."""
    config = entry(num_workers=8)
    assert hint([config], {"pole": workers}, 2, latencies(step, transfer)) is None


def test_the_hint_is_logged_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It comes at INFO, after a while, and never again, whatever the machine's times are."""
    monkeypatch.setattr(supervisor, "hint", lambda *measured: "other settings are faster")
    with caplog.at_level(logging.INFO, "rlightning_aio"), sync.build_env_group(entry()) as group:
        batch, _ = group.reset(seed=0)
        with group.auto_reset(max_episode_steps=100):
            for _ in range(2 * HINT_AFTER_BATCHES + 10):
                batch, _ = group.step(batch.respond(np.zeros(1, np.int64)))
    assert len([r for r in caplog.records if "rlightning-aio tune" in r.getMessage()]) == 1
