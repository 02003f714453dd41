"""Evaluate what ppo.py, ppo_async.py or ppo_overlap.py have learned, over some episodes.

    python examples/evaluate.py --folder runs/ppo_async --episodes 10

Each environment plays the same number of episodes: those that end first would favour short ones.
Actions are the likeliest ones, and observations are normalised with training's statistics.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ppo
import torch
from torch.distributions import Categorical
from training_run import arguments

import rlightning_aio as rl
from rlightning_aio.evaluation import Evaluation, evaluate
from rlightning_aio.normalize import Normalizer


@dataclass
class Args:
    task: str = "as trained"
    folder: str = "runs/ppo"
    episodes: int = 5
    num_envs: int = 8
    seed: int = 1_000


async def evaluation(args: Args) -> Evaluation:
    """Play all episodes."""
    saved = torch.load(Path(args.folder) / "checkpoint.pt", weights_only=True)
    trained = saved["args"]
    task = trained["task"] if args.task == "as trained" else args.task
    entry = {
        "name": "env", "backend": trained["backend"], "task": task, "num_workers": args.num_envs,
    }  # fmt: skip
    async with rl.build_env_group(entry) as group:
        observations, actions = group.get_observation_spaces()[0], group.get_action_spaces()[0]
        agent = ppo.Agent(observations, actions)
        agent.load_state_dict(saved["agent"])
        normalizer = Normalizer(observations=trained["normalize"])
        normalizer.load_state_dict(saved["normalizer"])

        def act(batch: rl.BatchedData) -> Any:
            seen = normalizer.normalized(batch.observation)
            with torch.inference_mode():
                policy = agent.policy(torch.from_numpy(seen))
            if isinstance(policy, Categorical):
                return policy.probs.argmax(-1).numpy()
            return policy.mean.numpy().clip(actions.low, actions.high)

        return await evaluate(group, act, args.episodes, seed=args.seed)


if __name__ == "__main__":
    found = rl.run(evaluation(arguments(Args)))
    reward = found.total_reward
    either_side = reward.high - reward.mean
    print(f"{reward.count} episodes: return {reward.mean:.1f} +- {either_side:.1f} (95 %)")
