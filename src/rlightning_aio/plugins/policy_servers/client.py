"""`PolicyClient`: asks a policy server for the action of each env of a batch.

Rule: an env has one connection, with at most one request in flight (`OneFrame`). What a protocol
says is left to its subclass.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypeVar, cast

import numpy as np
from websockets.exceptions import ConnectionClosed

from rlightning_aio.errors import PolicyServerError
from rlightning_aio.loop_thread import LoopThread
from rlightning_aio.plugins.policy_servers.connection import MAX_BYTES, connected
from rlightning_aio.policies.answers import can_await
from rlightning_aio.policies.episodes import begins_of_envs
from rlightning_aio.trees import index

if TYPE_CHECKING:
    from collections.abc import Callable, Generator
    from concurrent.futures import Future

    from numpy.typing import NDArray

    from rlightning_aio import BatchedData
    from rlightning_aio.plugins.one_frame import OneFrame
    from rlightning_aio.plugins.policy_servers.arrays import Codec
    from rlightning_aio.plugins.policy_servers.connection import Address

__all__ = ["PolicyClient", "instruction", "observed"]

R = TypeVar("R")

_ATTEMPTS: Final = 3
"""A request that loses its connection this often has failed."""
_TOO_BIG: Final = 1009
_END: Final = 2000
"""Characters of a server's error, from its end, in a message."""


