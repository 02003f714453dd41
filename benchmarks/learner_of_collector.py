"""Stable-Baselines3's PPO on the rollouts of a `Collector`, for faulty_training.py."""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from rlightning_aio.collecting import Collector

__all__ = ["LearnerOfCollector"]


class LearnerOfCollector(PPO):
    """Its update is PPO's own; transitions and advantages come from a `Collector`.

    Args:
        group: of envs, initialised.
        make: makes an env with their spaces.
        num_transitions: of each rollout, in a block.
        fields: of `PPO`.
    """

    def __init__(self, group: Any, make: Any, num_transitions: int, **fields: Any) -> None:
        # It has the spaces and the number of envs; only its first observations are read.
        same = DummyVecEnv([make] * len(group))
        super().__init__("MlpPolicy", same, **fields)
        self._collector = Collector(
            group, self._answer, num_transitions=num_transitions, wait_all=True, seed=self.seed
        )

    def _answer(self, batch: Any) -> dict[str, Any]:
        with torch.no_grad():
            action, value, log_prob = self.policy(torch.as_tensor(batch.observation))
        return {"action": action, "value": value[:, 0], "log_prob": log_prob}

    def collect_rollouts(
        self, env: Any, callback: Any, rollout_buffer: Any, n_rollout_steps: int
    ) -> bool:
        """Fill SB3's buffer with a rollout."""
        del env, callback, n_rollout_steps
        rollout = self._collector.collect()
        with torch.no_grad():
            ends = self.policy.predict_values(torch.as_tensor(rollout.end_observation))
        advantages = rollout.advantages(
            rollout.value, ends.numpy()[:, 0], self.gamma, self.gae_lambda
        )
        rollout_buffer.reset()
        rollout_buffer.observations[:] = rollout.observation
        rollout_buffer.actions[:] = rollout.action[..., None]
        for name in ("value", "log_prob"):
            getattr(rollout_buffer, f"{name}s")[:] = rollout[name]
        rollout_buffer.advantages[:] = advantages
        rollout_buffer.returns[:] = advantages + rollout.value
        rollout_buffer.full = True
        self.num_timesteps += len(rollout)
        return True
