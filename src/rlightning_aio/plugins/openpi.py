"""`OpenPiPolicy`: the client of openpi's policy server. Needs ``rlightning-aio[websockets]``.

A connection begins with a map of metadata from the server. Then each observation, a map, is
answered by a map with ``actions``, a chunk ``[horizon, *action]``. A text frame is a traceback.
Frames are msgpack, in which an array is a map of ``__ndarray__``, ``data``, ``dtype`` and
``shape``, keys as bytes; only arrays of numbers and bools exist, and nothing is unpickled.
Rule: one request is in flight, and whoever stops waiting for its answer closes the connection, so
that a late one can't answer another request.
"""

from __future__ import annotations

import contextlib
import logging
import re
import time
from typing import TYPE_CHECKING, Any, Final, Self, cast

import msgspec
import numpy as np

try:
    from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
    from websockets.sync.client import connect
    from websockets.uri import parse_uri
except ModuleNotFoundError as missing:
    raise ImportError(f"{missing}: pip install 'rlightning-aio[websockets]'") from missing

from rlightning_aio.errors import ConfigError, PolicyServerError
from rlightning_aio.policies.episodes import begins_of_envs
from rlightning_aio.trees import as_array, index

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from websockets.sync.client import ClientConnection

    from rlightning_aio import BatchedData

__all__ = ["OpenPiPolicy"]

_MAX_BYTES: Final = 64 * 1024 * 1024
"""A larger frame of a server is refused."""
_PAUSE_SECONDS: Final = 0.2
"""Between two attempts to connect."""
_CLOSE_SECONDS: Final = 1.0
_END: Final = 2000
"""Characters of a server's error, from its end, in a message."""
_NUMBERS: Final = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])")
"""The dtypes of arrays that may arrive."""
_LOG: Final = logging.getLogger("rlightning_aio.openpi")
# At a lower level, websockets logs headers, which may hold a key.
_LOG.setLevel(logging.INFO)


