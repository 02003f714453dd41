"""Models with a `predict`, whose recurrent state belongs to one episode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from policies.counting import QUEUE, check, evaluated
from run_python import blocks, output_of

from rlightning_aio import sync
from rlightning_aio.evaluation import evaluate


class Recurrent:
    """Counts the steps of each env in its state, as a recurrent network would.

    Its state is a tuple of arrays ``[layers, n, size]``, as that of sb3-contrib's RecurrentPPO.
    """

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> Any:
        assert deterministic
        count = len(observation)
        steps, other = (np.zeros((2, count, 1)),) * 2 if state is None else state
        steps = steps * (1 - episode_start)[None, :, None]
        step = steps[0, :, 0]
        actions = np.stack([observation[:, 0], step - step % 3, step % 3], axis=1)
        return actions, (steps + 1, other)


def test_recurrent_state_belongs_to_one_episode() -> None:
    """It follows its env through batches of other envs, and is lost with its episode."""
    check(evaluated(Recurrent(), 3, retries=5, env_kwargs={"breaks": True}))


def test_sub_environments_have_a_state_each() -> None:
    """Their observations are given to the model as rows of one batch."""
    seen: list[Any] = []

    class Model:
        def predict(self, observation: Any, **options: Any) -> Any:
            seen.append((observation.shape, options["episode_start"].tolist()))
            return np.zeros(len(observation), np.int64), (np.zeros((1, len(observation), 2)),)

    entry = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_envs": 2}
    with sync.build_env_group({**entry, "placement": "inline"}) as group, group.auto_reset(2):
        evaluate(group, Model(), 1)
    assert seen == [((2, 4), [True, True]), ((2, 4), [False, False])]


@pytest.mark.simulators
def test_models_of_stable_baselines3() -> None:
    """Episodes are those of SB3's own loop, by seed."""
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.PPO("MlpPolicy", "CartPole-v1", n_steps=64, seed=0, device="cpu").learn(64)
    expected: list[float] = []
    env = gym.make("CartPole-v1")
    for spec in QUEUE:
        (observation, _), over, total = env.reset(seed=spec.seed), False, 0.0
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        expected.append(total)
    entry = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 2}
    with sync.build_env_group({**entry, "placement": "inline"}) as group, group.auto_reset(500):
        found = evaluate(group, model, QUEUE)
    returns = {one.spec.seed: one.reward for one in found.attempts}
    assert [returns[spec.seed] for spec in QUEUE] == expected


@pytest.mark.simulators
def test_the_program_of_the_page_runs(tmp_path: Path) -> None:
    """It evaluates a model of Stable-Baselines3."""
    pytest.importorskip("stable_baselines3")
    page = Path(__file__).parents[2] / "docs" / "evaluating.md"
    (program,) = (one for one in blocks("python", page.read_text()) if "stable_baselines3" in one)
    file = tmp_path / "program.py"
    file.write_text(program)
    assert float(output_of(file, folder=tmp_path, asyncio_debug=False)) > 0
