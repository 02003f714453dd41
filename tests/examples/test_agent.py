"""examples/agent.py against a server that speaks OpenAI's chat completions; an env over HTTP."""

from __future__ import annotations

import asyncio
import importlib
import json
import os
import re
import sys
from collections import Counter
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from examples.chat_server import KEY, ChatServer
from run_python import output_of

import rlightning_aio as rl
from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from types import ModuleType

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
OWN_ENV = ROOT / "docs" / "own_env.md"
ERRORS = {
    "InternalServerError": "always 500",
    "AttributeError": "no JSON",
    "AssertionError": "no JSON",
    "TypeError": "no choices",
    "APIConnectionError": "cut off",
    "ConnectionError": "no end",
    "env ": "no id",
}
"""What the server did, by the beginning of what the program reports."""


async def run_agent(url: str, *options: str | Path) -> str:
    """What the program prints."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-W", "error", EXAMPLES / "agent.py"),
        *("--base-url", url, "--model", "scripted", *options),
        env={**os.environ, "OPENAI_API_KEY": KEY, "PYTHONASYNCIODEBUG": ""},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    printed, complaints = await process.communicate()
    assert process.returncode == 0, complaints.decode()
    assert not complaints
    return printed.decode()


def check_messages(line: dict[str, Any]) -> None:
    """It is a conversation in OpenAI's form, in which every call has its answer."""
    assert line["prompt"] + line["completion"] == line["messages"]
    assert [message["role"] for message in line["prompt"]] == ["system", "user"]
    unanswered: list[str] = []
    for message in line["completion"]:
        if message["role"] == "tool":
            assert message["tool_call_id"] == unanswered.pop(0)
            assert isinstance(message["content"], str)
            continue
        assert message["role"] == "assistant"
        assert not unanswered
        for call in message.get("tool_calls", ()):
            assert call["type"] == "function"
            assert call["function"].keys() == {"name", "arguments"}
            unanswered.append(call["id"])
    assert not unanswered


def check_tokens(line: dict[str, Any]) -> None:
    """Every reply has its counts, ids and logprobs."""
    replies = sum(message["role"] == "assistant" for message in line["messages"])
    assert len(line["prompt_tokens"]) == replies
    counts = line["completion_tokens"]
    assert line["token_ids"] == [list(range(100, 100 + count)) for count in counts]
    assert line["logprobs"] == [[-k / 8 for k in range(count)] for count in counts]


def failure(line: dict[str, Any]) -> str | None:
    """What the server did at the end of an episode that failed."""
    found = [fate for begin, fate in ERRORS.items() if (line["error"] or "").startswith(begin)]
    assert bool(found) == (line["error"] is not None), line["error"]
    return found[0] if found else None


@pytest.mark.parametrize("stream", [False, True], ids=["whole", "streamed"])
def test_64_concurrent_episodes_become_groups_of_rollouts(stream: bool, tmp_path: Path) -> None:
    """Of eight each; whatever the server does ends one episode at most."""
    out = tmp_path / "rollouts.jsonl"
    options = ["--body", '{"logprobs": true, "return_token_ids": true}', "--out", out]

    async def played() -> ChatServer:
        async with ChatServer(gate=64) as server:
            printed = await run_agent(server.url, *options, *["--stream"] * stream)
            # The client repeats a request for which nothing was sent yet; a stream has begun.
            counts = "24 right, 24 failed: " if stream else "28 right, 20 failed: "
            assert printed.startswith(f"64 episodes, {counts}")
        return server

    # In asyncio's debug mode the server would take most of the time.
    server = asyncio.run(played(), debug=False)
    assert server.most == 64
    assert {bool(body["stream"]) for body in server.requests} == {stream}
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    groups = [list(g) for _, g in groupby(lines, lambda line: (line["task"], line["seed"]))]
    assert [len(group) for group in groups] == [8] * 8
    assert len({json.dumps(group[0]["prompt"]) for group in groups}) == 8
    for line in lines:
        check_messages(line)
        check_tokens(line)
        assert [tool["function"]["name"] for tool in line["tools"]] == ["price", "calculate"]
    for group in groups[:4]:
        found = Counter((line["reward"], line["is_truncated"]) for line in group)
        assert found == {(1.0, False): 4, (0.0, False): 3, (0.0, True): 1}
        for line in group:
            assert line["advantage"] == pytest.approx(2 * line["reward"] - 1, abs=1e-3)
    cut_off = "cut off" if stream else None
    fates = {"always 500", "no JSON", "no choices", "no end", "no id", cut_off, None}
    for group in groups[4:]:
        assert {failure(line) for line in group} == fates
        for line in group:
            assert line["reward"] == float(line["error"] is None)
            assert line["advantage"] == (0.0 if line["error"] is None else None)


@pytest.fixture
def agent(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module("agent")


class Hanging:
    """Never answers "hang"; ends with any other action."""

    observation_space = action_space = Anything()

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return [{"role": "user", "content": "Go on."}], {}

    async def step(self, message: Any) -> Any:
        if message == "hang":
            await asyncio.Event().wait()
        return ["over"], 1.0, True, False, {}


async def test_an_environment_that_hangs_ends_one_episode(agent: ModuleType) -> None:
    """Its rollout says so; that the model fails for another one is said there."""
    actions = iter(["hang", "end", None])

    async def policy(messages: Any) -> dict[str, Any]:
        action = next(actions)
        if action is None:
            raise RuntimeError("no model")
        return {"action": action, **dict.fromkeys(agent.TOKENS)}

    config = rl.EnvConfig(
        name="h", make_env=Hanging, num_workers=3, placement="loop", step_timeout=0.05
    )
    async with rl.build_env_group(config) as group:
        rollouts = {
            env_id: {**agent.BLANK, **agent.SCORE, **{name: [] for name in agent.TOKENS}}
            for env_id in group.env_ids
        }
        group.reset_async()
        await agent.play(group, policy, rollouts)
    ends = sorted((rollout["reward"], str(rollout["error"])) for rollout in rollouts.values())
    assert ends == [
        (0.0, "RuntimeError('no model')"),
        (0.0, "hung in a step and was cancelled"),
        (1.0, "None"),
    ]


def test_the_program_with_aiohttp_of_the_page_on_own_envs(tmp_path: Path) -> None:
    """It finds the best controller of tanks behind a real HTTP server."""
    blocks = re.findall(r"^```python\n(.*?)^```", OWN_ENV.read_text(), re.MULTILINE | re.DOTALL)
    (block,) = [block for block in blocks if "import aiohttp\n" in block]
    program = tmp_path / "program.py"
    program.write_text(block)
    printed = output_of("-W", "error", program, asyncio_debug=False)
    assert printed == "gain 2.0: -1.05 in 64 episodes\n"
