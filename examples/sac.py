"""SAC on an asynchronous group: a replay buffer filled in order of arrival.

    python examples/sac.py --task HalfCheetah-v5

The buffer needs no order, so nobody waits for anybody: results are stored as they arrive, their
environments get the next action at once, and they step while the learner learns.
Hyperparameters are CleanRL's, one update for each transition.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Normal
from torch.nn.functional import mse_loss, softplus
from training_run import Run, arguments

import rlightning_aio as rl


@dataclass
class Args:
    task: str = "HalfCheetah-v5"
    backend: str = "mujoco"
    seed: int = 1
    total_steps: int = 1_000_000
    folder: str = "runs/sac"
    resume: bool = False
    record_every: int = 256
    save_every: int = 10_000
    num_envs: int = 8
    min_results: int = 4
    buffer_size: int = 1_000_000
    batch_size: int = 256
    learning_starts: int = 5_000
    hidden: int = 256
    policy_learning_rate: float = 3e-4
    critic_learning_rate: float = 1e-3
    policy_every: int = 2
    gamma: float = 0.99
    tau: float = 0.005


def network(inputs: int, outputs: int, hidden: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(),
        nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs),
    )  # fmt: skip


class Actor(nn.Module):
    """A Gaussian, squashed into the bounds of the action space."""

    def __init__(self, size: int, actions: Any, hidden: int) -> None:
        super().__init__()
        self.body = network(size, 2 * actions.shape[0], hidden)
        self.register_buffer("scale", torch.as_tensor((actions.high - actions.low) / 2))
        self.register_buffer("center", torch.as_tensor((actions.high + actions.low) / 2))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Actions, and their log-probabilities."""
        mean, log_std = self.body(observation).chunk(2, -1)
        log_std = -5 + 3.5 * (torch.tanh(log_std) + 1)
        policy = Normal(mean, log_std.exp())
        raw = policy.rsample()
        # log(1 - tanh(raw)^2), where that doesn't round to log(0).
        slope = 2 * (np.log(2) - raw - softplus(-2 * raw))
        log_prob = policy.log_prob(raw) - slope - torch.log(self.scale)
        return torch.tanh(raw) * self.scale + self.center, log_prob.sum(-1)


class Replay:
    """The latest transitions, as columns."""

    def __init__(self, size: int, observation: int, action: int) -> None:
        widths = {
            "observation": observation, "action": action, "following": observation,
            "reward": 1, "terminated": 1,
        }  # fmt: skip
        self.columns = {name: torch.zeros(size, width) for name, width in widths.items()}
        self.size, self.added = size, 0

    def __len__(self) -> int:
        return min(self.added, self.size)

    def add(self, **columns: Any) -> None:
        count = len(columns["reward"])
        places = torch.arange(self.added, self.added + count) % self.size
        for name, column in self.columns.items():
            column[places] = torch.as_tensor(columns[name], dtype=torch.float32).view(count, -1)
        self.added += count

    def sample(self, count: int) -> dict[str, Tensor]:
        places = torch.randint(len(self), (count,))
        return {name: column[places] for name, column in self.columns.items()}

    def state(self) -> dict[str, Any]:
        kept = {name: column[: len(self)].clone() for name, column in self.columns.items()}
        return {"columns": kept, "added": self.added}

    def load(self, state: dict[str, Any]) -> None:
        self.added = state["added"]
        for name, column in state["columns"].items():
            self.columns[name][: len(column)] = column