class PolicyClient(abc.ABC, Generic[R]):
    """A policy that asks a server; see the module.

    Args:
        address: of the server.
        codec: for its frames.
        observe: called with the observation of an env and the info of the reset that began its
            episode; returns what is sent.
    """

    def __init__(
        self, address: Address, codec: Codec, observe: Callable[[Any, dict[str, Any]], Any]
    ) -> None:
        self._address, self._codec, self._observe = address, codec, observe
        self._thread = LoopThread(f"policy server {address.url}")
        self._infos: dict[str, dict[str, Any]] = {}
        """Infos of the resets of envs."""
        self._connections: dict[str, OneFrame] = {}
        self._is_asking = False

    # -- what a protocol says ---------------------------------------------------------

    @abc.abstractmethod
    async def _greet(self, connection: OneFrame) -> None:
        """Exchange the first frames of a connection."""

    @abc.abstractmethod
    def _request(self, observation: Any, begun: dict[str, Any] | None) -> R:
        """Return a request; `begun` is the info of the reset if an episode begins."""

    @abc.abstractmethod
    async def _exchange(self, connection: OneFrame, request: R) -> Any:
        """Send a request, and return the map that answers it."""

    @abc.abstractmethod
    def _may_repeat(self, request: R) -> bool:
        """Return True if a request may be sent again over another connection."""

    # -- the policy -------------------------------------------------------------------

    def __call__(self, batch: BatchedData) -> Any:
        """Return an answer for each env, stacked.

        Where an event loop is running, the answer is awaitable, unless `batch` is of a synchronous
        group: its caller can't await, as in a notebook. The server is asked once it is awaited.

        Raises:
            PolicyServerError: the server is missing, silent or wrong; the message says which.
            RuntimeError: another call is waiting.
        """
        if can_await(batch):
            return self._awaited(batch)
        with self._asking(batch) as future:
            return future.result()

    async def _awaited(self, batch: BatchedData) -> NDArray[Any]:
        with self._asking(batch) as future:
            return await asyncio.wrap_future(future)

    @contextlib.contextmanager
    def _asking(self, batch: BatchedData) -> Generator[Future[NDArray[Any]]]:
        """Ask for the answers, until the block is left."""
        if self._is_asking:
            raise RuntimeError(
                "this client is waiting for answers; each evaluation needs a client of its own"
            )
        future = self._thread.submit(self._answers(self._requests(batch)))
        self._is_asking = True
        try:
            yield future
        finally:
            future.cancel()
            self._is_asking = False

    def _requests(self, batch: BatchedData) -> dict[str, R]:
        begun = begins_of_envs(batch)
        env_ids, rows = batch.env_ids(), np.flatnonzero(begun).tolist()
        for row, info in zip(rows, batch.take(rows).info() if rows else (), strict=True):
            self._infos[env_ids[row]] = info
        requests: dict[str, R] = {}
        for row, env_id in enumerate(env_ids):
            info = self._infos.get(env_id, {})
            sent = self._observe(index(batch.observation, row), info)
            requests[env_id] = self._request(sent, info if begun[row] else None)
        return requests

    async def _answers(self, requests: dict[str, R]) -> NDArray[Any]:
        try:
            async with asyncio.TaskGroup() as tasks:
                found = [
                    tasks.create_task(self._answer(env_id, request))
                    for env_id, request in requests.items()
                ]
        except BaseExceptionGroup as errors:
            raise errors.exceptions[0] from None
        actions = [task.result() for task in found]
        shapes = {array.shape for array in actions}
        if len(shapes) > 1:
            raise self._error(f"has answered one batch with actions of {shapes}")
        return np.stack(actions)

    async def _answer(self, env_id: str, request: R) -> NDArray[Any]:
        attempts = 0
        while True:
            attempts += 1
            try:
                return self._actions_in(await self._asked(env_id, request))
            except ConnectionClosed as lost:
                is_too_big = _TOO_BIG in {end.code for end in (lost.rcvd, lost.sent) if end}
                if is_too_big or attempts == _ATTEMPTS or not self._may_repeat(request):
                    raise self._error(
                        f"has closed the connection of {env_id} in place of an answer: {lost}"
                        + self._hint(lost, request)
                    ) from lost

    def _hint(self, lost: ConnectionClosed, request: R) -> str:
        if lost.sent is not None and lost.sent.code == _TOO_BIG:
            return f"; its frames may have {MAX_BYTES:,} bytes"
        if not self._may_repeat(request):
            return "; what it knew of the episode is lost"
        return ""

    async def _asked(self, env_id: str, request: R) -> Any:
        connection = self._connections.pop(env_id, None)
        try:
            if connection is None:
                connection = await connected(self._address)
                async with asyncio.timeout(self._address.timeout):
                    await self._greet(connection)
            async with asyncio.timeout(self._address.timeout):
                answer = await self._exchange(connection, request)
        except TimeoutError:
            raise self._error(
                f"has not answered {env_id} in {self._address.timeout:g} s; see its output, or "
                "allow more with timeout="
            ) from None
        except BaseException:
            if connection is not None:  # What it has answered can't be understood.
                connection.abort()
            raise
        self._connections[env_id] = connection
        return answer

    def _actions_in(self, answer: Any) -> NDArray[Any]:
        """Return the actions of an answer."""
        if not isinstance(answer, dict) or "actions" not in answer:
            raise self._error(f"has answered {_named(answer)}, not a map with 'actions'")
        try:
            array = np.asarray(cast("dict[str, Any]", answer)["actions"])
        except ValueError:
            array = np.asarray(None)
        if array.dtype.kind not in "biuf" or not array.size:
            raise self._error(f"has answered actions of {array.dtype} {array.shape}, no numbers")
        return array

    def _decoded(self, frame: bytes) -> Any:
        try:
            return self._codec.decode(frame)
        except ValueError as error:
            raise self._error(f"has sent a frame that can't be read: {error}") from error

    def _error(self, what: str) -> PolicyServerError:
        return PolicyServerError(f"the policy server {self._address.url} {what}")

    def _raised(self, text: str) -> PolicyServerError:
        """Return the error that a server reports."""
        end = text if len(text) <= _END else f"… {text[-_END:]}"
        return self._error(f"reports an error:\n{end.strip()}")

    # -- the end ----------------------------------------------------------------------

    def close(self) -> None:
        """Close the connections; a later call opens others."""
        connections = [*self._connections.values()]
        self._connections.clear()
        if connections:
            self._thread.submit(_close(connections)).result()
        self._thread.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


async def _close(connections: list[OneFrame]) -> None:
    with contextlib.suppress(ConnectionClosed):
        await asyncio.gather(*(connection.close() for connection in connections))


def _named(value: Any) -> str:
    if isinstance(value, dict):
        return f"a map with {sorted(map(str, cast('dict[Any, Any]', value)))[:10]}"
    return f"a {type(value).__name__}"


def instruction(info: dict[str, Any]) -> str | None:
    """Return the instruction of an episode: ``task_description``, else ``task``, of its info."""
    found = info.get("task_description", info.get("task"))
    return None if found is None else str(found)


def observed(
    observation: Any, info: dict[str, Any], *, state: str, instructed: str
) -> dict[str, Any]:
    """Return what is sent where the user doesn't say it.

    Args:
        observation: a dict as it is; any other becomes the value of `state`.
        info: of the reset that began the episode.
        state: the key of an observation that is no dict.
        instructed: the key of the episode's instruction, if it has one.
    """
    sent: dict[str, Any] = (
        {**cast("dict[str, Any]", observation)}
        if isinstance(observation, dict)
        else {state: observation}
    )
    text = instruction(info)
    return sent if text is None else {**sent, instructed: text}
