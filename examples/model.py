"""The model of agent.py: a server of OpenAI's chat completions; not an example itself.

A server that is away, or that has too much to do, loses no episode: what it refuses (429), fails
at (5xx) or breaks off is asked again, with growing pauses, as long as the patience lasts.
"""

from __future__ import annotations

import asyncio
import logging
import random
import time
from email.utils import parsedate_to_datetime
from typing import Any

from openai import APIConnectionError, APIStatusError, AsyncOpenAI
from openai.lib.streaming.chat import ChatCompletionStreamState
from shop import TOOLS

__all__ = ["Model", "pause_before_next"]

PAUSES = (0.5, 8.0)
"""Seconds before a request is sent again: at first, and at most."""
QUIET = 5.0
"""Seconds that a server may be away before that is said."""
MESSAGE = {"role": True, "content": True, "tool_calls": {"__all__": {"id", "type", "function"}}}
log = logging.getLogger("model")


class Model:
    """Asks the server for the next message of a conversation.

    Args:
        client: of the server, with `max_retries=0`.
        patience: seconds after the first failure of a request in which it is sent again.
        streamed: have the replies streamed.
        request: fields of every request.
    """

    def __init__(
        self, client: AsyncOpenAI, patience: float, streamed: bool, **request: Any
    ) -> None:
        if streamed:
            request.update(stream=True, stream_options={"include_usage": True})
        self._client, self._patience, self._request = client, patience, request
        self._away_since = 0.0  # The first of the failures after which no answer came.
        self._is_said = False

    async def __call__(self, messages: list[Any]) -> dict[str, Any]:
        """The columns of one row: the model's message, and what the server says of its tokens."""
        (pause, longest), give_up_at = PAUSES, 0.0
        while True:
            try:
                reply = await self._ask(messages)
            except (APIConnectionError, APIStatusError, ConnectionError) as error:
                seconds = pause_before_next(error, pause)
                give_up_at = give_up_at or time.monotonic() + self._patience
                if seconds is None or time.monotonic() + seconds > give_up_at:
                    raise
                self._note_failure(error)
                await asyncio.sleep(seconds)
                pause = min(2 * pause, longest)
            else:
                self._note_answer()
                return reply

    async def _ask(self, messages: list[Any]) -> dict[str, Any]:
        answer: Any = await self._client.chat.completions.create(
            messages=messages, tools=TOOLS, **self._request
        )
        token_ids: list[int] = []
        if "stream" in self._request:
            state = ChatCompletionStreamState()
            # A stream that is left before its end is closed late, and with complaints.
            for chunk in [chunk async for chunk in answer]:
                state.handle_chunk(chunk)
                for choice in chunk.choices:
                    token_ids += getattr(choice, "token_ids", None) or []
            answer = state.get_final_completion()
        choice = answer.choices[0]
        if choice.finish_reason is None:
            raise ConnectionError("the stream ended before the reply")
        return {
            "action": choice.message.model_dump(include=MESSAGE, exclude_none=True),
            "prompt_tokens": getattr(answer.usage, "prompt_tokens", None),
            "completion_tokens": getattr(answer.usage, "completion_tokens", None),
            "token_ids": token_ids or getattr(choice, "token_ids", None),
            "logprobs": choice.logprobs and [one.logprob for one in choice.logprobs.content or ()],
        }

    def _note_failure(self, error: Exception) -> None:
        self._away_since = self._away_since or time.time()
        if time.time() >= self._away_since + QUIET and not self._is_said:
            self._is_said = True
            since = time.strftime("%H:%M:%S", time.localtime(self._away_since))
            text = "%s has not answered since %s (%s); every request is sent again for up to %g s"
            log.warning(text, self._client.base_url, since, error, self._patience)

    def _note_answer(self) -> None:
        if self._is_said:
            seconds = time.time() - self._away_since
            log.warning("%s answers again, after %.0f s", self._client.base_url, seconds)
        self._away_since, self._is_said = 0.0, False


def pause_before_next(error: Exception, pause: float) -> float | None:
    """Seconds to wait before a request is sent again, no fewer than the server asks for.

    None if it would fail again: the server has refused it for what it says.
    """
    pause *= random.uniform(0.5, 1)  # Not all of those that failed together come together.
    if not isinstance(error, APIStatusError):
        return pause
    if error.status_code not in (408, 409, 429) and error.status_code < 500:
        return None
    asked = error.response.headers.get("retry-after", "0")
    try:
        return max(pause, float(asked))
    except ValueError:
        pass
    try:
        return max(pause, parsedate_to_datetime(asked).timestamp() - time.time())
    except ValueError:
        return pause