class Learner(nn.Module):
    """Two critics with targets that follow them, the actor, and the weight of its entropy."""

    def __init__(self, args: Args, size: int, actions: Any) -> None:
        super().__init__()
        self.args, self.updates, width = args, 0, actions.shape[0]
        self.actor = Actor(size, actions, args.hidden)
        self.critics = nn.ModuleList(network(size + width, 1, args.hidden) for _ in range(2))
        self.targets = nn.ModuleList(network(size + width, 1, args.hidden) for _ in range(2))
        self.targets.load_state_dict(self.critics.state_dict())
        self.log_alpha = nn.Parameter(torch.zeros(1))
        self.entropy_target = -float(width)
        adam, rates = torch.optim.Adam, (args.policy_learning_rate, args.critic_learning_rate)
        self.optimizers = {
            "actor": adam(self.actor.parameters(), rates[0], fused=True),
            "critics": adam(self.critics.parameters(), rates[1], fused=True),
            "alpha": adam([self.log_alpha], rates[1], fused=True),
        }

    def values(self, critics: nn.ModuleList, observation: Tensor, action: Tensor) -> list[Tensor]:
        both = torch.cat([observation, action], -1)
        return [critic(both).squeeze(-1) for critic in critics]

    def _step(self, name: str, loss: Tensor) -> None:
        self.optimizers[name].zero_grad()
        loss.backward()
        self.optimizers[name].step()

    def learn(self, replay: Replay) -> dict[str, float]:
        """Update the critics; and the actor at intervals."""
        self.updates += 1
        part = replay.sample(self.args.batch_size)
        reward, terminated = part["reward"].squeeze(-1), part["terminated"].squeeze(-1)
        with torch.no_grad():
            action, log_prob = self.actor(part["following"])
            following = torch.min(*self.values(self.targets, part["following"], action))
            following -= self.log_alpha.exp() * log_prob
            goal = reward + self.args.gamma * (1 - terminated) * following
        values = self.values(self.critics, part["observation"], part["action"])
        critic_loss = mse_loss(values[0], goal) + mse_loss(values[1], goal)
        self._step("critics", critic_loss)
        if self.updates % self.args.policy_every == 0:
            # Makes up for the updates left out in between.
            for _ in range(self.args.policy_every):
                action, log_prob = self.actor(part["observation"])
                value = torch.min(*self.values(self.critics, part["observation"], action))
                self._step("actor", (self.log_alpha.exp().detach() * log_prob - value).mean())
                missing = (log_prob.detach() + self.entropy_target).mean()
                self._step("alpha", -self.log_alpha.exp().squeeze() * missing)
        with torch.no_grad():
            pairs = zip(self.targets.parameters(), self.critics.parameters(), strict=True)
            for target, source in pairs:
                target.lerp_(source, self.args.tau)
        return {"critic_loss": critic_loss.item(), "alpha": self.log_alpha.exp().item()}


async def train(args: Args) -> Run:
    torch.manual_seed(args.seed)
    entry = {
        "name": "env", "backend": args.backend, "task": args.task, "num_workers": args.num_envs,
    }  # fmt: skip
    run = Run(args.total_steps, args.folder, args.resume)
    async with rl.build_env_group(entry) as group:
        actions = group.get_action_spaces()[0]
        size = group.get_observation_spaces()[0].shape[0]
        learner = Learner(args, size, actions)
        replay = Replay(args.buffer_size, size, actions.shape[0])
        if run.saved:
            learner.load_state_dict(run.saved["learner"])
            learner.updates = run.saved["updates"]
            for name, optimizer in learner.optimizers.items():
                optimizer.load_state_dict(run.saved["optimizers"][name])
            replay.load(run.saved["replay"])
            torch.set_rng_state(run.saved["random"])

        def save() -> None:
            optimizers = {name: o.state_dict() for name, o in learner.optimizers.items()}
            run.save(
                {
                    "args": asdict(args),
                    "learner": learner.state_dict(),
                    "updates": learner.updates,
                    "optimizers": optimizers,
                    "replay": replay.state(),
                    "random": torch.get_rng_state(),
                }
            )

        def act(observation: Any) -> Any:
            with torch.no_grad():
                action, _ = learner.actor(torch.as_tensor(observation, dtype=torch.float32))
            if replay.added < args.learning_starts:
                action = (2 * torch.rand_like(action) - 1) * learner.actor.scale
                action += learner.actor.center
            return action.numpy()

        with group.auto_reset(), run:
            batch, _ = await group.reset(seed=args.seed + run.steps)
            before = batch.observation.copy()  # The last observation of each environment.
            figures, fresh, returns = {"critic_loss": 0.0, "alpha": 1.0}, 0, list[float]()
            saved_at = run.steps
            group.step_async(batch.respond(action=act(batch.observation)))
            while run.goes_on():
                batch, _ = await group.collect_async(min_results=args.min_results)
                group.step_async(batch.respond(action=act(batch.observation)))
                steps = ~batch.is_reset
                replay.add(
                    observation=before[batch.index[steps]],
                    action=batch.sent.action[steps],
                    following=batch.observation[steps],
                    reward=batch.reward[steps],
                    terminated=batch.terminated[steps],
                )
                before[batch.index] = batch.observation
                count = int(steps.sum())
                if replay.added > args.learning_starts:
                    with run.learning():
                        for _ in range(count):
                            figures = learner.learn(replay)
                ended = batch.done & ~batch.restarted  # A lost episode has no return.
                if ended.any():
                    returns += batch.infos["episode"]["r"][ended].tolist()
                fresh += count
                if fresh >= args.record_every:
                    run.record(fresh, returns, **figures)
                    fresh, returns = 0, []
                if run.steps - saved_at >= args.save_every:
                    save()
                    saved_at = run.steps
            save()
    return run


if __name__ == "__main__":
    trained = rl.run(train(arguments(Args)))
    print({name: round(value, 3) for name, value in trained.rows[-1].items()})
