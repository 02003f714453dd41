"""How fast attempts begin while most fail."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio.attempts.health import Health
from rlightning_aio.outcomes import Loss, Outcome

if TYPE_CHECKING:
    import pytest


def in_an_outage(env_id: str = "") -> Health:
    """Slow from second 10 on."""
    health = Health()
    kind = "env_raised" if env_id else "agent_raised"
    for _ in range(4):
        health.note(Outcome(kind, "infrastructure", "away", env_id or "box-0"), 4, 10.0)
    assert health.is_slow
    return health


def test_an_outage_names_an_env_only_if_envs_fail(caplog: pytest.LogCaptureFixture) -> None:
    in_an_outage()
    in_an_outage("box-1")
    of_model, of_envs = [one.getMessage() for one in caplog.records]
    assert "most attempts fail (3 agent_raised): others" in of_model
    assert "most attempts fail (3 env_raised, such as on env 'box-1'): others" in of_envs


def test_the_death_of_a_worker_is_no_outage() -> None:
    """Its envs were waiting together, or one of them is to blame and the others are not."""
    health, cause = Health(), "was killed by SIGKILL"
    for loss in (
        Loss(cause, "env_died", "infrastructure"),
        Loss(cause, "env_died", "env", "box-0"),
    ):
        for env_id in ("box-0", "box-1", "box-2", "box-3"):
            health.note(loss.outcome(env_id), 4, 10.0)
    assert not health.is_slow
