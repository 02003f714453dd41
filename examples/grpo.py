"""A GRPO update in forty lines: groups of attempts, and a loss that counts the model's own tokens.

    python examples/grpo.py

The model is a table of eight tokens, so that it learns in seconds. For yours, take the replies from
your server in `agent`, and the log-probabilities from your trainer's forward pass in `loss_of`. If
you make several updates with the same attempts, keep the log-probabilities of the replies as a
column, too, and clip the ratio to them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

import rlightning_aio as rl
from rlightning_aio.attempts import AttemptEpisode, AttemptGroup, EpisodeSpec, play

if TYPE_CHECKING:
    from collections.abc import Sequence

UPDATES = 20


class Till:
    """Rewards each turn after the first token 7."""

    async def reset(self, *, seed: int = 0, **_: Any) -> tuple[list[int], dict[str, Any]]:
        self.total, self.turns = 0, 0
        return [1, 2 + seed], {}  # The ids of a prompt.

    async def step(self, ids: list[int]) -> Any:
        self.total, self.turns = self.total + ids.count(7), self.turns + 1
        return [1, self.total % 8], float(self.total > 0), self.turns == 3, False, {}


async def agent(model: nn.Module, episode: AttemptEpisode) -> None:
    """Play one attempt; what was read before each reply is kept as a column."""
    seen: list[int] = []
    while not episode.is_over:
        read: list[int] = episode.last.observation
        seen, reply = [*seen, *read], list[int]()
        for _ in range(2):
            with torch.no_grad():
                logits = model(torch.tensor((seen + reply)[-1]))
            reply.append(int(torch.distributions.Categorical(logits=logits).sample()))
        await episode.step(reply, read=read)
        seen = seen + reply


def loss_of(model: nn.Module, groups: Sequence[AttemptGroup]) -> Tensor | None:
    """The loss over all tokens of replies; None if no group has two attempts that did not fail."""
    total, count = torch.zeros(()), 0
    for group in groups:
        rewards = torch.tensor(group.rewards)  # Of those that did not fail.
        for one in group:
            if one.reward is None or len(rewards) < 2:
                continue
            advantage = (one.reward - rewards.mean()) / (rewards.std() + 1e-4)
            ids, is_reply = list[int](), list[int]()
            for read, reply in zip(one.columns["read"], one.columns["action"], strict=True):
                ids += read + reply
                is_reply += [0] * len(read) + [1] * len(reply)
            tokens, mask = torch.tensor(ids), torch.tensor(is_reply)[1:]
            log_probs = model(tokens[:-1]).log_softmax(-1).gather(-1, tokens[1:, None])[:, 0]
            total = total - (advantage * log_probs * mask).sum()
            count += int(mask.sum())
    return total / count if count else None


async def main() -> None:
    torch.manual_seed(0)
    model = nn.Sequential(nn.Embedding(8, 16), nn.Linear(16, 8))
    optimizer = torch.optim.Adam(model.parameters(), lr=0.02)
    tasks = [EpisodeSpec("", seed) for seed in range(4)]
    async with rl.build_env_group(Till, num_workers=32, placement="loop") as envs:
        for update in range(UPDATES):
            playing = play(envs, tasks, lambda episode: agent(model, episode), size=8)
            groups = [group async for group in playing]
            rewards = [reward for group in groups for reward in group.rewards]
            print(f"update {update}: mean reward {sum(rewards) / len(rewards):.2f}")
            if (loss := loss_of(model, groups)) is not None:
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()


if __name__ == "__main__":
    rl.run(main())
