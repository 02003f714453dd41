"""`OpenEnvServer`: a group's envs as sessions of an OpenEnv server, for OpenEnv's own clients.

Each connection to ``/ws`` gets an env of its own as long as one is free, and gives it back at its
end. Observations and infos travel as JSON: arrays as nested lists. Sessions that were created over
``POST /mcp`` keep their envs until they are closed there, or have had no connection for some time.
Left out: ``POST /reset`` and ``/step``, whose envs live for one call, and tools, which no env has.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import uuid
from collections import deque
from http import HTTPStatus
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar, cast

import numpy as np
from aiohttp import WSCloseCode, WSMsgType, web
from gymnasium import spaces

from rlightning_aio import Anything, Outcome
from rlightning_aio.errors import ConfigError, EnvFault, RLightningError
from rlightning_aio.json_text import json_of
from rlightning_aio.plugins.one_frame import keep_alive_by_system
from rlightning_aio.trees import as_array, is_dict, tree_of, zipped

if TYPE_CHECKING:
    from collections.abc import Coroutine

    import gymnasium as gym

    from rlightning_aio import EnvGroup, EnvHandle

__all__ = ["OpenEnvServer"]

T = TypeVar("T")

# Of JSON-RPC, as OpenEnv's servers use them.
_PARSE_ERROR: Final = -32700
_INVALID_REQUEST: Final = -32600
_METHOD_NOT_FOUND: Final = -32601
_INVALID_PARAMS: Final = -32602
_INTERNAL_ERROR: Final = -32603
_SERVER_ERROR: Final = -32000
_SECONDS_TO_LEAVE: Final = 1.0
"""For a client to answer the end of its connection."""


class _Session:
    """An env that a client has.

    Attributes:
        is_kept: it was created over ``/mcp``, and outlives its socket.
        is_attached: it has a socket.
        closing: it ends with its socket.
        ending: ends it, while it has no socket.
    """

    def __init__(self, key: str, env: EnvHandle, *, is_kept: bool) -> None:
        self.key = key
        self.env = env
        self.is_kept = is_kept
        self.is_attached = False
        self.closing = asyncio.Event()
        self.ending: asyncio.TimerHandle | None = None
        # Before that, the env is in an episode of an earlier session.
        self.has_reset = False
        self.state: dict[str, Any] = {"episode_id": None, "step_count": 0}


class OpenEnvServer:
    """Serves the envs of a group whose entries have the same spaces; see the module.

    Clients are told the name of the first entry.
    Use it as an asynchronous context manager, inside that of the group.

    Args:
        group: initialised.
        host: address to listen on.
        port: to listen on; 0 picks a free one.
        session_timeout: seconds after which a session without a connection ends, and its env is
            free again.

    Raises:
        ConfigError: on entry, if it can't listen there.
    """

    def __init__(
        self, group: EnvGroup, host: str, port: int, *, session_timeout: float = 300.0
    ) -> None:
        self._group = group
        self._host, self._port = host, port
        self._session_timeout = session_timeout
        self._free = deque(group.env_ids)
        self._sessions: dict[str, _Session] = {}
        self._space: Any = group.get_action_spaces()[0]
        self._sockets: set[web.WebSocketResponse] = set()
        self._runner: web.AppRunner

    async def __aenter__(self) -> Self:
        app = web.Application()
        app.add_routes(
            [
                web.get("/health", self._health),
                web.get("/metadata", self._metadata),
                web.get("/schema", self._schema),
                web.get("/ws", self._talk),
                web.post("/mcp", self._post),
                web.route("*", "/{path:.*}", _missing),
            ]
        )
        app.on_shutdown.append(self._leave)
        self._runner = web.AppRunner(app, access_log=None)
        await self._runner.setup()
        try:
            await web.TCPSite(self._runner, self._host, self._port).start()
        except OSError as error:
            await self._runner.cleanup()
            reason = error.strerror or error
            raise ConfigError(f"can't listen at {self._host}:{self._port}: {reason}") from error
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._runner.cleanup()
        for session in list(self._sessions.values()):
            self._end(session)

    async def _leave(self, app: web.Application) -> None:
        del app
        for session in self._sessions.values():
            session.closing.set()
        closing = [socket.close(code=WSCloseCode.GOING_AWAY) for socket in self._sockets]
        await asyncio.gather(*closing, return_exceptions=True)

    @property
    def url(self) -> str:
        """The address for clients."""
        return f"http://{self._host}:{self._runner.addresses[0][1]}"

    # -- HTTP ---------------------------------------------------------------------

    async def _health(self, request: web.Request) -> web.Response:
        del request
        return _json_response({"status": "healthy"})

    async def _metadata(self, request: web.Request) -> web.Response:
        del request
        text = f"{len(self._group)} sessions of an environment of rlightning-aio"
        name = self._group.env_ids[0].rpartition("-")[0]
        found = {"name": name, "description": text, "version": version("rlightning-aio")}
        return _json_response(found)

    async def _schema(self, request: web.Request) -> web.Response:
        del request
        (observation, *_) = self._group.get_observation_spaces()
        state = {"episode_id": {"type": ["string", "null"]}, "step_count": {"type": "integer"}}
        found = {
            "action": _fields_schema(self._space, "action"),
            "observation": _fields_schema(observation, "observation"),
            "state": {"type": "object", "properties": state},
        }
        return _json_response(found)

    async def _post(self, request: web.Request) -> web.Response:
        try:
            message: Any = json.loads(await request.read())
        except (ValueError, RecursionError):
            return _json_response(_rpc_error(None, _PARSE_ERROR, "Parse error"))
        return _json_response(self._rpc(message, None))

    # -- sessions -----------------------------------------------------------------

    def _rpc(self, request: Any, session: _Session | None) -> dict[str, Any]:
        """Answer a JSON-RPC request: of a session over its socket, or of anybody over HTTP."""
        method, number = (
            (cast("Any", request).get("method"), cast("Any", request).get("id"))
            if isinstance(request, dict)
            else (None, None)
        )
        if not isinstance(method, str):
            return _rpc_error(number, _INVALID_REQUEST, "Invalid request: it needs a method")
        params: Any = cast("Any", request).get("params") or {}
        if not isinstance(params, dict):
            return _rpc_error(number, _INVALID_PARAMS, "Params must be an object")
        if method == "openenv/session/create":
            created = session or self._create(is_kept=True)
            if created is not None:
                return _rpc_result(number, session_id=created.key)
            most = len(self._group)
            return _rpc_error(
                number, _SERVER_ERROR, self._full(), active_sessions=most, max_sessions=most
            )
        if method == "openenv/session/close":
            return self._close(number, cast("Any", params).get("session_id"), session)
        if method in ("tools/list", "tools/call"):
            return _rpc_error(number, _INTERNAL_ERROR, "Environment does not support MCP")
        return _rpc_error(number, _METHOD_NOT_FOUND, f"Method not found: {method}")

    def _close(self, number: Any, key: Any, own: _Session | None) -> dict[str, Any]:
        session = self._sessions.get(key) if isinstance(key, str) else None
        if session is None:
            return _rpc_error(number, _INVALID_PARAMS, f"Unknown session_id: {key}")
        if session is own:
            text = "Cannot close active WebSocket-managed session via MCP method"
            return _rpc_error(number, _INVALID_REQUEST, text)
        session.closing.set()
        if session.is_attached:
            return _rpc_result(number, session_id=key, closed=False, closing=True)
        self._end(session)
        return _rpc_result(number, session_id=key, closed=True)

    def _full(self) -> str:
        return f"all {len(self._group)} sessions are in use"

    def _create(self, *, is_kept: bool) -> _Session | None:
        """A session with an env; None if all are in use."""
        if not self._free:
            return None
        env = self._group[self._free.popleft()]
        session = _Session(str(uuid.uuid4()), env, is_kept=is_kept)
        self._sessions[session.key] = session
        self._detach(session)
        return session

    def _detach(self, session: _Session) -> None:
        session.is_attached = False
        loop = asyncio.get_running_loop()
        session.ending = loop.call_later(self._session_timeout, self._end, session)

    def _end(self, session: _Session) -> None:
        if session.ending is not None:
            session.ending.cancel()
        del self._sessions[session.key]
        self._free.append(session.env.env_id)

    async def _talk(self, request: web.Request) -> web.WebSocketResponse:
        """Serve one connection."""
        # Without a heartbeat: a client whose learner holds its event loop can't answer any.
        socket = web.WebSocketResponse(timeout=_SECONDS_TO_LEAVE, max_msg_size=0, compress=False)
        await socket.prepare(request)
        assert request.transport is not None
        keep_alive_by_system(request.transport)
        self._sockets.add(socket)
        try:
            await self._begin(socket, request.query.get("session_id"))
        except ConnectionResetError:  # The client has left.
            pass
        finally:
            self._sockets.discard(socket)
        return socket

    async def _begin(self, socket: web.WebSocketResponse, key: str | None) -> None:
        """Give a connection its session, or the reason why it has none."""
        session = self._create(is_kept=False) if key is None else self._sessions.get(key)
        if session is None and key is None:
            most = len(self._group)
            numbers = {"active_sessions": most, "max_sessions": most}
            await socket.send_str(_error("CAPACITY_REACHED", self._full(), **numbers))
        elif session is None:
            await socket.send_str(_error("SESSION_ERROR", f"Unknown session_id: {key}"))
        elif session.is_attached:
            text = f"Session {key} already has an attached WebSocket"
            await socket.send_str(_error("SESSION_ERROR", text))
        else:
            await self._attach(socket, session)

    async def _attach(self, socket: web.WebSocketResponse, session: _Session) -> None:
        session.is_attached = True
        assert session.ending is not None
        session.ending.cancel()
        try:
            await self._answer_all(socket, session)
        finally:
            self._detach(session)
            if session.closing.is_set() or not session.is_kept:
                self._end(session)

    async def _answer_all(self, socket: web.WebSocketResponse, session: _Session) -> None:
        """Answer each message of a client, until it leaves or the server ends."""
        frames: asyncio.Queue[str | bytes | None] = asyncio.Queue(1)
        left = asyncio.ensure_future(self._read(socket, session, frames))
        try:
            while (frame := await frames.get()) is not None:
                answer = await self._answer(session, frame, left)
                if answer is None:
                    return
                await socket.send_str(answer)
        finally:
            left.cancel()
            await asyncio.wait({left})

    async def _read(
        self,
        socket: web.WebSocketResponse,
        session: _Session,
        frames: asyncio.Queue[str | bytes | None],
    ) -> None:
        """Queue the messages of a client, and None at their end; also while its env works.

        Ends once nobody wants a reply any more.
        """
        async for message in socket:
            if message.type is WSMsgType.ERROR:
                break
            await frames.put(message.data)
        await frames.put(None)
        if session.is_kept:  # It outlives its socket.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._session_timeout):
                    await session.closing.wait()
            session.closing.set()

    async def _answer(
        self, session: _Session, frame: str | bytes, left: asyncio.Future[None]
    ) -> str | None:
        """Answer a message; None if it ends the session."""
        try:
            message: Any = json.loads(frame)
            kind: Any = message.get("type")
            data: dict[str, Any] = message.get("data") or {}
        except (ValueError, AttributeError, RecursionError) as error:
            return _error("INVALID_JSON", f"Invalid JSON: {error}")
        if kind == "close":
            return None
        try:
            reply = await self._unless_left(session, self._reply(session, kind, data), left)
        except EnvFault as fault:
            return _error("EXECUTION_ERROR", str(fault), blame=fault.outcome.blame)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            return _error("VALIDATION_ERROR", f"Invalid message: {error}")
        except RLightningError as error:
            return _error("EXECUTION_ERROR", str(error))
        if reply is None:
            return _error("UNKNOWN_TYPE", f"Unknown message type: {kind}")
        return json_of({"type": reply[0], "data": reply[1]})

    async def _unless_left(
        self, session: _Session, reply: Coroutine[Any, Any, T], left: asyncio.Future[None]
    ) -> T:
        """Wait for a reply, and abort what the env does if its client has left.

        Raises:
            EpisodeLost: that was so.
        """
        replying = asyncio.ensure_future(reply)
        await asyncio.wait({replying, left}, return_when=asyncio.FIRST_COMPLETED)
        if not replying.done():
            await self._group.abort([session.env.env_id])
        return await replying

    async def _reply(
        self, session: _Session, kind: Any, data: dict[str, Any]
    ) -> tuple[str, dict[str, Any]] | None:
        """Execute a message, and return the type and data of its reply; None if it is unknown."""
        if kind == "state":
            return "state", session.state
        if kind == "mcp":
            return "mcp", self._rpc(data, session)
        if not isinstance(data, dict):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError("its data must be an object")
        if kind == "reset":
            seed, episode_id = data.pop("seed", None), data.pop("episode_id", None)
            answer = _observed(await session.env.reset(seed, data or None))
            session.state = {"episode_id": episode_id, "step_count": 0}
            session.has_reset = True
        elif kind == "step":
            if not session.has_reset:
                raise RLightningError("this session has no episode yet; reset it first")
            answer = _observed(await session.env.step(_action_in(self._space, data)))
            session.state["step_count"] += 1
        else:
            return None
        return "observation", answer


async def _missing(request: web.Request) -> web.Response:
    detail = f"there is no {request.path}; sessions are at /ws"
    return _json_response({"detail": detail}, HTTPStatus.NOT_FOUND)


def _json_response(answer: dict[str, Any], status: HTTPStatus = HTTPStatus.OK) -> web.Response:
    return web.json_response(answer, status=status, dumps=json_of)


def _rpc_result(number: Any, **result: Any) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": number, "result": result}


def _rpc_error(number: Any, code: int, message: str, **data: Any) -> dict[str, Any]:
    error = {"code": code, "message": message, "data": data or None}
    return {"jsonrpc": "2.0", "id": number, "error": error}


def _error(code: str, message: str, **more: Any) -> str:
    return json_of({"type": "error", "data": {"message": message, "code": code, **more}})


def _observed(ret: Any) -> dict[str, Any]:
    """A result as the data of OpenEnv's observation message; NaN and infinity become null.

    Raises:
        RLightningError: the reward is not finite.
    """
    observation = _jsonable(ret.observation)
    if not isinstance(observation, dict):
        observation = {"observation": observation}
    metadata: dict[str, Any] = _jsonable(ret.info)
    if ret.last_truncated:
        metadata["truncated"] = True
    done = bool(ret.last_terminated or ret.last_truncated)
    reward = float(ret.last_reward)
    if not math.isfinite(reward):  # As null it would be taken for no reward.
        raise RLightningError(
            f"the reward of env {ret.env_id!r} is {reward}, which JSON has no number for"
        )
    data: dict[str, Any] = {"observation": observation, "reward": reward, "done": done}
    return {**data, "metadata": metadata} if metadata else data


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _jsonable(v) for k, v in cast("dict[Any, Any]", value).items()}
    if isinstance(value, list | tuple):
        return [_jsonable(one) for one in cast("list[Any]", value)]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Outcome):
        return value.to_json()
    if isinstance(value, np.ndarray | np.generic) or hasattr(value, "detach"):
        return as_array(value).tolist()
    return repr(value)


def _action_in(space: gym.Space[Any], data: dict[str, Any]) -> Any:
    """The action that the fields of a step message mean.

    Raises:
        KeyError, TypeError, ValueError: they mean none.
    """
    if is_dict(space):
        return _value_in(space, data)
    if "action" in data:
        return _value_in(space, data["action"])
    if isinstance(space, Anything):
        return data
    raise KeyError("the message has no field 'action'")


def _value_in(space: gym.Space[Any], value: Any) -> Any:
    return zipped(_array_in, tree_of(space), value)


def _array_in(space: gym.Space[Any], value: Any) -> Any:
    if space.shape is None:
        return value
    array = np.asarray(value, space.dtype)
    if array.dtype.kind != "f" and not np.array_equal(array, np.asarray(value)):
        raise ValueError(f"{value!r} is not of {space.dtype}")
    return array


def _fields_schema(space: Any, name: str) -> dict[str, Any]:
    """The JSON Schema of the object that a value of `space` travels as."""
    if is_dict(space):
        return _schema_of(space)
    return {"type": "object", "properties": {name: _schema_of(space)}, "required": [name]}


def _schema_of(space: Any) -> dict[str, Any]:
    if is_dict(space):
        parts = {key: _schema_of(inner) for key, inner in space.spaces.items()}
        return {"type": "object", "properties": parts, "required": list(parts)}
    if isinstance(space, spaces.Discrete):
        discrete = cast("spaces.Discrete[Any]", space)
        low, count = int(discrete.start), int(discrete.n)
        return {"type": "integer", "minimum": low, "maximum": low + count - 1}
    if isinstance(space, spaces.Text):
        return {"type": "string", "maxLength": space.max_length}
    if getattr(space, "shape", None) is not None:
        schema: dict[str, Any] = {"type": "number" if space.dtype.kind == "f" else "integer"}
        for size in reversed(space.shape):
            schema = {"type": "array", "items": schema, "minItems": size, "maxItems": size}
        return schema
    return {}
