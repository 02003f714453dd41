"""64 concurrent episodes of an LLM agent with tools, against any OpenAI-compatible server.

    pip install . -r requirements/agents.txt
    python examples/agent.py --base-url http://127.0.0.1:8000/v1 --model Qwen/Qwen3-4B

The environment (shop.py) asks questions and runs tools; observations and actions are messages.
Results are collected in batches of whatever is ready, and each environment steps as soon as its
own reply is there. Each task is played 8 times with the same seed; GRPO compares their rewards.
A rollout that fails has no reward, and is counted. The rollouts are written as JSON lines, which
docs/agents.md describes.
"""

from __future__ import annotations

import argparse
import asyncio
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

SEEDS, GROUP_SIZE = 4, 8
BLANK = {"prompt": [], "completion": [], "messages": [], "is_truncated": False}
SCORE = {"reward": 0.0, "advantage": None, "error": None}
TOKENS = ("prompt_tokens", "completion_tokens", "token_ids", "logprobs")
LOST = ("worker_restarted", "session_lost", "client_lost")
"""Keys of the info of an episode that did not end by itself; the values say why."""


async def play(group: rl.EnvGroup, policy: Any, rollouts: dict[str, dict[str, Any]]) -> None:
    """Add to the rollouts, until every environment is at the end of its episode."""
    thinking: set[asyncio.Task[None]] = set()

    async def answer(row: rl.BatchedData) -> None:
        try:
            reply = await policy(row.observation[0])
            group.step_async(row.respond(**{name: [value] for name, value in reply.items()}))
        except Exception as error:  # noqa: BLE001  # Whatever a server does ends one episode.
            fail(rollouts[row.ids()[0]], repr(error))

    async with asyncio.TaskGroup() as tasks:
        while True:
            try:
                batch, _ = await group.collect_async()
            except rl.NothingPending:  # All environments that are left wait for the model.
                if not thinking:
                    return
                await asyncio.wait(thinking, return_when=asyncio.FIRST_COMPLETED)
                continue
            except rl.EnvFault as error:
                for env_id in getattr(error, "env_ids", (error.env_id,)):
                    fail(rollouts[env_id], str(error))
                continue
            infos = batch.info()
            for k, env_id in enumerate(batch.ids()):
                causes = [infos[k][key] for key in LOST if key in infos[k]]
                if causes:
                    fail(rollouts[env_id], causes[0])
                else:
                    add(rollouts[env_id], batch, k)
                if not batch.done[k]:
                    thinking.add(task := tasks.create_task(answer(batch.take([k]))))
                    task.add_done_callback(thinking.discard)


def add(rollout: dict[str, Any], batch: rl.BatchedData, k: int) -> None:
    """Add a row to its rollout."""
    rollout["messages"] = messages_of(batch.observation[k])
    if batch.is_reset[k]:
        rollout["prompt"] = rollout["messages"]
        return
    rollout["completion"] = rollout["messages"][len(rollout["prompt"]) :]
    rollout["reward"] += float(batch.reward[k])
    rollout["is_truncated"] = bool(batch.truncated[k])
    for name in TOKENS:
        rollout[name].append(batch.sent[name][k])


def fail(rollout: dict[str, Any], cause: str) -> None:
    """End a rollout without a reward: what it earned so far says nothing about the model."""
    rollout["error"], rollout["reward"] = cause, None


def messages_of(observation: Any) -> Any:
    """An OpenEnv server sends them as a field."""
    return observation["observation"] if isinstance(observation, dict) else observation


async def over_openenv(model: Model, observation: Any) -> dict[str, Any]:
    """The columns of a row whose action is a field, too."""
    reply = await model(messages_of(observation))
    return {**reply, "action": {"action": reply["action"]}}


def compare(group: list[dict[str, Any]]) -> None:
    """GRPO's advantage: the reward minus the mean of the group, over the standard deviation.

    Rollouts that failed have none, and count neither for the mean nor for the deviation.
    """
    whole = [rollout for rollout in group if rollout["error"] is None]
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
    parser.add_argument("--openenv", metavar="URL", help="OpenEnv server of the environment")
    args = parser.parse_args()
    key = os.environ.get("OPENAI_API_KEY", "none")
    client = AsyncOpenAI(base_url=args.base_url, api_key=key, max_retries=0)
    request = {"model": args.model, "stream": args.stream, "extra_body": args.body}
    if args.stream:
        request["stream_options"] = {"include_usage": True}
    model: Any = Model(client, args.patience, **request)
    jobs = [(task, seed) for task in TASKS for seed in range(SEEDS) for _ in range(GROUP_SIZE)]
    entry = {"name": "shop", "backend": "shop", "task": "-", "num_workers": len(jobs)}
    entry |= {"placement": "loop", "step_timeout": 60}
    if args.openenv is not None:
        entry |= {"backend": "openenv", "task": args.openenv}
        entry |= {"env_kwargs": {"truncated_field": "truncated"}}
        model = partial(over_openenv, model)
    async with client, rl.build_env_group(entry) as group:
        rollouts: dict[str, dict[str, Any]] = {}
        for env_id, (task, seed) in zip(group.env_ids, jobs, strict=True):
            tokens: dict[str, Any] = {name: [] for name in TOKENS}
            rollouts[env_id] = {"task": task, "seed": seed, **BLANK, **SCORE, **tokens}
            group.reset_async({env_id: seed}, {"task": task}, [env_id])
        await play(group, model, rollouts)
    lines = list(rollouts.values())
    for first in range(0, len(lines), GROUP_SIZE):
        compare(lines[first : first + GROUP_SIZE])
    with args.out.open("w") as file:
        file.writelines(json.dumps(line | {"tools": TOOLS}) + "\n" for line in lines)
    failed = [line["error"] for line in lines if line["error"]]
    right = sum(line["reward"] or 0.0 for line in lines)
    print(f"{len(lines)} episodes, {right:.0f} right, {len(failed)} failed", *failed[:1], sep=": ")


if __name__ == "__main__":
    rl.run(main())
