"""PPO on a synchronous group: CleanRL's loop and hyperparameters, in lockstep.

    python examples/ppo.py                          # HalfCheetah-v5
    python examples/ppo.py --task CartPole-v1

With the same seeds it learns the same weights, bit for bit, as that loop on Gymnasium's vector
environments (SAME_STEP, its wrappers around each), if there is one environment, or nothing is
normalised: the statistics here are those of all environments together. Like that loop, it treats
a truncated episode as a terminated one; ppo_async.py does better.
"""

from __future__ import annotations

from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor, nn
from torch.distributions import Categorical, Normal
from training_run import Run, arguments, tensors

from rlightning_aio.normalize import Normalizer
from rlightning_aio.vector import make_vec


@dataclass
class Args:
    task: str = "HalfCheetah-v5"
    backend: str = "mujoco"
    seed: int = 1
    total_steps: int = 1_000_000
    folder: str = "runs/ppo"
    resume: bool = False
    trace: str = ""  # The file of a timeline; none.
    save_every: int = 50
    num_envs: int = 16
    num_steps: int = 128
    learning_rate: float = 3e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    num_minibatches: int = 32
    epochs: int = 10
    clip: float = 0.2
    entropy_weight: float = 0.0
    value_weight: float = 0.5
    max_grad_norm: float = 0.5
    normalize: bool = True


@dataclass
class CartPole(Args):
    task: str = "CartPole-v1"
    backend: str = "gymnasium"
    total_steps: int = 500_000
    num_envs: int = 4
    learning_rate: float = 2.5e-4
    num_minibatches: int = 4
    epochs: int = 4
    entropy_weight: float = 0.01
    normalize: bool = False


def layer(inputs: int, outputs: int, gain: float = 2**0.5) -> nn.Linear:
    linear = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(linear.weight, gain)
    nn.init.zeros_(linear.bias)
    return linear


class Agent(nn.Module):
    """Actor and critic, each of two layers of 64; the deviation doesn't depend on the state."""

    def __init__(self, observations: Any, actions: Any) -> None:
        super().__init__()
        size = int(np.prod(observations.shape))
        continuous = isinstance(actions, Box)
        outputs = int(np.prod(actions.shape)) if continuous else int(actions.n)

        def network(outputs: int, gain: float) -> nn.Sequential:
            return nn.Sequential(
                layer(size, 64), nn.Tanh(), layer(64, 64), nn.Tanh(), layer(64, outputs, gain)
            )

        self.critic = network(1, 1.0)
        self.actor = network(outputs, 0.01)
        self.log_std = nn.Parameter(torch.zeros(1, outputs)) if continuous else None

    def value(self, observation: Tensor) -> Tensor:
        return self.critic(observation).squeeze(-1)

    def policy(self, observation: Tensor) -> Categorical | Normal:
        found = self.actor(observation)
        return (
            Categorical(logits=found) if self.log_std is None else Normal(found, self.log_std.exp())
        )

    def judged(self, policy: Categorical | Normal, action: Tensor) -> Tensor:
        """The action's log-probability."""
        found = policy.log_prob(action)
        return found if self.log_std is None else found.sum(-1)

    def entropy(self, policy: Categorical | Normal) -> Tensor:
        return policy.entropy() if self.log_std is None else policy.entropy().sum(-1)


def advantages(rewards: Tensor, values: Tensor, ended: Tensor, last: Tensor, args: Args) -> Tensor:
    """GAE over a block ``[T, N]``; `last` is the value after it."""
    found, following = torch.zeros_like(rewards), torch.zeros_like(last)
    for t in reversed(range(len(rewards))):
        goes_on = 1.0 - ended[t]
        delta = rewards[t] + args.gamma * last * goes_on - values[t]
        found[t] = following = delta + args.gamma * args.gae_lambda * goes_on * following
        last = values[t]
    return found


