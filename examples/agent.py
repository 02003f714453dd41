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
from typing import Any

import numpy as np
from model import Model
from openai import AsyncOpenAI
from shop import TASKS, TOOLS

import rlightning_aio as rl
from rlightning_aio.attempts import Attempt, AttemptEpisode, EpisodeSpec, Rules, play

SEEDS, GROUP_SIZE = 4, 8
TOKENS = ("prompt_tokens", "completion_tokens", "token_ids", "logprobs")


async def converse(model: Any, episode: AttemptEpisode) -> None:
    """The agent: answer every message until the episode is over."""
    while not episode.is_over:
        reply = await model(episode.last.observation)
        await episode.step(**reply)


def rollout_of(attempt: Attempt) -> dict[str, Any]:
    """A line of the file."""
    prompt, messages = messages_of(attempt.first), messages_of(attempt.last)
    outcome = attempt.outcome
    return {
        "prompt": prompt,
        "completion": messages[len(prompt) :],
        "messages": messages,
        "task": (attempt.spec.options or {})["task"],
        "seed": attempt.spec.seed,
        "reward": attempt.reward,
        "advantage": None,
        "tools": TOOLS,
        "is_truncated": outcome.kind == "truncated",
        "outcome": outcome.to_json(),
        "error": outcome.cause if outcome.is_failure else None,
        **{name: attempt.columns.get(name, []) for name in TOKENS},
    }


def messages_of(observation: Any) -> Any:
    """An OpenEnv server sends them as a field; an attempt that did not start has none."""
    found = observation["observation"] if isinstance(observation, dict) else observation
    return found or []


async def over_openenv(model: Model, observation: Any) -> dict[str, Any]:
    """The columns of a step whose action is a field, too."""
    reply = await model(messages_of(observation))
    return {**reply, "action": {"action": reply["action"]}}


def compare(group: list[dict[str, Any]]) -> None:
    """GRPO's advantage: the reward minus the mean of the group, over the standard deviation.

    Rollouts that failed have none, and count neither for the mean nor for the deviation.
    """
    whole = [rollout for rollout in group if rollout["reward"] is not None]
    rewards = np.array([rollout["reward"] for rollout in whole])
    for rollout in whole:
        rollout["advantage"] = (rollout["reward"] - rewards.mean()) / (rewards.std() + 1e-4)


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--base-url", required=True)
    parser.add_argument("--model", required=True)
    parser.add_argument("--stream", action="store_true", help="have the replies streamed")
    parser.add_argument("--body", type=json.loads, help="further fields of requests, as JSON")
    parser.add_argument("--out", type=Path, default=Path("rollouts.jsonl"))
    parser.add_argument("--patience", type=float, default=600.0, help="seconds for a server away")
    parser.add_argument("--retries", type=int, default=2, help="of an attempt that failed")
    parser.add_argument("--openenv", metavar="URL", help="OpenEnv server of the environment")
    args = parser.parse_args()
    key = os.environ.get("OPENAI_API_KEY", "none")
    client = AsyncOpenAI(base_url=args.base_url, api_key=key, max_retries=0)
    request = {"model": args.model, "stream": args.stream, "extra_body": args.body}
    if args.stream:
        request["stream_options"] = {"include_usage": True}
    model: Any = Model(client, args.patience, **request)
    tasks = [EpisodeSpec("", seed, {"task": task}) for task in TASKS for seed in range(SEEDS)]
    entry = {"name": "shop", "backend": "shop", "task": "-", "placement": "loop"}
    entry |= {"num_workers": len(tasks) * GROUP_SIZE, "step_timeout": 60}
    if args.openenv is not None:
        entry |= {"backend": "openenv", "task": args.openenv}
        entry |= {"env_kwargs": {"truncated_field": "truncated"}}
        model = partial(over_openenv, model)
    groups: list[list[dict[str, Any]]] = []
    async with client, rl.build_env_group(entry) as group:
        rules, agent = Rules(retries=args.retries), partial(converse, model)
        async for attempts in play(group, tasks, agent, GROUP_SIZE, rules):
            groups.append([rollout_of(attempt) for attempt in attempts])
            compare(groups[-1])
    lines = [line for found in groups for line in found]
    with args.out.open("w") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)
    failed = [line["error"] for line in lines if line["error"]]
    right = sum(line["reward"] or 0.0 for line in lines)
    print(f"{len(lines)} episodes, {right:.0f} right, {len(failed)} failed", *failed[:1], sep=": ")


if __name__ == "__main__":
    rl.run(main())
