"""The baseline of `test_ppo.py`: PPO as CleanRL writes it, on Gymnasium's `SyncVectorEnv`.

Rule: the loop, the wrappers around each environment and the hyperparameters are CleanRL's
(ppo.py, ppo_continuous_action.py, with SAME_STEP as its change to Gymnasium 1 has it). The network
and the learner are those of `examples/ppo.py`, so only the source of experience differs.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from ppo import Agent, advantages, learn  # The examples are not a package.
from training_run import Run

if TYPE_CHECKING:
    from ppo import Args


def returns_of(infos: dict[str, Any]) -> list[float]:
    """Returns of the episodes that ended in a step."""
    found = infos.get("final_info", infos)
    return found["episode"]["r"][found["_episode"]].tolist() if "episode" in found else []


def make_env(args: Args) -> gym.Env[Any, Any]:
    """Make one environment in CleanRL's wrappers."""
    env = gym.make(args.task)
    if not args.normalize:
        return gym.wrappers.RecordEpisodeStatistics(env)
    env = gym.wrappers.RecordEpisodeStatistics(gym.wrappers.FlattenObservation(env))
    env = gym.wrappers.NormalizeObservation(gym.wrappers.ClipAction(env))
    env = gym.wrappers.TransformObservation(env, lambda o: np.clip(o, -10, 10), None)
    env = gym.wrappers.NormalizeReward(env, gamma=args.gamma)
    return gym.wrappers.TransformReward(env, lambda r: np.clip(r, -10, 10))


def train(args: Args) -> tuple[Run, Agent]:
    """Train as CleanRL does."""
    torch.manual_seed(args.seed)
    makers = [partial(make_env, args)] * args.num_envs
    envs: Any = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
    agent = Agent(envs.single_observation_space, envs.single_action_space)
    optimizer = torch.optim.Adam(agent.parameters(), args.learning_rate, eps=1e-5, fused=True)
    shape = (args.num_steps, args.num_envs)
    seen = torch.zeros((*shape, *envs.single_observation_space.shape))
    chosen = torch.zeros((*shape, *envs.single_action_space.shape))
    log_probs, rewards, dones, values = (torch.zeros(shape) for _ in range(4))
    with Run(args.total_steps, args.folder) as run:
        first, _ = envs.reset(seed=args.seed)
        observation = torch.Tensor(first)
        while run.goes_on():
            returns: list[float] = []
            for step in range(args.num_steps):
                seen[step] = observation
                with torch.no_grad():
                    policy = agent.policy(observation)
                    action = policy.sample()
                    values[step] = agent.value(observation)
                    log_probs[step] = agent.judged(policy, action)
                chosen[step] = action
                following, reward, ended, cut, infos = envs.step(action.numpy())
                observation = torch.Tensor(following)
                rewards[step] = torch.Tensor(reward)
                dones[step] = torch.Tensor(ended | cut)
                returns += returns_of(infos)
            with run.learning():
                optimizer.param_groups[0]["lr"] = args.learning_rate * run.remaining
                with torch.no_grad():
                    last = agent.value(observation)
                gains = advantages(rewards, values, dones, last, args)
                columns = {
                    "observation": seen, "action": chosen, "log_prob": log_probs,
                    "value": values, "advantage": gains,
                    "target": gains + values,
                }  # fmt: skip
                flat = {name: column.flatten(0, 1) for name, column in columns.items()}
                figures = learn(agent, optimizer, args, flat)
            run.record(args.num_steps * args.num_envs, returns, **figures)
    envs.close()
    return run, agent
