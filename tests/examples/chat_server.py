"""A server of OpenAI's chat completions, with a scripted model that plays examples/shop.py.

The n-th conversation about a question follows the n-th script: what the model does in it, or how
the server fails at its second request, after which the model is right. Chat completions have no
sessions, so ids of tool calls say which conversation it is.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections import defaultdict
from typing import Any, Self

from aiohttp import web
from aiohttp.test_utils import TestServer

KEY = "sk-tests"
PLAYS = ("right", "right", "right", "mistaken", "wrong", "wrong", "wrong", "endless")
"""What the model does in conversations about totals."""
FAULTS = ("429", "500", "always 500", "no JSON", "no choices", "cut off", "no end", "no id")
"""How the server fails in those about differences; at the last one the environment raises."""


class ChatServer:
    """An asynchronous context manager.

    Args:
        gate: no request is answered before this many are open at once.
        outage: what becomes of the first requests: a status, or "cut off".
        lasts: of so many.

    Attributes:
        requests: all bodies, in order.
        most: how many requests were open at once, at most.
        may_answer: set when that many were; whoever sets it opens the gate.
    """

    def __init__(self, gate: int, outage: str = "", lasts: int = 0) -> None:
        self.requests: list[dict[str, Any]] = []
        self.most = 0
        self.may_answer = asyncio.Event()
        self._open = 0
        self._gate, self._outage, self._lasts = gate, outage, lasts
        self._begun: dict[str, int] = defaultdict(int)
        self._failed: set[tuple[str, int]] = set()
        app = web.Application()
        app.router.add_post("/v1/chat/completions", self._complete)
        self._server = TestServer(app)

    async def __aenter__(self) -> Self:
        await self._server.start_server()
        self.url = str(self._server.make_url("/v1"))
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._server.close()

    async def _complete(self, request: web.Request) -> web.StreamResponse:
        body = await request.json()
        self.requests.append(body)
        if len(self.requests) <= self._lasts:
            return await failure(self._outage, request, body)
        self._open += 1
        self.most = max(self.most, self._open)
        if self._open >= self._gate:
            self.may_answer.set()
        try:
            await self.may_answer.wait()
            if request.headers.get("Authorization") != f"Bearer {KEY}":
                return error_reply(401)
            return await self._answer(request, body)
        finally:
            self._open -= 1

    async def _answer(self, request: web.Request, body: dict[str, Any]) -> web.StreamResponse:
        question = body["messages"][1]["content"]
        conversation, turn = self._place(question, body["messages"][-1])
        script = (PLAYS if "together" in question else FAULTS)[conversation]
        if turn == 1 and script in FAULTS[:-1]:
            has_failed = (question, conversation) in self._failed
            self._failed.add((question, conversation))
            if script == "always 500" or not has_failed:
                return await failure(script, request, body)
        calls, content = move(script, turn, body["messages"])
        tool_calls = [
            {
                "id": f"call-{conversation}-{turn}-{k}",
                "type": "function",
                "function": {"name": name, "arguments": arguments},
            }
            for k, (name, arguments) in enumerate(calls)
        ]
        if script == "no id":
            del tool_calls[0]["id"]
        reply = Reply(body, content, tool_calls)
        return await reply.stream(request) if body.get("stream") else reply.whole()

    def _place(self, question: str, last: dict[str, Any]) -> tuple[int, int]:
        """The number of the conversation, and how often the model has spoken in it."""
        if last["role"] == "tool":
            _, conversation, turn, _ = last["tool_call_id"].split("-")
            return int(conversation), int(turn) + 1
        self._begun[question] += 1
        return self._begun[question] - 1, 0


def move(
    script: str, turn: int, messages: list[dict[str, Any]]
) -> tuple[list[tuple[str, str]], str]:
    """The model's next tool calls, or its answer."""
    if script == "wrong":
        return [], "I guess 7 or -1."
    if script == "endless":
        return [("price", '{"fruit": "apple"}')], "Once more."
    if script == "mistaken":
        if turn == 0:
            plum = ("price", '{"fruit": "plum"}')
            return [plum, ("price", '{"fruit'), ("weigh", "[]"), ("calculate", "{}")], ""
        turn -= 1
    question = messages[1]["content"]
    apples, pears = re.findall(r"\d+", question)
    seen = [message["content"] for message in messages if message["role"] == "tool"]
    if turn == 0:
        return [("price", '{"fruit": "apple"}'), ("price", '{"fruit": "pear"}')], ""
    if turn == 1:
        return [calculation(apples, "*", seen[-2]), calculation(pears, "*", seen[-1])], ""
    if turn == 2:
        return [calculation(seen[-2], "+" if "together" in question else "-", seen[-1])], ""
    return [], f"With 2 fruits, the answer is {seen[-1]}."


