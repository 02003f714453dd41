"""`ClientRegistry`: the clients of one env_server, their sessions, and their results.

Rule: the server holds at most one result of a client that the trainer has not answered, and every
lost session is reported exactly once, by the request that was pending or by the next one. Records
of absent clients are sorted by the time of leaving. Those that left first are removed first when
memory is short.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from rlightning_aio.protocol.net.limited_log import LOG
from rlightning_aio.protocol.net.server_records import ClientRecord, LastObservation, RemoteResult
from rlightning_aio.protocol.net.wire import MAX_BYTES_IN_ALL, Bye, Gone

if TYPE_CHECKING:
    from rlightning_aio.protocol.net.outbox import Outbox
    from rlightning_aio.protocol.net.server_records import ClientKind, Session
    from rlightning_aio.types import EnvMeta

__all__ = ["ClientRegistry", "NoRoom"]

_MAX_RECORDS: Final = 4096


class NoRoom(Exception):
    """The memory for clients is used up; the client may try again later."""


class ClientRegistry:
    """Clients by name and sessions by token.

    Args:
        server_id: env_id of the server.
        outbox: of the server.

    Attributes:
        metas: the env of each client that has joined, by client name.
        sessions: open sessions, by token.
        records: clients that have a session or had one, by name.
        kind: kind of the clients; None until one has joined.
        results: results that wait to be taken, oldest first.
    """

    def __init__(self, server_id: str, outbox: Outbox) -> None:
        self.metas: dict[str, EnvMeta] = {}
        self.sessions: dict[int, Session] = {}
        self.records: dict[str, ClientRecord] = {}
        self.kind: ClientKind | None = None
        self.results: list[RemoteResult] = []
        self._server_id = server_id
        self._outbox = outbox
        self._reserved = 0

    def session_named(self, name: str) -> Session | None:
        """Return the open session of a client, if it has one."""
        record = self.records.get(name)
        return None if record is None else record.session

    def session_awaited_over(self, route: bytes, user: str | None) -> Session | None:
        """Return the session that last used a connection, if its client must answer something."""
        for session in self.sessions.values():
            waits = session.record.request is not None or not session.joined
            if session.route == route and session.user == user and waits:
                return session
        return None

    # -- records --------------------------------------------------------------------

    def reserve(self, name: str, num_bytes: int) -> ClientRecord:
        """Return the record of a client that is admitted, and reserve its memory.

        Raises:
            NoRoom: clients that are present have reserved all memory, or all records.
        """
        record = self.records.get(name) or ClientRecord(name)
        more = num_bytes - record.num_bytes
        absent = [other for other in self.records.values() if other.session is None]
        # Clients whose loss the trainer does not know yet are forgotten last.
        absent.sort(key=lambda other: other.unreported is not None)
        for other in absent:
            if self._has_room(name, more):
                break
            if other is not record:
                self.forget(other)
        if not self._has_room(name, more):
            raise NoRoom(
                f"a result and an action take {num_bytes} bytes, and the {len(self.sessions)} "
                f"clients that are here have reserved {self._reserved} of {MAX_BYTES_IN_ALL}"
            )
        self.records[name] = record
        self._reserved += more
        record.num_bytes = num_bytes
        return record

    def _has_room(self, name: str, more: int) -> bool:
        num_records = len(self.records) + (name not in self.records)
        return num_records <= _MAX_RECORDS and self._reserved + more <= MAX_BYTES_IN_ALL

    def forget(self, record: ClientRecord) -> None:
        """Remove the record of an absent client."""
        del self.records[record.name]
        self._reserved -= record.num_bytes

    # -- results --------------------------------------------------------------------

    def join(self, session: Session, result: RemoteResult) -> None:
        """Accept the first result of a session."""
        if self.kind is not None and session.announced.kind != self.kind:
            # A client of another kind joined while this one was resetting.
            self.dismiss(session, "its spaces differ from those of the other clients")
            return
        record = session.record
        self.kind = session.announced.kind
        session.joined = True
        self.metas[record.name] = session.announced.meta
        LOG.info("%s: the client %r has joined", self._server_id, record.name)
        if record.request is not None:
            # The trainer requested a reset meanwhile, whose result replaces this one.
            self._outbox.post_parts(session.route, record.request.parts)
        elif record.unreported is not None:
            record.early = result
        else:
            self.add_result(session, result)

    def add_result(self, session: Session, result: RemoteResult) -> None:
        """Queue a result of a client that has joined."""
        session.record.last = LastObservation(session.announced.results, result.observation)
        self.results.append(result)

    def drop_first_result(self, record: ClientRecord) -> bool:
        """Remove a client's first result from the queue. Return False if there was none."""
        kept = [r for r in self.results if r.client != record.name or r.number is not None]
        was_queued = len(kept) < len(self.results)
        self.results = kept
        return was_queued

    def report_loss(
        self, record: ClientRecord, last: LastObservation, number: int, cause: str
    ) -> None:
        """Queue the marked result that ends request `number` of a lost client."""
        record.unreported = record.request = None
        outcome = last.results.cut_short(last.observation)
        info = {"client_lost": f"client {record.name!r}: {cause}"}
        self.results.append(RemoteResult(record.name, number, *outcome, info=info, is_loss=True))

    # -- ends of sessions -----------------------------------------------------------

    def dismiss(self, session: Session, cause: str) -> None:
        """End a session and send its client the reason."""
        self._outbox.post(session.route, Gone(session=session.token, text=cause))
        self.lose(session, cause)

    def lose(self, session: Session, cause: str, level: int = logging.WARNING) -> None:
        """End a session. The pending request reports `cause`, or the next one does."""
        # A peer that never joins can be lost as often as it likes.
        level = level if session.joined else logging.INFO
        record = session.record
        LOG.log(level, "%s: lost the client %r: %s", self._server_id, record.name, cause)
        record.session = None
        del self.sessions[session.token]
        self.metas.pop(record.name, None)
        # Absent clients are sorted by the time of leaving.
        self.records[record.name] = self.records.pop(record.name)
        if record.last is None:
            # The client never joined, so the trainer does not know it.
            self.forget(record)
        elif record.request is not None:
            self.report_loss(record, record.last, record.request.number, cause)
        elif record.early is not None:
            record.early = None
        elif session.joined and not self.drop_first_result(record):
            record.unreported = cause

    def clear(self, reason: str) -> None:
        """End all sessions and send every client the reason. No loss is reported."""
        for session in self.sessions.values():
            self._outbox.post(session.route, Bye(session=session.token, reason=reason))
        self.sessions.clear()
        self.records.clear()
        self._reserved = 0
        self.metas.clear()
        self.results.clear()
