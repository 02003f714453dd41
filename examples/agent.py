"""64 concurrent attempts of an LLM agent with tools, against any OpenAI-compatible server.

    pip install . -r requirements/agents.txt
    python examples/agent.py --base-url http://127.0.0.1:8000/v1 --model Qwen/Qwen3-4B

The environment (shop.py) asks questions and runs tools; observations and actions are messages.
Each task is played 8 times with the same seed; GRPO compares the rewards. An attempt that fails is
tried again. If that fails, too, it has no reward, but an outcome, which says who can be to blame.
The rollouts are written as JSON lines, which docs/agents.md describes.
"""

from __future__ import annotations

import argparse
import json
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from model import Model
from openai import AsyncOpenAI
from shop import TASKS, TOOLS

import rlightning_aio as rl
from rlightning_aio.attempts import AttemptEpisode, AttemptGroup, EpisodeSpec, Rules, play

if TYPE_CHECKING:
    from collections.abc import Iterator

SEEDS, GROUP_SIZE = 4, 8
TOKENS = ("prompt_tokens", "completion_tokens", "token_ids", "logprobs")


async def converse(model: Any, episode: AttemptEpisode) -> None:
    """The agent: answer every message until the episode is over."""
    while not episode.is_over:
        reply = await model(episode.last.observation)
        await episode.step(**reply)


def rollouts_of(attempts: AttemptGroup) -> Iterator[dict[str, Any]]:
    """Lines of the file. GRPO's advantages compare the attempts that have a reward."""
    rewards = np.array(attempts.rewards)
    for attempt in attempts:
        prompt: list[Any] = attempt.first or []
        messages: list[Any] = attempt.last or []
        outcome, advantage = attempt.outcome, None
        if attempt.reward is not None:
            advantage = (attempt.reward - rewards.mean()) / (rewards.std() + 1e-4)
        yield {
            "prompt": prompt,
            "completion": messages[len(prompt) :],
            "messages": messages,
            "task": (attempt.spec.options or {})["task"],
            "seed": attempt.spec.seed,
            "reward": attempt.reward,
            "advantage": advantage,
            "tools": TOOLS,
            "is_truncated": outcome.kind == "truncated",
            "outcome": outcome.to_json(),
            "error": outcome.cause if outcome.is_failure else None,
            **{name: attempt.columns.get(name, []) for name in TOKENS},
        }


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--base-url", required=True)
    parser.add_argument("--model", required=True)
    parser.add_argument("--stream", action="store_true", help="have the replies streamed")
    parser.add_argument("--body", type=json.loads, help="further fields of requests, as JSON")
    parser.add_argument("--out", type=Path, default=Path("rollouts.jsonl"))
    parser.add_argument("--patience", type=float, default=600.0, help="seconds for a server away")
    parser.add_argument("--retries", type=int, default=2, help="of an attempt that failed")
    args = parser.parse_args()
    key = os.environ.get("OPENAI_API_KEY", "none")
    client = AsyncOpenAI(base_url=args.base_url, api_key=key, max_retries=0)
    model = Model(client, args.patience, args.stream, model=args.model, extra_body=args.body)
    tasks = [EpisodeSpec("", seed, {"task": task}) for task in TASKS for seed in range(SEEDS)]
    lines: list[dict[str, Any]] = []
    shop: dict[str, Any] = {"name": "shop", "backend": "shop", "task": "-", "placement": "loop"}
    shop |= {"num_workers": len(tasks) * GROUP_SIZE, "step_timeout": 60}
    async with client, rl.build_env_group(shop) as group:
        rules, agent = Rules(retries=args.retries), partial(converse, model)
        async for attempts in play(group, tasks, agent, GROUP_SIZE, rules):
            lines += rollouts_of(attempts)
    args.out.write_text("".join(json.dumps(line) + "\n" for line in lines))
    failed = [line["error"] for line in lines if line["error"]]
    right = sum(line["reward"] or 0.0 for line in lines)
    print(f"{len(lines)} episodes, {right:.0f} right, {len(failed)} failed", *failed[:1], sep=": ")


if __name__ == "__main__":
    rl.run(main())
