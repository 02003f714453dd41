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

if TYPE_CHECKING:
    from types import ModuleType

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
ERRORS = {
    "InternalServerError": "always 500",
    "AttributeError": "no JSON",
    "AssertionError": "no JSON",
    "TypeError": "no choices",
    "KeyError": "no id",
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
    printed, written = await process.communicate()
    assert process.returncode == 0, written.decode()
    # Errors of the agent are logged once for each type, with their tracebacks.
    logged = written.decode().partition("the agent of env ")[0]
    complaints = [line for line in logged.splitlines() if not line.startswith("http")]
    assert not complaints, written.decode()
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
    options += ["--patience", "1", "--retries", "0"]

    async def played() -> ChatServer:
        async with ChatServer(gate=64) as server:
            printed = await run_agent(server.url, *options, *["--stream"] * stream)
            # Of eight, one is refused once, one fails once and two break off; all are asked again.
            assert printed.startswith("64 episodes, 32 right, 16 failed: ")
        return server

    # In asyncio's debug mode the server would take most of the time.
    server = asyncio.run(played(), debug=False)
    assert server.most == 64
    assert {bool(body.get("stream")) for body in server.requests} == {stream}
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    groups = [list(g) for _, g in groupby(lines, lambda line: (line["task"], line["seed"]))]
    groups.sort(key=lambda group: group[0]["task"], reverse=True)
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
    fates = {"always 500": 1, "no JSON": 1, "no choices": 1, "no id": 1, None: 4}
    for group in groups[4:]:
        assert Counter(failure(line) for line in group) == fates
        for line in group:
            assert line["reward"] == (1.0 if line["error"] is None else None)
            assert line["advantage"] == (0.0 if line["error"] is None else None)


@pytest.fixture
def agent(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module("agent")


@pytest.mark.parametrize("outage", ["429", "503", "cut off"])
def test_an_outage_of_the_model_loses_no_episode(
    outage: str,
    agent: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Every request fails eight times; a line says that the server is away, one that it is back."""
    monkeypatch.setattr("agent.SEEDS", 1)
    monkeypatch.setattr("model.PAUSES", (0.001, 0.01))
    monkeypatch.setattr("model.QUIET", 0.0)
    monkeypatch.setenv("OPENAI_API_KEY", KEY)

    async def played() -> None:
        async with ChatServer(16, outage, lasts=16 * 8) as server:
            options = [
                "--base-url",
                server.url,
                "--model",
                "scripted",
                "--out",
                str(tmp_path / "o"),
            ]
            monkeypatch.setattr(sys, "argv", ["agent.py", *options, "--patience", "1000"])
            # The server that fails always is not away, so its conversations are right, too.
            monkeypatch.setattr("examples.chat_server.FAULTS", ("429",) * 8)
            await agent.main()

    asyncio.run(played(), debug=False)
    assert capsys.readouterr().out == "16 episodes, 12 right, 0 failed\n"
    away, back = [record.getMessage() for record in caplog.records if record.name == "model"][:2]
    assert re.search(r"has not answered since \d\d:\d\d:\d\d \(.+\); .* for up to 1000 s", away)
    assert "answers again, after" in back


def test_the_environment_behind_http_is_evaluated() -> None:
    """Its simulator is a real HTTP server."""
    printed = output_of("-W", "error", EXAMPLES / "http_env.py", asyncio_debug=False)
    assert printed == "-1.05 in 64 episodes\n"
