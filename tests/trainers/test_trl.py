"""`rlightning_aio.trl` with the real TRL; skipped where it isn't installed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest
from trainers.envs import Adder

from rlightning_aio.trl import Environments

if TYPE_CHECKING:
    from pathlib import Path

# Warnings of other libraries are theirs.
pytestmark = [pytest.mark.simulators, pytest.mark.filterwarnings("ignore")]


def test_two_steps_with_a_hung_tool_and_a_killed_env(tmp_path: Path) -> None:
    pytest.importorskip("trl")
    from datasets import Dataset
    from trainers.tiny import trainer_of

    prompt = [{"role": "user", "content": "Add."}]
    rows = Dataset.from_list([{"prompt": prompt, "start": start} for start in (1, 2)])
    script: Any = [
        [("add", {"number": 1}), ("add", {"number": 2})],
        [("add", {"number": 13}), ("add", {"number": 2})],
        [("wait", {"seconds": 3600}), ("add", {"number": 2})],
        [("die", {})],
    ]
    with Environments(Adder, num_envs=4, step_timeout=10) as environments:
        trainer = trainer_of(rows, script, tmp_path, 2, environment_factory=environments)
        environments.join(trainer)
        seen: list[Any] = []
        score = trainer._calculate_rewards

        def watched(*args: Any) -> Any:
            kinds = [one.failure and one.failure.kind for one in trainer.environments]
            rewards = score(*args)
            seen.append((kinds, rewards[:, 0].tolist()))
            return rewards

        trainer._calculate_rewards = watched
        trainer.train()
        counts = environments.metrics()
    assert trainer.state.global_step == 2
    for (kinds, rewards), start in zip(seen, (1, 2), strict=True):
        assert kinds == [None, None, "env_hung", "env_died"]
        assert rewards[:2] == [start + 3, start + 2]
        assert all(map(math.isnan, rewards[2:])), "a failure has a reward"
    assert counts["envs/outcomes_env_hung"] == counts["envs/outcomes_env_died"] == 2
    losses = [entry["loss"] for entry in trainer.state.log_history if "loss" in entry]
    assert len(losses) == 2
    assert not any(map(math.isnan, losses))