class OpenPiPolicy:
    """Asks openpi's policy server (``scripts/serve_policy.py``) for chunks of actions.

    Play them with `ActionChunks`. It asks for one env after the other over one connection, and
    blocks meanwhile, as a model in this process does. Close it, or use it in a ``with`` statement.

    Args:
        url: ``ws://host:port`` or ``wss://…``.
        observe: called with the observation of an env and the info of the reset that began its
            episode; returns the map that the server's policy expects, such as
            ``{"observation/image": …, "observation/state": …, "prompt": …}``. None sends a Dict
            observation as it is, any other as ``observation/state``, and the ``task_description``
            or ``task`` of the info as ``prompt``.
        api_key: sent as the header ``Authorization: Api-Key …``, and never logged.
        timeout: seconds for an answer; the first may take a server minutes.
        connect_timeout: seconds for a server that is not there yet.

    Raises:
        ConfigError: `url`, `api_key` or a time is wrong.
    """

    def __init__(
        self,
        url: str,
        observe: Callable[[Any, dict[str, Any]], dict[str, Any]] | None = None,
        *,
        api_key: str | None = None,
        timeout: float = 300.0,
        connect_timeout: float = 30.0,
    ) -> None:
        try:
            parse_uri(url)
        except (InvalidURI, ValueError):
            raise ConfigError(f"{url!r}: should look like ws://localhost:8000") from None
        if timeout <= 0 or connect_timeout < 0:
            raise ConfigError("timeout must be above 0, and connect_timeout at least 0")
        if api_key is not None and not (api_key.isascii() and api_key.isprintable()):
            raise ConfigError(f"{url}: api_key has characters that are none of a header")
        self._url, self._observe = url, observe or _observed
        self._headers = {} if api_key is None else {"Authorization": f"Api-Key {api_key}"}
        self._timeout, self._connect_timeout = timeout, connect_timeout
        self._connection: ClientConnection | None = None
        self._open = contextlib.ExitStack()
        self._infos: dict[str, dict[str, Any]] = {}
        """Infos of the resets of envs."""

    def __call__(self, batch: BatchedData) -> NDArray[Any]:
        """Return the chunks of actions of a batch, ``[n, horizon, *action]``.

        Raises:
            PolicyServerError: the server is missing, silent or wrong; the message says which. A
                later call connects again.
            TypeError: what `observe` returns can't be sent.
        """
        env_ids, rows = batch.env_ids(), np.flatnonzero(begins_of_envs(batch)).tolist()
        for row, info in zip(rows, batch.take(rows).info() if rows else (), strict=True):
            # An end that is no reset, too, may not say again what the reset has said.
            known = {} if batch.is_reset[row] else self._infos.get(env_ids[row], {})
            self._infos[env_ids[row]] = {**known, **info}
        frames = [
            _encoded(self._observe(index(batch.observation, row), self._infos.get(env_id, {})))
            for row, env_id in enumerate(env_ids)
        ]
        chunks = [self._actions_in(self._asked(frame)) for frame in frames]
        shapes = {chunk.shape for chunk in chunks}
        if len(shapes) > 1:
            raise self._error(f"has answered one batch with actions of {shapes}")
        return np.stack(chunks)

    def _asked(self, frame: bytes) -> Any:
        try:
            if self._connection is None:
                self._connection = self._connected()
                self._received(self._connection)  # The metadata only describe the policy.
            self._connection.send(frame)
            return self._received(self._connection)
        except TimeoutError:
            self.close()
            raise self._error(
                f"has not answered in {self._timeout:g} s; see its output, or allow more with "
                "timeout="
            ) from None
        except ConnectionClosed as lost:
            self.close()
            raise self._error(f"has closed the connection in place of an answer: {lost}") from lost
        except BaseException:
            self.close()
            raise

    def _received(self, connection: ClientConnection) -> Any:
        frame = connection.recv(self._timeout)
        if isinstance(frame, str):
            end = frame if len(frame) <= _END else f"… {frame[-_END:]}"
            raise self._error(f"reports an error:\n{end.strip()}")
        try:
            return _decoded(frame)
        except ValueError as error:
            raise self._error(f"has sent a frame that can't be read: {error}") from error

    def _connected(self) -> ClientConnection:
        """Connect, again and again while nothing listens there."""
        until = time.monotonic() + self._connect_timeout
        while True:
            try:
                connection = connect(
                    self._url,
                    # A server may compute for a while before it looks at its connections.
                    open_timeout=self._timeout,
                    close_timeout=_CLOSE_SECONDS,
                    max_size=_MAX_BYTES,
                    ping_interval=None,
                    # It costs more time, on both sides, than the bytes that it saves.
                    compression=None,
                    proxy=None,
                    additional_headers=self._headers,
                    logger=_LOG if self._headers else None,
                )
            except (OSError, InvalidHandshake, EOFError) as error:
                may_start = not isinstance(error, InvalidStatus) or (
                    error.response.status_code >= 500  # HTTP: the server's fault.
                )
                if isinstance(error, TimeoutError) or not may_start or time.monotonic() >= until:
                    raise self._error(
                        f"can't be reached: {error or 'it is silent'}; start it, or correct the "
                        "address"
                    ) from error
            else:
                return self._open.enter_context(connection)
            time.sleep(_PAUSE_SECONDS)

    def _actions_in(self, answer: Any) -> NDArray[Any]:
        if not isinstance(answer, dict):
            raise self._error(f"has answered a {type(answer).__name__}, not a map with 'actions'")
        fields = cast("dict[Any, Any]", answer)
        if "actions" not in fields:
            keys = sorted(map(str, fields))[:10]
            raise self._error(f"has answered a map with {keys}, not one with 'actions'")
        try:
            array = np.asarray(fields["actions"])
        except ValueError:
            array = np.asarray(None)
        if array.dtype.kind not in "biuf" or not array.size:
            raise self._error(f"has answered actions of {array.dtype} {array.shape}, no numbers")
        return array

    def _error(self, what: str) -> PolicyServerError:
        return PolicyServerError(f"the policy server {self._url} {what}")

    def close(self) -> None:
        """Close the connection; a later call opens another."""
        self._connection = None
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _observed(observation: Any, info: dict[str, Any]) -> dict[str, Any]:
    """Return what is sent where the user doesn't say it."""
    sent: dict[str, Any] = (
        {**cast("dict[str, Any]", observation)}
        if isinstance(observation, dict)
        else {"observation/state": observation}
    )
    text = info.get("task_description", info.get("task"))
    return sent if text is None else {**sent, "prompt": str(text)}


def _encoded(value: Any) -> bytes:
    """Return a frame.

    Raises:
        TypeError: `value` has something other than arrays, numbers, texts, lists and maps.
    """
    return msgspec.msgpack.encode(value, enc_hook=_written)


def _written(value: Any) -> Any:
    if isinstance(value, np.generic):
        return cast("Any", value).item()
    if not isinstance(value, np.ndarray) and not hasattr(value, "detach"):
        raise TypeError(f"a {type(value).__name__} can't be sent to a policy server")
    array = as_array(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"an array of {array.dtype} can't be sent to a policy server")
    data, dtype = array.tobytes(), array.dtype.str
    return {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": array.shape}


def _decoded(frame: bytes) -> Any:
    """Return what a frame holds, with arrays.

    Raises:
        ValueError: it can't be decoded, or an array in it is none of numbers.
    """
    try:
        return _read(msgspec.msgpack.decode(frame))
    except (msgspec.DecodeError, RecursionError, TypeError, KeyError) as error:
        raise ValueError(str(error)) from error


def _read(value: Any) -> Any:
    if isinstance(value, list):
        return [_read(inner) for inner in cast("list[Any]", value)]
    if not isinstance(value, dict):
        return value
    fields = cast("dict[Any, Any]", value)
    if b"__ndarray__" in fields:
        return np.frombuffer(fields[b"data"], _dtype_of(fields)).reshape(fields[b"shape"])
    if b"__npgeneric__" in fields:
        return _dtype_of(fields).type(fields[b"data"])
    return {key: _read(inner) for key, inner in fields.items()}


def _dtype_of(fields: dict[Any, Any]) -> np.dtype[Any]:
    name: Any = fields[b"dtype"]
    if not isinstance(name, str) or not _NUMBERS.fullmatch(name):
        raise ValueError(f"an array has dtype {name!r}, which is none of numbers")
    return np.dtype(name)
