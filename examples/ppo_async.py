"""PPO on an asynchronous group: first come, first served, with chains of any length.

    python examples/ppo_async.py                              # HalfCheetah-v5, 16 environments
    python examples/ppo_async.py --num-envs 2 --envs-each 8   # the same, 8 to a worker's call
    python examples/ppo_async.py --task CartPole-v1

Network, loss and hyperparameters are those of ppo.py. A rollout has a fixed total of transitions,
of which a fast environment makes more than a slow one. Truncated episodes and chains
that continue in the next rollout are bootstrapped, each from its own next observation.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict, dataclass
from typing import Any

import ppo
import torch
from player import Player, single
from training_run import Run, arguments, tensors

import rlightning_aio as rl
from rlightning_aio.collecting import Collector, Rollout
from rlightning_aio.normalize import Normalizer


@dataclass
class Collecting:
    folder: str = "runs/ppo_async"
    placement: str = "process"
    envs_per_process: int = 0  # As many as there are cores for workers.
    envs_each: int = 1
    min_results: int = 8


@dataclass
class Args(Collecting, ppo.Args):
    """CleanRL's hyperparameters, and options of collecting."""


@dataclass
class CartPole(Collecting, ppo.CartPole):
    # A step takes less than any way to another process: the task's own vector environment, here.
    placement: str = "inline"
    num_envs: int = 1
    envs_each: int = 4
    min_results: int = 1


class Learner:
    """The learner, and the contents of a checkpoint."""

    def __init__(self, args: Args | CartPole, group: rl.EnvGroup, run: Run) -> None:
        observations, actions = (
            get()[0] for get in (group.get_observation_spaces, group.get_action_spaces)
        )
        if args.envs_each > 1:  # Spaces of all sub-environments.
            observations, actions = single(observations), single(actions)
        self.args = args
        self.agent = ppo.Agent(observations, actions)
        self.optimizer = torch.optim.Adam(
            self.agent.parameters(), args.learning_rate, eps=1e-5, fused=True
        )
        normalize = args.normalize
        self.normalizer = Normalizer(args.gamma, observations=normalize, rewards=normalize)
        if run.saved:
            self.agent.load_state_dict(run.saved["agent"])
            self.optimizer.load_state_dict(run.saved["optimizer"])
            self.normalizer.load_state_dict(run.saved["normalizer"])
            torch.set_rng_state(run.saved["random"])
        self.player = Player(self.agent, self.normalizer, actions, args.seed + run.steps)

    def state(self) -> dict[str, Any]:
        return {
            "args": asdict(self.args),
            "agent": self.agent.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "normalizer": tensors(self.normalizer.state_dict()),
            "random": torch.get_rng_state(),
        }

    def columns(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Columns for `learn`, with a fixed normaliser."""
        after = self.normalizer.normalized(rollout.end_observation)
        after = torch.from_numpy(after).flatten(1)
        rollout.reward[:] = self.normalizer.scaled(rollout.reward)
        seen = torch.from_numpy(rollout.seen)
        with torch.no_grad():
            value, next_value = self.agent.value(seen), self.agent.value(after)
        gains = rollout.advantages(value, next_value, self.args.gamma, self.args.gae_lambda)
        advantage = torch.from_numpy(gains)
        return {
            "observation": seen,
            "action": torch.from_numpy(rollout.raw),
            "log_prob": torch.from_numpy(rollout.log_prob),
            "value": value,
            "advantage": advantage,
            "target": advantage + value,
        }

    def learn(self, columns: dict[str, torch.Tensor], rate: float) -> dict[str, float]:
        self.optimizer.param_groups[0]["lr"] = rate
        return ppo.learn(self.agent, self.optimizer, self.args, columns)


def entry_of(args: Args | CartPole) -> dict[str, Any]:
    entry = {
        "name": "env",
        "backend": args.backend,
        "task": args.task,
        "num_workers": args.num_envs,
        "num_envs": args.envs_each,
        "placement": args.placement,
    }
    if args.envs_per_process:
        entry["envs_per_process"] = args.envs_per_process
    return entry


async def train(args: Args | CartPole) -> Run:
    torch.manual_seed(args.seed)
    run = Run(args.total_steps, args.folder, args.resume)
    async with rl.build_env_group(entry_of(args)) as group:
        learner = Learner(args, group, run)
        player = learner.player
        collector = Collector(
            group,
            player,
            num_transitions=args.num_envs * args.envs_each * args.num_steps,
            min_results=args.min_results,
            seed=args.seed + run.steps,
        )
        with run, group.trace(args.trace) if args.trace else nullcontext():
            while run.goes_on():
                rollout = await collector.collect()
                with run.learning(), group.span("learner"):
                    rate = args.learning_rate * run.remaining
                    figures = learner.learn(learner.columns(rollout), rate)
                    player.take(learner.agent)
                collector.policy_version += 1
                figures["lag"] = rollout.lag.mean()
                returns = rollout.episodes["total_reward"].tolist()
                run.record(len(rollout), returns, **figures)
                if len(run.rows) % args.save_every == 0:
                    run.save(learner.state())
            run.save(learner.state())
    return run


if __name__ == "__main__":
    trained = rl.run(train(arguments(Args, CartPole)))
    print({name: round(value, 3) for name, value in trained.rows[-1].items()})
