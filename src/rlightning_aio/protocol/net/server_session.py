"""`ServerSessions`: the trainer's end of env_server, without I/O.

Rule: every request ends in exactly one result or one typed error, whatever the network loses,
repeats, delays or reorders. Messages come in, messages and results are queued, and time is an
argument. This module reads messages and answers; the parts below do the rest: `admission` opens
sessions, `session_monitor` watches them, `client_requests` sends requests, `client_registry` keeps
the records. Deliberately left out: sockets, keys, and the group's own bookkeeping.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from rlightning_aio.outcomes import BLAMES
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.net.admission import Admission, Peer
from rlightning_aio.protocol.net.client_registry import ClientRegistry
from rlightning_aio.protocol.net.client_requests import ClientRequests
from rlightning_aio.protocol.net.limited_log import LimitedLog
from rlightning_aio.protocol.net.outbox import Outbox
from rlightning_aio.protocol.net.server_records import MessageEffect, RemoteResult
from rlightning_aio.protocol.net.session_monitor import SessionMonitor
from rlightning_aio.protocol.net.texts import in_lines, in_one_line
from rlightning_aio.protocol.net.wire import (
    MAX_NESTING,
    STALE_REQUEST,
    Bye,
    ClientHello,
    ClientResult,
    Failure,
    FromClient,
    Gone,
    Part,
    Ping,
    Pong,
    Reader,
    WireError,
    nests_too_deep,
    random_token,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rlightning_aio.protocol.net.server_records import PendingRequest, Session
    from rlightning_aio.types import EnvMeta

__all__ = ["ServerSessions"]

_MAX_MALFORMED: Final = 3
"""Malformed answers to one request after which a session ends."""


class ServerSessions:
    """All sessions of one env_server.

    Args:
        server_id: env_id of the server; its clients' envs are ``<server_id>/<name>``.
        heartbeat: seconds within which a dead client is found.
        step_timeout, reset_timeout: seconds after which a client that has not answered counts as
            lost; None for never.
        objection: returns the trainer's reason to refuse an env, or None.
        new_token: makes session tokens.

    Attributes:
        outbox: messages that wait to be sent, oldest first; the sender removes them.
        requests: sends steps and resets.
        num_malformed: messages that were dropped as malformed.
    """

    def __init__(
        self,
        server_id: str,
        *,
        heartbeat: float,
        step_timeout: float | None = None,
        reset_timeout: float | None = None,
        objection: Callable[[EnvMeta], str | None] = lambda _: None,
        new_token: Callable[[], int] = random_token,
    ) -> None:
        self.outbox = Outbox()
        self.num_malformed = 0
        self._reader: Reader[FromClient] = Reader(FromClient)
        self._log = LimitedLog(server_id)
        registry = self._registry = ClientRegistry(server_id, self.outbox)
        timeouts = (step_timeout, reset_timeout)
        monitor = self._monitor = SessionMonitor(registry, self.outbox, heartbeat, timeouts)
        self.requests = ClientRequests(server_id, registry, self.outbox, *timeouts)
        self._admission = Admission(
            server_id, registry, monitor, self.outbox, self._log,
            objection=objection, new_token=new_token,
        )  # fmt: skip

    @property
    def clients(self) -> Mapping[str, EnvMeta]:
        """The env of each client that has joined (its first result has come), by client name."""
        return self._registry.metas

    @property
    def has_results(self) -> bool:
        """True if `take` would return any result."""
        return bool(self._registry.results)

    def take(self) -> list[RemoteResult]:
        """Return all queued results, oldest first; each is returned once."""
        results, self._registry.results = self._registry.results, []
        return results

    def routes(self) -> set[bytes]:
        """Return the routes that clients used last, one for each session."""
        return {session.route for session in self._registry.sessions.values()}

    def on_unreachable(self, route: bytes, now: float) -> None:
        """Record that a message to `route` could not be sent: its connection is gone."""
        self._monitor.on_unreachable(route, now)

    def deadline(self) -> float | None:
        """Return the time at which `tick` is due (monotonic seconds); None if never."""
        return self._monitor.deadline()

    def tick(self, now: float) -> None:
        """Ping silent clients and dismiss dead ones. Call it after reading all messages."""
        self._monitor.tick(now)

    def dismiss(self, client: str, cause: str) -> None:
        """Send a client away, with the reason, whose first result the trainer did not accept."""
        session = self._registry.session_named(client)
        if session is not None:
            self._registry.dismiss(session, cause)
            # No request will ask for it.
            session.record.unreported = None

    def close(self, reason: str) -> None:
        """End all sessions and send every client the reason. No loss is reported."""
        self._registry.clear(reason)
        self._monitor.stop()

    # -- messages -------------------------------------------------------------------

    def receive(
        self, route: bytes, user: str | None, parts: Sequence[Part], now: float
    ) -> MessageEffect:
        """Read one message and answer it. No content makes it raise.

        Args:
            route: address for answers.
            user: name of the key that the connection has proved; None without keys.
            parts: header and frames.
            now: monotonic seconds.
        """
        try:
            message, frames = self._reader.read(parts)
            if isinstance(message, ClientHello):
                return self._admission.on_hello(message, len(parts[0]), Peer(route, user), now)
            session = self._session_of(message, route, user, now)
        except WireError as error:
            self._on_malformed(str(error), self._registry.session_awaited_over(route, user), now)
            return MessageEffect.MALFORMED
        if session is None:
            return MessageEffect.TURNED_AWAY
        self._handle(session, message, frames, now)
        return MessageEffect.IN_SESSION

    def _session_of(
        self,
        message: ClientResult | Failure | Ping | Pong | Bye,
        route: bytes,
        user: str | None,
        now: float,
    ) -> Session | None:
        """Return the session of a message and note its sign of life; None without a session.

        Raises:
            WireError: the session belongs to another key.
        """
        session = self._registry.sessions.get(message.session)
        if session is None:
            if not isinstance(message, Bye):
                self.outbox.post(route, Gone(session=message.session, text="no such session"))
            return None
        if session.user != user:
            raise WireError(f"{user!r} used the session of {session.user!r}")
        session.route = route
        session.received_at = now
        session.unanswered_since = session.unreachable_since = None
        return session

    def _handle(
        self,
        session: Session,
        message: ClientResult | Failure | Ping | Pong | Bye,
        frames: Sequence[Part],
        now: float,
    ) -> None:
        if isinstance(message, ClientResult):
            self._on_result(session, message, frames, now)
        elif isinstance(message, Failure):
            self._on_failure(session, message)
        elif isinstance(message, Ping):
            self.outbox.post(session.route, Pong(session=session.token, number=message.number))
            # A client pings after its connection broke: messages on the way may be lost.
            self._monitor.repeat(session)
        elif isinstance(message, Pong):
            self._monitor.on_pong(session, message.number)
        else:
            cause = f"it left: {in_one_line(message.reason) or 'no reason given'}"
            self._registry.lose(session, cause, logging.INFO)

    def _on_malformed(self, error: str, session: Session | None, now: float) -> None:
        """Count a malformed message, and end the session if it was one too many in answer."""
        self.num_malformed += 1
        line = f"dropped a message ({self.num_malformed} so far): {error}"
        self._log.warn("malformed", in_one_line(line), now)
        if session is not None:
            session.num_malformed += 1
            if session.num_malformed >= _MAX_MALFORMED:
                cause = f"its messages don't fit what it announced: {in_one_line(error)}"
                self._registry.dismiss(session, cause)

    # -- replies --------------------------------------------------------------------

    def _on_result(
        self, session: Session, message: ClientResult, frames: Sequence[Part], now: float
    ) -> None:
        request = self._answered_request(session, message.number)
        if request is None and not _is_first(session, message.number):
            return  # No request waits for it any longer.
        try:
            if nests_too_deep(message.info) or nests_too_deep(message.extra):
                raise WireError(f"an info is nested more than {MAX_NESTING} deep")
            header = (message.reward, message.terminated, message.truncated)
            outcome = session.announced.results.unpack(frames, message.texts, header)
        except WireError as error:
            self._on_malformed(str(error), session, now)
            return
        result = RemoteResult(
            session.record.name,
            None if request is None else request.number,
            *outcome,
            message.info,
            message.extra,
            message.busy_ns,
            message.sent_ns,
            is_reset=request is None or request.operation == "reset",
        )
        if request is None:
            self._registry.join(session, result)
        else:
            session.record.request = None
            self._registry.add_result(session, result)

    def _answered_request(self, session: Session, wire_number: int) -> PendingRequest | None:
        """Return the pending request that a reply answers; None for any other reply."""
        request = session.request
        return request if request is not None and request.wire_number == wire_number else None

    def _on_failure(self, session: Session, message: Failure) -> None:
        request = self._answered_request(session, message.number)
        error = ErrorText(
            in_one_line(message.exception_type),
            in_one_line(message.text),
            in_lines(message.traceback),
            message.blame if message.blame in BLAMES else "",
        )
        if request is None:
            if _is_first(session, message.number):
                self._registry.lose(session, f"its first reset raised {error.summary}")
            return
        if message.exception_type == STALE_REQUEST:
            # The server never sent a newer request, so the two ends disagree on numbers.
            self._registry.dismiss(session, f"it lost count: {error.text}")
            return
        session.record.request = None
        self._registry.results.append(
            RemoteResult(session.record.name, request.number, error=error)
        )


def _is_first(session: Session, wire_number: int) -> bool:
    """Return True if a reply is the outcome of the reset that opens the session."""
    return not session.joined and wire_number == 0
