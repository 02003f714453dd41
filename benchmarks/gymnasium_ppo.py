"""The baseline of `training.py`: PPO as CleanRL writes it, on vector environments of all kinds.

Rule: the loop, the wrappers around each environment and the hyperparameters are CleanRL's
(ppo.py, ppo_continuous_action.py, with SAME_STEP as its change to Gymnasium 1 has it). `make_vec`
and EnvPool, which knows only NEXT_STEP, are in the same wrappers for vector environments. The
network and the learner are those of `examples/ppo.py`, so only the source of experience differs.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import vector as wrappers

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from ppo import Agent, advantages, learn  # The examples are not a package.
from training_run import Run

if TYPE_CHECKING:
    from ppo import Args

KINDS = {"AsyncVectorEnv": AsyncVectorEnv, "SyncVectorEnv": SyncVectorEnv}


class Pool(gym.vector.VectorEnv[Any, Any, Any]):
    """EnvPool as the vector environment that it is, but not by class."""

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, task: str, num_envs: int, seed: int) -> None:
        import envpool

        self._envs = envpool.make(task, env_type="gymnasium", num_envs=num_envs, seed=seed)
        self.num_envs = num_envs
        self.single_observation_space = self._envs.observation_space
        self.single_action_space = self._envs.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        del seed, options  # It was given its seed.
        return self._envs.reset()[0], {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        return *self._envs.step(actions.astype(np.float64))[:4], {}

    def close_extras(self, **kwargs: Any) -> None:
        del kwargs
        self._envs.close()


def make_together(args: Args, kind: str) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make environments that are stepped together, in CleanRL's wrappers."""
    if kind == "EnvPool":
        envs: Any = Pool(args.task, args.num_envs, args.seed)
    else:
        from rlightning_aio.vector import make_vec

        envs = make_vec(args.task, args.num_envs)
    envs = wrappers.NormalizeObservation(
        wrappers.ClipAction(wrappers.RecordEpisodeStatistics(envs))
    )
    envs = wrappers.TransformObservation(envs, lambda o: np.clip(o, -10, 10))
    envs = wrappers.NormalizeReward(envs, gamma=args.gamma)
    return wrappers.TransformReward(envs, lambda r: np.clip(r, -10, 10))


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


def train(args: Args, kind: str) -> tuple[Run, Agent]:
    """Train on one of Gymnasium's vector environments, on ``make_vec``'s or on EnvPool's."""
    torch.manual_seed(args.seed)
    if kind in KINDS:
        makers = [partial(make_env, args)] * args.num_envs
        envs: Any = KINDS[kind](makers, autoreset_mode=AutoresetMode.SAME_STEP)
    else:
        envs = make_together(args, kind)
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
