"""`SessionMonitor`: finds dead clients and repeats messages that were lost.

Rule: an idle client is pinged when it is silent, and given up after the heartbeat limit. A busy
client cannot answer pings, so its connection and the timeout of its request decide. A client
answers a ping only after it has done all that came before, so a pong for a pending request means
that the request or its answer was lost.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio.protocol.net.wire import PINGS_PER_HEARTBEAT, Ping, Welcome

if TYPE_CHECKING:
    from rlightning_aio.protocol.net.client_registry import ClientRegistry
    from rlightning_aio.protocol.net.outbox import Outbox
    from rlightning_aio.protocol.net.server_records import Session

__all__ = ["SessionMonitor"]


class SessionMonitor:
    """Watches the sessions of one env_server.

    Args:
        registry, outbox: of the server.
        heartbeat: seconds within which a dead client is found.
        timeouts: the time limits of requests, in seconds.
    """

    def __init__(
        self,
        registry: ClientRegistry,
        outbox: Outbox,
        heartbeat: float,
        timeouts: tuple[float | None, ...],
    ) -> None:
        self._registry = registry
        self._outbox = outbox
        self._heartbeat = heartbeat
        self._ping_period = heartbeat / PINGS_PER_HEARTBEAT
        quarters = [timeout / 4 for timeout in timeouts if timeout is not None]
        self._tick_period = min(self._ping_period, *quarters, heartbeat)
        self._next_tick: float | None = None

    def start(self, now: float) -> None:
        """Watch a session that was just opened."""
        if self._next_tick is None:
            self._next_tick = now + self._tick_period

    def welcome(self, session: Session) -> None:
        """Send the message that opens a session, for the first time or again."""
        self._outbox.post(
            session.route,
            Welcome(
                nonce=session.nonce,
                session=session.token,
                env_id=session.announced.meta.env_id,
                heartbeat=self._heartbeat,
            ),
        )

    def ping(self, session: Session, now: float) -> None:
        """Ask a client for a sign of life."""
        session.pinged_at = now
        if session.unanswered_since is None:
            session.unanswered_since = now
        number = session.request.wire_number if session.request else 0
        self._outbox.post(session.route, Ping(session=session.token, number=number))

    def on_pong(self, session: Session, number: int) -> None:
        """Repeat the pending request if the pong names it."""
        if number == (session.request.wire_number if session.request else 0):
            self.repeat(session)

    def repeat(self, session: Session) -> None:
        """Send the message again that the client has not answered, if there is one."""
        if not session.joined:
            self.welcome(session)
        elif session.request is not None:
            self._outbox.post_parts(session.route, session.request.parts)

    def on_unreachable(self, route: bytes, now: float) -> None:
        """Record that a message to `route` could not be sent: its connection is gone."""
        for session in self._registry.sessions.values():
            if session.route == route and session.unreachable_since is None:
                session.unreachable_since = now

    def deadline(self) -> float | None:
        """Return the time at which `tick` is due (monotonic seconds); None if never."""
        return self._next_tick

    def tick(self, now: float) -> None:
        """Ping silent clients and dismiss dead ones. Call it after reading all messages."""
        if self._next_tick is None or now < self._next_tick:
            return
        for session in list(self._registry.sessions.values()):
            cause = self._cause_of_death(session, now)
            if cause is not None:
                self._registry.dismiss(session, cause)
            elif now - max(session.received_at, session.pinged_at) >= self._ping_period:
                self.ping(session, now)
        self._next_tick = now + self._tick_period if self._registry.sessions else None

    def stop(self) -> None:
        """Watch nothing, as all sessions have ended."""
        self._next_tick = None

    def _cause_of_death(self, session: Session, now: float) -> str | None:
        """Return the reason to give a client up; None if it may be alive."""
        request = session.record.request
        broken, silent = session.unreachable_since, session.unanswered_since
        if broken is not None and now - broken >= 2 * self._ping_period:
            return "its connection broke and it did not come back"
        if request is not None and request.deadline is not None and now >= request.deadline:
            return f"no result of a {request.operation} within {request.timeout} s"
        is_idle = request is None and session.joined
        if is_idle and silent is not None and now - silent >= self._heartbeat:
            return f"no sign of life for {now - session.received_at:.1f} s"
        return None
