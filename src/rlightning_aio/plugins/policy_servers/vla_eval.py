"""`VlaEvalPolicy`: the client of the model servers of vla-evaluation-harness.

A frame is a map of ``type``, ``payload``, ``seq`` and ``timestamp``. Both sides say ``hello``;
``episode_start`` and ``episode_end`` are not answered; an ``observation`` is answered by an
``action`` or an ``error`` with its ``seq``.
"""

from __future__ import annotations

import itertools
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast
from weakref import WeakSet

import numpy as np

from rlightning_aio.plugins.one_frame import OneFrame
from rlightning_aio.plugins.policy_servers.arrays import Codec
from rlightning_aio.plugins.policy_servers.client import PolicyClient, instruction, observed
from rlightning_aio.plugins.policy_servers.connection import Address

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["VlaEvalPolicy"]

_OBSERVED: Final = partial(observed, state="state", instructed="task_description")
_PROTOCOL: Final = 1


class _Asked(NamedTuple):
    """An observation, and the frame that begins its episode, if it begins one."""

    start: bytes | None
    observation: bytes
    seq: int


class VlaEvalPolicy(PolicyClient[_Asked]):
    """Asks a model server of vla-evaluation-harness (``vla-eval serve``) for actions.

    Each env is a session of the server, which batches them up to its ``max_batch_size``. A server
    that returns chunks, because it has no ``chunk_size`` with which to play them itself, needs
    `ActionChunks`. Close it, or use it in a ``with`` statement.

    Args:
        url: ``ws://host:port`` or ``wss://…``.
        observe: called with the observation of an env and the info of the reset that began its
            episode; returns the map that the model expects, such as ``{"images": {"agentview":
            …}, "state": …, "task_description": …}``. None sends a Dict observation as it is, any
            other as ``state``, and the ``task_description`` or ``task`` of the info.
        timeout: seconds for an answer; the first may take a server minutes.
        connect_timeout: seconds for a server that is not there yet.

    Raises:
        ConfigError: `url` or a time is wrong.
    """

    def __init__(
        self,
        url: str,
        observe: Callable[[Any, dict[str, Any]], dict[str, Any]] | None = None,
        *,
        timeout: float = 300.0,
        connect_timeout: float = 30.0,
    ) -> None:
        address = Address(url, timeout, connect_timeout, {})
        super().__init__(address, Codec(str), observe or _OBSERVED)
        self._seqs = itertools.count()
        self._in_episode = WeakSet[OneFrame]()

    async def _greet(self, connection: OneFrame) -> None:
        hello = {"harness_version": "rlightning_aio", "protocol_version": _PROTOCOL}
        seq = next(self._seqs)
        frame = await connection.ask(self._message("hello", hello, seq))
        payload = self._read(frame, "hello", seq)
        version = payload.get("protocol_version")
        if version != _PROTOCOL:
            raise self._error(f"speaks version {version} of vla-eval's protocol, not {_PROTOCOL}")

    def _request(self, observation: Any, begun: dict[str, Any] | None) -> _Asked:
        start = None
        if begun is not None:
            start = self._message("episode_start", {"task": _task(begun)}, next(self._seqs))
        seq = next(self._seqs)
        return _Asked(start, self._message("observation", observation, seq), seq)

    def _message(self, kind: str, payload: Any, seq: int) -> bytes:
        return self._codec.encode(
            {"type": kind, "payload": payload, "seq": seq, "timestamp": time.time()}
        )

    def _may_repeat(self, request: _Asked) -> bool:
        """A server knows what happened in an episode, so only its beginning can be repeated."""
        return request.start is not None

    async def _exchange(self, connection: OneFrame, request: _Asked) -> Any:
        before: list[bytes] = []
        if request.start is not None:
            if connection in self._in_episode:
                before.append(self._message("episode_end", {}, next(self._seqs)))
            before.append(request.start)
            self._in_episode.add(connection)
        frame = await connection.ask(*before, request.observation)
        return self._read(frame, "action", request.seq)

    def _read(self, frame: str | bytes, kind: str, seq: int) -> dict[str, Any]:
        """Return the payload of the frame that answers the one with `seq`."""
        message = self._decoded(frame if isinstance(frame, bytes) else frame.encode())
        fields = cast("dict[str, Any]", message) if isinstance(message, dict) else {}
        found, payload = fields.get("type"), fields.get("payload")
        if not isinstance(payload, dict):
            raise self._error("has sent a frame that is none of vla-eval's protocol")
        payload = cast("dict[str, Any]", payload)
        if found == "error":
            raise self._raised(str(payload.get("error", payload)))
        if (found, fields.get("seq")) != (kind, seq):
            raise self._error(
                f"has sent {found} {fields.get('seq')} in place of the answer, {kind} {seq}"
            )
        return payload


def _task(info: dict[str, Any]) -> dict[str, Any]:
    """Return what a model may want to know of an episode: the plain values of its info."""
    plain: dict[str, Any] = {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in info.items()
        if isinstance(value, str | int | float | bool | np.generic)
    }
    name = instruction(info)
    return plain if name is None else {"name": str(info.get("task", name)), **plain}