def calculation(a: str, operation: str, b: str) -> tuple[str, str]:
    return "calculate", json.dumps({"a": int(a), "operation": operation, "b": int(b)})


class Reply:
    """What the model says, at once or in pieces; each piece is a token."""

    def __init__(self, body: dict[str, Any], content: str, tool_calls: list[Any]) -> None:
        self._body, self._content, self._calls = body, content, tool_calls
        self._pieces: list[dict[str, Any]] = [{"content": part} for part in parts(content)]
        for index, call in enumerate(tool_calls):
            function = {"name": call["function"]["name"], "arguments": ""}
            self._pieces.append({"tool_calls": [{"index": index, **call, "function": function}]})
            for part in parts(call["function"]["arguments"]):
                piece = {"index": index, "function": {"arguments": part}}
                self._pieces.append({"tool_calls": [piece]})
        self._end = "tool_calls" if tool_calls else "stop"
        count = len(self._pieces)
        prompt = len(body["messages"])
        self._usage = {
            "prompt_tokens": prompt,
            "completion_tokens": count,
            "total_tokens": prompt + count,
        }

    def _tokens(self, first: int, end: int) -> dict[str, Any]:
        """What a choice says of its tokens: logprobs as OpenAI has them, ids as vLLM has them."""
        said: dict[str, Any] = {}
        if self._body.get("logprobs"):
            said["logprobs"] = {
                "content": [
                    {"token": f"t{k}", "logprob": -k / 8, "bytes": None, "top_logprobs": []}
                    for k in range(first, end)
                ]
            }
        if self._body.get("return_token_ids"):
            said["token_ids"] = list(range(100 + first, 100 + end))
        return said

    def _envelope(self, kind: str) -> dict[str, Any]:
        return {"id": "chatcmpl-1", "object": kind, "created": 1, "model": self._body["model"]}

    def whole(self) -> web.Response:
        message: dict[str, Any] = {"role": "assistant", "content": self._content or None}
        if self._calls:
            message["tool_calls"] = self._calls
        choice = {"index": 0, "message": message, "finish_reason": self._end}
        choice |= self._tokens(0, len(self._pieces))
        envelope = self._envelope("chat.completion")
        return web.json_response({**envelope, "choices": [choice], "usage": self._usage})

    async def stream(self, request: web.Request) -> web.StreamResponse:
        response = await begin_stream(request)
        envelope = self._envelope("chat.completion.chunk")
        role: dict[str, Any] = {"role": "assistant", "content": None}
        choices = [{"delta": role}]
        for k, piece in enumerate(self._pieces):
            choices.append({"delta": piece, **self._tokens(k, k + 1)})
        choices.append({"delta": {}, "finish_reason": self._end})
        for choice in choices:
            whole = {"index": 0, "finish_reason": None, **choice}
            await send(response, {**envelope, "choices": [whole]})
        if self._body.get("stream_options", {}).get("include_usage"):
            await send(response, {**envelope, "choices": [], "usage": self._usage})
        await response.write(b": a comment, as servers send them to keep a connection\n\n")
        await response.write(b"data: [DONE]\n\n")
        return response


def parts(text: str) -> list[str]:
    return [text[k : k + 6] for k in range(0, len(text), 6)]


async def begin_stream(request: web.Request) -> web.StreamResponse:
    response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
    await response.prepare(request)
    return response


async def send(response: web.StreamResponse, event: dict[str, Any]) -> None:
    await response.write(b"data: " + json.dumps(event).encode() + b"\n\n")


def error_reply(status: int) -> web.Response:
    """An error as OpenAI sends them."""
    error = {"message": f"It is a {status}.", "type": "error", "param": None, "code": None}
    return web.json_response({"error": error}, status=status, headers={"retry-after": "0.01"})


async def failure(script: str, request: web.Request, body: dict[str, Any]) -> web.StreamResponse:
    if script[-3:].isdecimal():
        return error_reply(int(script[-3:]))
    if script == "no JSON":
        return web.Response(text="<html>Bad gateway</html>", content_type="text/html")
    reply = {"id": "chatcmpl-1", "created": 1, "model": body["model"], "choices": None}
    if script != "no choices":
        part = {"role": "assistant", "content": "The ans"}
        reply["choices"] = [{"index": 0, "finish_reason": None, "message": part, "delta": part}]
    response: web.StreamResponse = web.json_response(reply)
    if body.get("stream"):
        response = await begin_stream(request)
        await send(response, reply)
    if script == "cut off":
        assert request.transport is not None
        request.transport.abort()
    return response