def learn(
    agent: Agent, optimizer: torch.optim.Optimizer, args: Args, rollout: dict[str, Tensor]
) -> dict[str, float]:
    """An update: some epochs of minibatches over a rollout of columns ``[n, ...]``."""
    size = len(rollout["value"])
    for _ in range(args.epochs):
        order = torch.randperm(size)
        shuffled = {name: column[order] for name, column in rollout.items()}
        parts = {
            name: column.split(size // args.num_minibatches) for name, column in shuffled.items()
        }
        for k in range(args.num_minibatches):
            part = {name: columns[k] for name, columns in parts.items()}
            policy = agent.policy(part["observation"])
            log_ratio = agent.judged(policy, part["action"]) - part["log_prob"]
            ratio = log_ratio.exp()
            gain = part["advantage"]
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            clipped = ratio.clamp(1 - args.clip, 1 + args.clip)
            policy_loss = -torch.min(gain * ratio, gain * clipped).mean()
            value = agent.value(part["observation"])
            near = part["value"] + (value - part["value"]).clamp(-args.clip, args.clip)
            target = part["target"]
            value_loss = 0.5 * torch.max((value - target) ** 2, (near - target) ** 2).mean()
            entropy = agent.entropy(policy).mean()
            loss = policy_loss - args.entropy_weight * entropy + args.value_weight * value_loss
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
            optimizer.step()
    return {
        "policy_loss": policy_loss.item(),
        "value_loss": value_loss.item(),
        "entropy": entropy.item(),
        "kl": ((ratio - 1) - log_ratio).mean().item(),
    }


def train(args: Args) -> Run:
    torch.manual_seed(args.seed)
    run = Run(args.total_steps, args.folder, args.resume)
    # MuJoCo's envs are one batch, with a state; a timeline, and the state of others, need a group.
    grouped = args.trace or args.backend != "mujoco"
    fields: dict[str, Any] = {"placement": "process"} if grouped else {}
    envs: Any = make_vec(args.task, args.num_envs, autoreset_mode="SameStep", **fields)
    with closing(envs):
        group = envs.group if args.trace else None
        observations, actions = envs.single_observation_space, envs.single_action_space
        agent = Agent(observations, actions)
        optimizer = torch.optim.Adam(agent.parameters(), args.learning_rate, eps=1e-5, fused=True)
        everyone = np.arange(args.num_envs)
        normalizer = Normalizer(args.gamma, observations=args.normalize, rewards=args.normalize)
        if run.saved:
            agent.load_state_dict(run.saved["agent"])
            optimizer.load_state_dict(run.saved["optimizer"])
            normalizer.load_state_dict(run.saved["normalizer"])
            torch.set_rng_state(run.saved["random"])

        def state() -> dict[str, Any]:
            return {
                "args": asdict(args),
                "agent": agent.state_dict(),
                "optimizer": optimizer.state_dict(),
                "normalizer": tensors(normalizer.state_dict()),
                "random": torch.get_rng_state(),
                "envs": envs.snapshot(),
                "observation": observation,
                "sums": torch.from_numpy(sums.copy()),
            }

        block = (args.num_steps, args.num_envs)
        with run, group.trace(args.trace) if group else nullcontext():
            if run.saved:
                envs.restore(run.saved["envs"])
                observation, sums = run.saved["observation"], run.saved["sums"].numpy().copy()
            else:
                first, _ = envs.reset(seed=args.seed)
                shown = normalizer.update_observations(first)
                observation = torch.from_numpy(shown)
                sums = np.zeros(args.num_envs)
            while run.goes_on():
                returns: list[float] = []
                rewards, values, log_probs, ended = (torch.zeros(block) for _ in range(4))
                seen = torch.zeros((*block, *observations.shape))
                acted = torch.zeros((*block, *actions.shape), dtype=torch.float32)
                for t in range(args.num_steps):
                    with torch.inference_mode():
                        policy = agent.policy(observation)
                        action = policy.sample()
                        log_probs[t] = agent.judged(policy, action)
                        values[t] = agent.value(observation)
                    seen[t], acted[t] = observation, action
                    chosen = action.numpy()
                    if isinstance(actions, Box):
                        chosen = chosen.clip(actions.low, actions.high)
                    result, reward, terminated, truncated, infos = envs.step(chosen)
                    result = result.copy()  # The batch shows what it returned again.
                    done = terminated | truncated
                    over = np.flatnonzero(done)
                    first = result[over]
                    for k in over:  # The last observations of episodes come before the first.
                        result[k] = infos["final_obs"][k]
                    # Gymnasium's wrapper starts the return again with the reward that terminates.
                    scaled = normalizer.update_rewards(everyone, reward, terminated)
                    shown = normalizer.update_observations(result)
                    rewards[t], ended[t] = torch.from_numpy(scaled), torch.from_numpy(done)
                    sums += reward
                    if done.any():
                        returns += sums[over].tolist()
                        sums[over] = 0.0
                        shown[over] = normalizer.update_observations(first)
                    observation = torch.from_numpy(shown)
                with run.learning(), group.span("learner") if group else nullcontext():
                    optimizer.param_groups[0]["lr"] = args.learning_rate * run.remaining
                    with torch.no_grad():
                        last = agent.value(observation)
                    gains = advantages(rewards, values, ended, last, args)
                    rollout = {
                        "observation": seen,
                        "action": acted,
                        "log_prob": log_probs,
                        "value": values,
                        "advantage": gains,
                        "target": gains + values,
                    }
                    flat = {name: column.flatten(0, 1) for name, column in rollout.items()}
                    figures = learn(agent, optimizer, args, flat)
                run.record(args.num_steps * args.num_envs, returns, **figures)
                if len(run.rows) % args.save_every == 0:
                    run.save(state())
            run.save(state())
    return run


if __name__ == "__main__":
    trained = train(arguments(Args, CartPole))
    print({name: round(value, 3) for name, value in trained.rows[-1].items()})
