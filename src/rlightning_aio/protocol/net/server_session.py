"""`ServerSessions`: the trainer's end of env_server, without I/O.

Rule: a connection is a session. It begins with a hello and ends with the connection, a goodbye or
the first message that breaks the rules, and nothing is sent twice. Every request ends in exactly
one result or one typed error, and every loss of a client is reported once: by the request in flight
or, if there is none, by the next step. Messages come in, messages and results are queued, and time
is an argument. Deliberately left out: sockets, keys, and the group's own bookkeeping.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rlightning_aio.errors import BadAction, EnvBusy, UnknownEnv
from rlightning_aio.outcomes import BLAMES
from rlightning_aio.protocol.columns import Misfit
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.net.announcements import Rejection, announced
from rlightning_aio.protocol.net.payload import Packed
from rlightning_aio.protocol.net.texts import LOG, in_lines, in_one_line
from rlightning_aio.protocol.net.wire import (
    Bye,
    ClientHello,
    ClientResult,
    FromClient,
    Part,
    Reader,
    Refusal,
    Reset,
    Step,
    Untransferable,
    Welcome,
    WireError,
    Writer,
    portable,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rlightning_aio.protocol.net.announcements import Announcement, ClientKind
    from rlightning_aio.types import ClientTraits, EnvMeta

__all__ = ["OutgoingMessage", "RemoteResult", "ServerSession", "ServerSessions"]

_MAX_SESSIONS: Final = 512


class OutgoingMessage(NamedTuple):
    """A message and the route of the connection that it is for."""

    route: bytes
    parts: list[bytes]


@dataclass(slots=True)
class RemoteResult:
    """The result of one request to a client.

    Attributes:
        client: name of the client.
        number: number of the request as it was submitted; None for a first result, which
            answers no request.
        observation: read-only arrays in the shape of the observation space.
        reward, terminated, truncated: numbers, arrays ``[num_envs]``, or dicts of either
            by agent.
        info, extra: as the env returned them; ``info["client_lost"]`` says why a client is lost.
        busy_ns: duration of the env's call, by the client's clock.
        sent_ns: time at which the env produced the result, in ns since the epoch by the
            client's clock; 0 if the client sent none.
        error: the env's exception; the other fields are then unset.
        is_reset: the result begins an episode.
        is_loss: the result only marks that the client was lost.
    """

    client: str
    number: int | None
    observation: Any = None
    reward: Any = 0.0
    terminated: Any = False
    truncated: Any = False
    info: dict[str, Any] = field(default_factory=dict[str, Any])
    extra: dict[str, Any] = field(default_factory=dict[str, Any])
    busy_ns: int = 0
    sent_ns: int = 0
    error: ErrorText | None = None
    is_reset: bool = False
    is_loss: bool = False


class _Request(NamedTuple):
    """A request in flight.

    Attributes:
        number: as the trainer submitted it.
        operation: ``step`` or ``reset``.
        timeout: seconds allowed; deadline: when they end (monotonic seconds).
    """

    number: int
    operation: str
    timeout: float | None
    deadline: float | None


@dataclass(slots=True, eq=False)
class ServerSession:
    """One connection of a client that was let in.

    Attributes:
        name: of the client.
        route: address of the connection.
        announced: contents of its hello.
        joined: the first result has arrived.
        first: the first result, while an earlier session's loss is not reported.
        request: in flight.
        last_number: number of the last request on the wire; 0 is the reset that begins a session.
        observation: the last one that was queued.
    """

    name: str
    route: bytes
    announced: Announcement
    joined: bool = False
    first: RemoteResult | None = None
    request: _Request | None = None
    last_number: int = 0
    observation: Any = None

    def result(self, message: ClientResult, frames: Sequence[Part]) -> RemoteResult:
        """Return the contents of a result.

        Raises:
            WireError: they are not what the client announced.
        """
        header = (message.reward, message.terminated, message.truncated)
        request = self.request
        return RemoteResult(
            self.name,
            None if request is None else request.number,
            *self.announced.results.unpack(frames, message.texts, header),
            message.info,
            message.extra,
            message.busy_ns,
            message.sent_ns,
            is_reset=request is None or request.operation == "reset",
        )

    def marked(self, cause: str) -> RemoteResult:
        """Return the result of the request in flight, or of the next one, of a lost client."""
        return RemoteResult(
            self.name,
            None if self.request is None else self.request.number,
            *self.announced.results.cut_short(self.observation),
            info={"client_lost": f"client {self.name!r}: {cause}"},
            is_loss=True,
        )


class ServerSessions:
    """All sessions of one env_server.

    Args:
        server_id: env_id of the server; its clients' envs are ``<server_id>/<name>``.
        step_timeout, reset_timeout: seconds after which a client that has not answered counts as
            lost; None for never.
        objection: returns the trainer's reason to refuse an env, or None.

    Attributes:
        clients: the env of each client that has joined (its first result has come), by name.
        outbox: messages that wait to be sent, oldest first; the sender removes them.
    """

    def __init__(
        self,
        server_id: str,
        *,
        step_timeout: float | None = None,
        reset_timeout: float | None = None,
        objection: Callable[[EnvMeta], str | None] = lambda _: None,
    ) -> None:
        self.clients: dict[str, EnvMeta] = {}
        self.outbox: deque[OutgoingMessage] = deque()
        self._server_id = server_id
        self._timeouts = {"step": step_timeout, "reset": reset_timeout}
        self._objection = objection
        self._reader: Reader[FromClient] = Reader(FromClient)
        self._writer = Writer()
        self._last_warning = ""
        self._dropped_extras: set[str] = set()
        self._kind: ClientKind | None = None
        self._by_route: dict[bytes, ServerSession] = {}
        self._by_name: dict[str, ServerSession] = {}
        self._losses: dict[str, RemoteResult] = {}
        self._results: list[RemoteResult] = []
        self._check_at: float | None = None

    @property
    def has_results(self) -> bool:
        """True if `take` would return any result."""
        return bool(self._results)

    def take(self) -> list[RemoteResult]:
        """Return all queued results, oldest first; each is returned once."""
        results, self._results = self._results, []
        return results

    def holds(self, route: bytes) -> bool:
        """Return True if the connection `route` has a session."""
        return route in self._by_route

    # -- requests -------------------------------------------------------------------

    def traits(self, client: str) -> ClientTraits:
        """Return how a client that is present treats requests."""
        if (session := self._by_name.get(client)) is None:
            raise UnknownEnv(f"no client named {client!r} is connected to {self._server_id}")
        return session.announced.traits

    def check_step(self, client: str, action: Any, extras: Mapping[str, Any]) -> None:
        """Raise `BadAction` if `client` is present and the step cannot be sent to it."""
        if (session := self._by_name.get(client)) is not None:
            self._step_parts(session, action, extras)

    def check_reset(
        self, client: str, seed: int | list[int] | None, options: dict[str, Any] | None
    ) -> None:
        """Raise `ValueError` if `client` is present and the reset cannot be sent to it."""
        if (session := self._by_name.get(client)) is not None:
            self._reset_parts(session, seed, options)

    def step(
        self, client: str, number: int, action: Any, extras: Mapping[str, Any], now: float
    ) -> bool:
        """Request a step.

        Args:
            client: name of a client.
            number: returned with the result.
            action: fits the client's action space, unless the client transforms actions.
            extras: columns that the policy attached; sent if the client reads them.
            now: monotonic seconds.

        Returns:
            True if a result with `number` will come. False if the client is absent and the
            trainer knows that; its next first result comes when it is back.

        Raises:
            EnvBusy: the client has not answered its last request.
            BadAction: the action does not fit, or the response cannot be sent.
        """
        session = self._by_name.get(client)
        if (loss := self._losses.pop(client, None)) is not None:
            loss.number = number
            self._results.append(loss)
            if session is not None and session.first is not None:
                first, session.first = session.first, None
                self._add(session, first)
            return True
        if session is None or not session.joined:
            return False
        self._send(session, "step", number, self._step_parts(session, action, extras), now)
        return True

    def reset(
        self,
        client: str,
        number: int,
        seed: int | list[int] | None,
        options: dict[str, Any] | None,
        now: float,
    ) -> bool:
        """Request a reset, after which no earlier loss is reported.

        Returns and raises as `step`, and raises `ValueError` for options that cannot be sent.
        """
        session = self._by_name.get(client)
        if session is None or not session.joined:
            self._losses.pop(client, None)
            return False
        parts = self._reset_parts(session, seed, options)
        self._losses.pop(client, None)
        if session.first is not None:
            session.observation, session.first = session.first.observation, None
        self._send(session, "reset", number, parts, now)
        return True

    def _step_parts(
        self, session: ServerSession, action: Any, extras: Mapping[str, Any]
    ) -> list[bytes]:
        step = Step(number=session.last_number + 1)
        packed = Packed([], step.texts)
        traits = session.announced.traits
        try:
            if traits.free_actions:
                step.action = action
            else:
                session.announced.actions.pack(action, packed)
            if extras and traits.reads_extras:
                step.extras = self._portable_extras(extras)
            return self._writer.write(step, packed.frames)
        except (Misfit, Untransferable) as error:
            raise BadAction(
                f"response for {session.announced.meta.env_id}: {error}; nothing was sent"
            ) from None

    def _reset_parts(
        self, session: ServerSession, seed: int | list[int] | None, options: dict[str, Any] | None
    ) -> list[bytes]:
        try:
            return self._writer.write(
                Reset(number=session.last_number + 1, seed=seed, options=options)
            )
        except Untransferable as error:
            raise ValueError(
                f"reset of {session.announced.meta.env_id}: seed or options can't be sent: {error}"
            ) from None

    def _portable_extras(self, extras: Mapping[str, Any]) -> dict[str, Any]:
        lost: list[str] = []
        kept = portable(extras, lost)
        if new := sorted({*lost} - self._dropped_extras):
            self._dropped_extras.update(new)
            LOG.warning(
                "%s: what the policy attached as %s can't be sent to a client and is dropped",
                self._server_id, ", ".join(new),
            )  # fmt: skip
        return kept

    def _send(
        self, session: ServerSession, operation: str, number: int, parts: list[bytes], now: float
    ) -> None:
        if session.request is not None:
            raise EnvBusy(
                f"{session.announced.meta.env_id} has not answered its last "
                f"{session.request.operation}; collect the result first"
            )
        session.last_number += 1
        deadline = None
        if (timeout := self._timeouts[operation]) is not None:
            deadline = now + timeout
            if self._check_at is None or deadline < self._check_at:
                self._check_at = deadline
        session.request = _Request(number, operation, timeout, deadline)
        self.outbox.append(OutgoingMessage(session.route, parts))

    # -- messages -------------------------------------------------------------------

    def receive(self, route: bytes, parts: Sequence[Part]) -> None:
        """Read one message and answer it. No content makes it raise.

        Args:
            route: of the connection, for answers.
            parts: header and frames.
        """
        session = self._by_route.get(route)
        try:
            message, frames = self._reader.read(parts)
            if session is not None:
                self._handle(session, message, frames)
            elif isinstance(message, ClientHello):
                self._on_hello(message, len(parts[0]), route)
            # A client may have sent other messages before it read that its session is over.
        except WireError as error:
            text = in_one_line(str(error))
            if session is None:
                self._warn(f"dropped a message: {text}")
            else:
                self._dismiss(session, f"a message of it is malformed: {text}")

    def _warn(self, text: str) -> None:
        """Log a warning, unless it repeats the last one."""
        if text != self._last_warning:
            self._last_warning = text
            LOG.warning("%s: %s", self._server_id, text)

    def _on_hello(self, hello: ClientHello, size: int, route: bytes) -> None:
        """Answer a hello whose header has `size` bytes."""
        try:
            self._let_in(hello, size, route)
        except Rejection as error:
            text = in_one_line(str(error))
            self._warn(in_one_line(f"refused the client {hello.name!r}: {text}"))
            self._post(route, Refusal(text=text, retry=error.retry))

    def _let_in(self, hello: ClientHello, size: int, route: bytes) -> None:
        if hello.name in self._by_name:
            raise Rejection(f"a client named {hello.name!r} is here already", retry=True)
        if len(self._by_name) >= _MAX_SESSIONS:
            raise Rejection(f"{len(self._by_name)} clients are here already", retry=True)
        found = announced(hello, size, self._server_id, self._kind, self._objection)
        self._by_route[route] = self._by_name[hello.name] = ServerSession(hello.name, route, found)
        self._post(route, Welcome(env_id=found.meta.env_id))

    def _handle(self, session: ServerSession, message: FromClient, frames: Sequence[Part]) -> None:
        """Read a message of a session.

        Raises:
            WireError: it breaks the rules.
        """
        if isinstance(message, Bye):
            cause = f"it left: {in_one_line(message.reason) or 'no reason given'}"
            self._lose(session, cause, logging.INFO)
            return
        if isinstance(message, ClientHello):
            raise WireError("a second hello")
        request = session.request
        if message.number != session.last_number or (request is None and session.joined):
            raise WireError(f"an answer to request {message.number}, which is not in flight")
        if isinstance(message, ClientResult):
            result = session.result(message, frames)
            if request is None:
                self._join(session, result)
            else:
                session.request = None
                self._add(session, result)
            return
        error = ErrorText(
            in_one_line(message.exception_type),
            in_one_line(message.text),
            in_lines(message.traceback),
            message.blame if message.blame in BLAMES else "",
        )
        if request is None:
            self._dismiss(session, f"its first reset raised {error.summary}")
            return
        session.request = None
        self._results.append(RemoteResult(session.name, request.number, error=error))

    def _join(self, session: ServerSession, result: RemoteResult) -> None:
        kind = session.announced.kind
        if self._kind is not None and kind != self._kind:
            # A client of another kind joined while this one was resetting.
            self._dismiss(session, "its spaces differ from those of the other clients")
            return
        self._kind = kind
        session.joined = True
        self.clients[session.name] = session.announced.meta
        LOG.info("%s: the client %r has joined", self._server_id, session.name)
        if session.name in self._losses:
            session.first = result
        else:
            self._add(session, result)

    def _add(self, session: ServerSession, result: RemoteResult) -> None:
        session.observation = result.observation
        self._results.append(result)

    def _post(self, route: bytes, message: Welcome | Refusal | Bye) -> None:
        self.outbox.append(OutgoingMessage(route, self._writer.write(message)))

    # -- ends of sessions -----------------------------------------------------------

    def disconnected(self, route: bytes, cause: str = "its connection broke") -> None:
        """Record that a connection is gone, after all of its messages have been received."""
        if (session := self._by_route.get(route)) is not None:
            self._lose(session, cause)

    def dismiss(self, client: str, cause: str) -> None:
        """Send a client away, with the reason. No request reports that."""
        if (session := self._by_name.get(client)) is not None:
            self._dismiss(session, cause)
            self._losses.pop(client, None)

    def close(self, reason: str) -> None:
        """End all sessions and send every client the reason. No loss is reported."""
        for route in self._by_route:
            self._post(route, Bye(reason=reason))
        for table in (self._by_route, self._by_name, self._losses, self.clients, self._results):
            table.clear()
        self._check_at = None

    def deadline(self) -> float | None:
        """Return the time at which `tick` is due (monotonic seconds); None if never."""
        return self._check_at

    def tick(self, now: float) -> None:
        """Dismiss clients whose time is up. Call it after reading all messages."""
        if self._check_at is None or now < self._check_at:
            return
        waiting = [one for one in self._by_name.values() if one.request and one.request.deadline]
        for session in waiting:
            request = session.request
            if request and request.deadline and now >= request.deadline:
                cause = f"no result of a {request.operation} within {request.timeout} s"
                self._dismiss(session, cause)
        left = [one.request.deadline for one in waiting if one.request and one.request.deadline]
        self._check_at = min(left, default=None)

    def _dismiss(self, session: ServerSession, cause: str) -> None:
        """End a session and send its client the reason."""
        self._post(session.route, Bye(reason=cause))
        self._lose(session, cause)

    def _lose(self, session: ServerSession, cause: str, level: int = logging.WARNING) -> None:
        """End a session. The request in flight reports `cause`, or the next one does."""
        # A peer that never joins can be lost as often as it likes.
        level = level if session.joined else logging.INFO
        LOG.log(level, "%s: lost the client %r: %s", self._server_id, session.name, cause)
        del self._by_route[session.route], self._by_name[session.name]
        self.clients.pop(session.name, None)
        if session.request is not None:
            self._results.append(session.marked(cause))
            session.request = None
        elif session.joined and session.first is None:
            num_results = len(self._results)
            self._results = [
                r for r in self._results if r.client != session.name or r.number is not None
            ]
            # Otherwise its first result was never taken.
            if len(self._results) == num_results:
                self._losses[session.name] = session.marked(cause)
