"""`ClientRequests`: sends the trainer's steps and resets to the clients of an env_server.

Rule: a request is checked and encoded before anything changes. It is numbered within its session,
and its message is kept for repetitions until it is answered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio.errors import BadAction, EnvBusy, UnknownEnv
from rlightning_aio.protocol.columns import Misfit
from rlightning_aio.protocol.net.limited_log import LOG
from rlightning_aio.protocol.net.payload import Packed
from rlightning_aio.protocol.net.server_records import PendingRequest
from rlightning_aio.protocol.net.wire import Reset, Step, Untransferable, portable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rlightning_aio.protocol.net.client_registry import ClientRegistry
    from rlightning_aio.protocol.net.outbox import Outbox
    from rlightning_aio.protocol.net.server_records import ClientRecord, LastObservation, Session
    from rlightning_aio.types import ClientTraits

__all__ = ["ClientRequests"]


class ClientRequests:
    """See the module.

    Args:
        server_id: env_id of the server.
        registry, outbox: of the server.
        step_timeout, reset_timeout: seconds after which a client that has not answered counts as
            lost; None for never.
    """

    def __init__(
        self,
        server_id: str,
        registry: ClientRegistry,
        outbox: Outbox,
        step_timeout: float | None,
        reset_timeout: float | None,
    ) -> None:
        self._server_id = server_id
        self._registry = registry
        self._outbox = outbox
        self._timeouts = {"step": step_timeout, "reset": reset_timeout}
        self._dropped_extras: set[str] = set()

    def traits(self, client: str) -> ClientTraits:
        """Return how a client that is present treats requests."""
        session = self._registry.session_named(client)
        if session is None:
            raise UnknownEnv(f"no client named {client!r} is connected to {self._server_id}")
        return session.announced.traits

    def check_step(self, client: str, action: Any, extras: Mapping[str, Any]) -> None:
        """Raise `BadAction` if `client` is present and the step cannot be sent to it."""
        if (session := self._registry.session_named(client)) is not None:
            self._step_parts(session, action, extras)

    def check_reset(
        self, client: str, seed: int | list[int] | None, options: dict[str, Any] | None
    ) -> None:
        """Raise `ValueError` if `client` is present and the reset cannot be sent to it."""
        if (session := self._registry.session_named(client)) is not None:
            self._reset_parts(session, seed, options)

    def step(
        self, client: str, number: int, action: Any, extras: Mapping[str, Any], now: float
    ) -> bool:
        """Request a step.

        Args:
            client: name of a client that has joined once.
            number: returned with the result; 0 or more.
            action: fits the client's action space, unless the client transforms actions.
            extras: columns that the policy attached; sent if the client reads them.
            now: monotonic seconds.

        Returns:
            True if a result with `number` will come. False if the client is absent and the
            trainer knows that; its next first result comes when it is back.

        Raises:
            UnknownEnv: no client of that name ever joined, or it has been forgotten.
            EnvBusy: the client has not answered its last request.
            BadAction: the action does not fit, or the response cannot be sent.
        """
        record, last = self._idle_record(client)
        session = record.session
        if record.unreported is not None:
            self._registry.report_loss(record, last, number, record.unreported)
            return True
        if record.early is not None and session is not None:
            result, record.early = record.early, None
            result.number = number
            self._registry.add_result(session, result)
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
        """Request a reset. A first result that has not been taken is dropped.

        Returns and raises as `step`, and raises `ValueError` for options that cannot be sent.
        """
        record, _ = self._idle_record(client)
        session = record.session
        parts = [] if session is None else self._reset_parts(session, seed, options)
        record.unreported = record.early = None
        self._registry.drop_first_result(record)
        if session is None:
            return False
        self._send(session, "reset", number, parts, now)
        return True

    def _idle_record(self, client: str) -> tuple[ClientRecord, LastObservation]:
        record = self._registry.records.get(client)
        if record is None or record.last is None:
            raise UnknownEnv(
                f"no client named {client!r} has joined {self._server_id}; joined are "
                f"{', '.join(map(repr, self._registry.metas)) or 'none'}"
            )
        if record.request is not None:
            raise EnvBusy(
                f"{self._server_id}/{client} has not answered its last {record.request.operation}; "
                "collect the result first"
            )
        return record, record.last

    def _step_parts(self, session: Session, action: Any, extras: Mapping[str, Any]) -> list[bytes]:
        """Encode a step as the next request of a session."""
        step = Step(session=session.token, number=session.last_number + 1)
        packed = Packed([], step.texts)
        announced = session.announced
        try:
            if announced.traits.free_actions:
                step.action = action
            else:
                announced.actions.pack(action, packed)
            if extras and announced.traits.reads_extras:
                step.extras = self._portable_extras(extras)
            return self._outbox.writer.write(step, packed.frames)
        except (Misfit, Untransferable) as error:
            raise BadAction(
                f"response for {announced.meta.env_id}: {error}; nothing was sent"
            ) from None

    def _reset_parts(
        self, session: Session, seed: int | list[int] | None, options: dict[str, Any] | None
    ) -> list[bytes]:
        """Encode a reset as the next request of a session."""
        number = session.last_number + 1
        reset = Reset(session=session.token, number=number, seed=seed, options=options)
        try:
            return self._outbox.writer.write(reset)
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
        self, session: Session, operation: str, number: int, parts: list[bytes], now: float
    ) -> None:
        """Record a request, and send it if the client has joined."""
        session.last_number += 1
        session.num_malformed = 0
        timeout = self._timeouts[operation]
        deadline = None if timeout is None else now + timeout
        session.record.request = PendingRequest(
            number, session.last_number, parts, operation, timeout, deadline
        )
        if session.joined:
            self._outbox.post_parts(session.route, parts)
