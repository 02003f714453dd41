"""The trainer's end of env_server, without I/O: who is here, and what each client owes.

Rule: every request ends in exactly one result or one typed error, whatever is lost,
repeated, late or reordered on the way; messages come in, messages and results pile up to
be taken out, and time is an argument. The trainer holds at most one result of a client
that it hasn't answered.
Absent on purpose: sockets, keys, and the group's own bookkeeping.
"""

from __future__ import annotations

import logging
import secrets
from collections import deque
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.errors import BadAction, EnvBusy, EnvRaised, UnknownEnv
from rlightning_aio.protocol.columns import Misfit
from rlightning_aio.protocol.net.payload import Packed, ResultLayout, SpaceLayout
from rlightning_aio.protocol.net.space_description import describe, space_from
from rlightning_aio.protocol.net.texts import in_lines, in_one_line
from rlightning_aio.protocol.net.wire import (
    MAX_BYTES_IN_ALL,
    MAX_HELLO_BYTES,
    MAX_NESTING,
    STALE_REQUEST,
    VERSION,
    Bye,
    Failure,
    FromClient,
    Gone,
    Hello,
    Part,
    Ping,
    Pong,
    Reader,
    Refusal,
    Reset,
    Result,
    Step,
    Untransferable,
    Welcome,
    WireError,
    Writer,
    nests_too_deep,
    portable,
)
from rlightning_aio.types import ClientTraits, EnvMeta

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

__all__ = ["PATIENCE", "Heard", "Outgoing", "RemoteResult", "ServerSessions"]

PATIENCE: Final = 8
"""Parts of the heartbeat limit: one between pings, two until a broken connection is given up."""

_MAX_SESSIONS: Final = 512
_MAX_SEATS: Final = 4096
_MAX_BAD_RESULTS: Final = 3
_LATE: Final = -1
_SECONDS_BETWEEN_WARNINGS: Final = 10.0

_log = logging.getLogger(__name__)


def random_token() -> int:
    """A number that nobody can guess."""
    return secrets.randbits(63)


class Heard(Enum):
    """What a message has led to."""

    IN_SESSION = "it was said in a session, or has opened one"
    TURNED_AWAY = "it was understood, and to no avail"
    MALFORMED = "it was dropped"


@dataclass(slots=True)
class RemoteResult:
    """What one request to a client ended in.

    Attributes:
        client: its name.
        number: of the request, as it was submitted; None for a first result, for which
            nobody asked.
        observation: read-only arrays in the shape of the observation space.
        reward, terminated, truncated: numbers, arrays ``[num_envs]``, or dicts of either
            by agent.
        info, extra: as the env gave them; ``info["client_lost"]`` says why a client is gone.
        busy_ns: how long the env took, by the client's clock.
        sent_ns: when the env produced it, in ns since the epoch by the client's clock; 0 if
            nobody said.
        error: set instead of all that, if the env raised.
        is_reset: it is the first of an episode.
        is_loss: no result of the env's, but the mark that the client was lost.
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
    error: EnvRaised | None = None
    is_reset: bool = False
    is_loss: bool = False


class _NoRoom(Exception):
    """A client would take more than is left for all of them; it may try again later."""


class Outgoing(NamedTuple):
    """A message to be sent: whither, and its parts."""

    route: bytes
    parts: list[bytes]


@dataclass(slots=True)
class _Request:
    number: int
    wire_number: int
    parts: list[bytes]
    doing: str
    timeout: float | None
    deadline: float | None


class _Kind(NamedTuple):
    """What all clients of one server have in common, so that their results stack."""

    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    num_envs: int
    agents: tuple[str, ...]


@dataclass(slots=True)
class _Session:
    token: int
    nonce: int
    seat: _Seat
    route: bytes
    user: str | None
    kind: _Kind
    meta: EnvMeta
    results: ResultLayout
    actions: SpaceLayout
    free_actions: bool
    reads_extras: bool
    heard_at: float
    asked_at: float
    joined: bool = False
    unanswered_since: float | None = None
    unreachable_since: float | None = None
    last_number: int = 0
    bad_results: int = 0


class _Seen(NamedTuple):
    """An observation, and how to cut an episode short there."""

    results: ResultLayout
    observation: Any


@dataclass(slots=True)
class _Seat:
    """What outlives a client's sessions, by its name.

    Attributes:
        session: the current one.
        request: what the client owes.
        unreported: why an earlier session ended, until the next request is told.
        early: the first result of the current session, held back for as long.
        last: what the trainer saw of it last; None until it has joined once.
        num_bytes: reserved for its actions and results, as long as the seat is there.
    """

    name: str
    num_bytes: int = 0
    session: _Session | None = None
    request: _Request | None = None
    unreported: str | None = None
    early: RemoteResult | None = None
    last: _Seen | None = None


class ServerSessions:
    """All sessions of one env_server.

    Args:
        server_id: env_id of the server; its clients' envs are ``<server_id>/<name>``.
        heartbeat: seconds within which a dead client is found.
        step_timeout, reset_timeout: seconds after which a client that owes a step or a
            reset counts as lost; None for never.
        objection: why an env may not join, if there is a reason.
        new_token: makes session tokens.

    Attributes:
        clients: the env of each client that has joined (its first result has come).
        outbox: messages to be sent, oldest first; the sender takes them out.
        malformed: messages dropped because they were none.
        late: replies dropped because nothing asked for them any more.
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
        self.clients: dict[str, EnvMeta] = {}
        self.outbox: deque[Outgoing] = deque()
        self.malformed = 0
        self.late = 0
        self._server_id = server_id
        self._heartbeat = heartbeat
        self._step_timeout = step_timeout
        self._reset_timeout = reset_timeout
        self._objection_to = objection
        self._new_token = new_token
        self._reader: Reader[FromClient] = Reader(FromClient)
        self._writer = Writer()
        self._sessions: dict[int, _Session] = {}
        self._seats: dict[str, _Seat] = {}
        self._reserved = 0
        self._kind: _Kind | None = None
        self._results: list[RemoteResult] = []
        self._next_tick: float | None = None
        self._warned_at: dict[str, float] = {}
        self._dropped_extras: set[str] = set()
        timeouts = [t / 4 for t in (step_timeout, reset_timeout) if t is not None]
        self._tick_every = min(heartbeat / PATIENCE, *timeouts, heartbeat)
        self._handlers: dict[type, Callable[..., None]] = {
            Result: self._on_result,
            Failure: self._on_failure,
            Ping: self._on_ping,
            Pong: self._on_pong,
            Bye: self._on_bye,
        }

    # What arrives

    def receive(self, route: bytes, user: str | None, parts: Sequence[Part], now: float) -> Heard:
        """Take in one message; never raises for what it holds.

        Args:
            route: where to answer.
            user: who the connection belongs to, if that was proved.
            parts: header and frames.
            now: monotonic seconds.

        Returns:
            What it led to.
        """
        try:
            return self._receive(route, user, parts, now)
        except WireError as error:
            self._complain(str(error), now)
            return Heard.MALFORMED

    def _receive(self, route: bytes, user: str | None, parts: Sequence[Part], now: float) -> Heard:
        message, frames = self._reader.read(parts)
        if isinstance(message, Hello):
            return self._on_hello(message, len(parts[0]), route, user, now)
        session = self._session_of(message, route, user, now)
        if session is not None:
            self._handlers[type(message)](session, message, frames, now)
        return Heard.TURNED_AWAY if session is None else Heard.IN_SESSION

    def _session_of(
        self,
        message: Result | Failure | Ping | Pong | Bye,
        route: bytes,
        user: str | None,
        now: float,
    ) -> _Session | None:
        session = self._sessions.get(message.session)
        if session is None:
            if not isinstance(message, Bye):
                self._send(route, Gone(session=message.session, text="no such session"))
            return None
        if session.user != user:
            raise WireError(f"{user!r} spoke in the session of {session.user!r}")
        session.route = route
        session.heard_at = now
        session.unanswered_since = session.unreachable_since = None
        return session

    def _complain(self, text: str, now: float) -> None:
        self.malformed += 1
        self._warn("malformed", f"dropped a message ({self.malformed} so far): {text}", now)

    def _warn(self, kind: str, text: str, now: float) -> None:
        """Log `text`, unless something of its kind was logged a moment ago: strangers cause it."""
        last = self._warned_at.get(kind)
        if last is None or now - last >= _SECONDS_BETWEEN_WARNINGS:
            self._warned_at[kind] = now
            _log.warning("%s %s", self._server_id, in_one_line(text))

    # Coming and going

    def _on_hello(
        self, hello: Hello, size: int, route: bytes, user: str | None, now: float
    ) -> Heard:
        seat = self._seats.get(hello.name)
        current = seat.session if seat else None
        if current and current.nonce == hello.nonce and current.user == user:
            current.route, current.heard_at = route, now
            self._welcome(current)
            return Heard.IN_SESSION
        refusal = self._objection(hello, size, user, now)
        if refusal is None:
            try:
                # The trainer may have its own arithmetic raise; a client's bounds must not.
                with np.errstate(all="ignore"):
                    self._welcome(self._open(hello, route, user, now))
            except _NoRoom as error:
                refusal = ("full", str(error), True)
            except WireError as error:
                refusal = ("spaces", str(error), False)
            # Gymnasium, NumPy and pydantic have errors of their own for what nobody expected.
            except Exception as error:  # noqa: BLE001  # A stranger's fault is not the trainer's.
                refusal = ("spaces", f"{type(error).__name__}: {error}", False)
        if refusal is not None:
            code, text, retry = refusal
            text = in_one_line(text)
            self._warn(code, f"refused the client {hello.name!r}: {text}", now)
            self._send(route, Refusal(nonce=hello.nonce, code=code, text=text, retry=retry))
        return Heard.IN_SESSION if refusal is None else Heard.TURNED_AWAY

    def _objection(
        self, hello: Hello, size: int, user: str | None, now: float
    ) -> tuple[str, str, bool] | None:
        """Why `hello` may not come in: code, text, and whether to try again later."""
        if hello.version != VERSION:
            return "version", f"this server speaks version {VERSION}, not {hello.version}", False
        if size > MAX_HELLO_BYTES:
            return "spaces", f"a hello has {size} bytes; {MAX_HELLO_BYTES} are allowed", False
        if not hello.name.isprintable() or "/" in hello.name:
            return "name", "a client's name must be printable and without '/'", False
        self._give_way(hello, user)
        seat = self._seats.get(hello.name)
        if seat and seat.session:
            self._ping(seat.session, now)
            return "taken", f"a client named {hello.name!r} is here already", True
        if len(self._sessions) >= _MAX_SESSIONS:
            return "full", f"{len(self._sessions)} clients are here already", True
        return None

    def _give_way(self, hello: Hello, user: str | None) -> None:
        """End the session that `hello` follows, or that only waits to be given up."""
        seat = self._seats.get(hello.name)
        session = seat.session if seat else None
        if session is None or session.user != user:
            return
        if session.token == hello.previous:
            self._lose(session, "it started over")
        elif session.unreachable_since is not None:
            self._lose(session, "its connection broke and it came back as another")

    def _seat_for(self, name: str, num_bytes: int) -> _Seat:
        """The seat of a client that comes in, with what it needs reserved.

        Raises:
            _NoRoom: all seats, or all bytes, are taken by clients that are here.
        """
        seat = self._seats.get(name) or _Seat(name)
        more = num_bytes - seat.num_bytes
        away = [other for other in self._seats.values() if other.session is None]
        # The first to leave go first, and those last of whose loss the trainer hasn't heard yet.
        away.sort(key=lambda other: other.unreported is not None)
        for other in away:
            if self._has_room(name, more):
                break
            if other is not seat:
                self._forget(other)
        if not self._has_room(name, more):
            raise _NoRoom(
                f"a result and an action take {num_bytes} bytes, and the {len(self._sessions)} "
                f"clients that are here have reserved {self._reserved} of {MAX_BYTES_IN_ALL}"
            )
        self._seats[name] = seat
        self._reserved += more
        seat.num_bytes = num_bytes
        return seat

    def _has_room(self, name: str, more: int) -> bool:
        num_seats = len(self._seats) + (name not in self._seats)
        return num_seats <= _MAX_SEATS and self._reserved + more <= MAX_BYTES_IN_ALL

    def _forget(self, seat: _Seat) -> None:
        del self._seats[seat.name]
        self._reserved -= seat.num_bytes

    def _open(self, hello: Hello, route: bytes, user: str | None, now: float) -> _Session:
        observation_space = space_from(hello.observation_space)
        action_space = space_from(hello.action_space)
        kind = _Kind(
            describe(observation_space, "observation"),
            describe(action_space, "action"),
            hello.num_envs,
            tuple(hello.agents),
        )
        if self._kind is not None and kind != self._kind:
            raise WireError(
                "its spaces, num_envs or agents differ from those of this server's other "
                "clients; give each kind of env an env_server entry of its own"
            )
        for space in (observation_space, action_space) if hello.agents else ():
            if (
                not isinstance(space, gym.spaces.Dict)
                or [*cast("gym.spaces.Dict[Any]", space).spaces] != hello.agents
            ):
                raise WireError("the spaces of a multi-agent env must be Dicts by agent")
        meta = EnvMeta(
            env_id=f"{self._server_id}/{hello.name}",
            observation_space=observation_space,
            action_space=action_space,
            num_envs=hello.num_envs,
            agents=kind.agents,
            max_episode_steps=hello.max_episode_steps,
            autoreset=hello.autoreset,
        )
        if (objection := self._objection_to(meta)) is not None:
            raise WireError(objection)
        results = ResultLayout(observation_space, hello.num_envs, hello.agents)
        actions = SpaceLayout(action_space, "action")
        seat = self._seat_for(hello.name, results.num_bytes + actions.num_bytes)
        session = seat.session = _Session(
            token=self._new_token(),
            nonce=hello.nonce,
            seat=seat,
            route=route,
            user=user,
            kind=kind,
            meta=meta,
            results=results,
            actions=actions,
            free_actions=hello.free_actions,
            reads_extras=hello.reads_extras,
            heard_at=now,
            asked_at=now,
        )
        self._sessions[session.token] = session
        if self._next_tick is None:
            self._next_tick = now + self._tick_every
        return session

    def _welcome(self, session: _Session) -> None:
        self._send(
            session.route,
            Welcome(
                nonce=session.nonce,
                session=session.token,
                env_id=session.meta.env_id,
                heartbeat=self._heartbeat,
            ),
        )

    def _on_bye(self, session: _Session, message: Bye, frames: Sequence[Part], now: float) -> None:
        del frames, now
        self._lose(session, f"it left: {in_one_line(message.reason) or 'no reason given'}")

    def unreachable(self, route: bytes, now: float) -> None:
        """A message to `route` could not be sent: its connection is no more."""
        for session in self._sessions.values():
            if session.route == route and session.unreachable_since is None:
                session.unreachable_since = now

    def _dismiss(self, session: _Session, cause: str) -> None:
        self._send(session.route, Gone(session=session.token, text=cause))
        self._lose(session, cause)

    def _lose(self, session: _Session, cause: str) -> None:
        """End `session`; a request that waits for its client, or will, is told `cause`."""
        _log.info("%s lost the client %r: %s", self._server_id, session.seat.name, cause)
        seat = session.seat
        seat.session = None
        del self._sessions[session.token]
        self.clients.pop(seat.name, None)
        # Those that are away stand in the order in which they left.
        self._seats[seat.name] = self._seats.pop(seat.name)
        if seat.last is None:
            # It never joined, so nobody has heard of it.
            self._forget(seat)
        elif seat.request is not None:
            self._report_loss(seat, seat.last, seat.request.number, cause)
        elif seat.early is not None:
            seat.early = None
        elif session.joined and not self._drop_first(seat):
            seat.unreported = cause

    def _drop_first(self, seat: _Seat) -> bool:
        """Take back a first result that nobody has taken out; whether there was one."""
        kept = [r for r in self._results if r.client != seat.name or r.number is not None]
        was_there = len(kept) < len(self._results)
        self._results = kept
        return was_there

    def _report_loss(self, seat: _Seat, last: _Seen, number: int, cause: str) -> None:
        seat.unreported = seat.request = None
        outcome = last.results.cut_short(last.observation)
        info = {"client_lost": f"client {seat.name!r}: {cause}"}
        self._results.append(RemoteResult(seat.name, number, *outcome, info=info, is_loss=True))

    # Requests

    def dismiss(self, client: str, cause: str) -> None:
        """Send a client away whose first result was not taken in; it is told `cause`."""
        seat = self._seats[client]
        if seat.session is not None:
            self._dismiss(seat.session, cause)
            # There is nobody who would ask for it.
            seat.unreported = None

    def routes(self) -> set[bytes]:
        """Those over which clients have spoken last, each over one."""
        return {session.route for session in self._sessions.values()}

    def traits(self, client: str) -> ClientTraits:
        """What a client that is here makes of requests."""
        session = self._seats[client].session
        if session is None:
            raise UnknownEnv(f"no client named {client!r} is connected to {self._server_id}")
        return ClientTraits(session.free_actions, session.reads_extras)

    def check(self, client: str, action: Any, extras: Mapping[str, Any]) -> None:
        """Raises `BadAction` if `client` is here and can't be sent the step; nothing is sent."""
        if (session := self._session_at(client)) is not None:
            self._step_parts(session, action, extras)

    def check_reset(
        self, client: str, seed: int | list[int] | None, options: dict[str, Any] | None
    ) -> None:
        """Raises `ValueError` if `client` is here and can't be sent the reset; nothing is sent."""
        if (session := self._session_at(client)) is not None:
            self._reset_parts(session, seed, options)

    def _session_at(self, client: str) -> _Session | None:
        seat = self._seats.get(client)
        return None if seat is None else seat.session

    def submit(
        self, client: str, number: int, action: Any, extras: Mapping[str, Any], now: float
    ) -> bool:
        """Ask `client` to step.

        Args:
            client: a client that has joined once.
            number: comes back with the result; 0 or more.
            action: fits its action space, unless the client transforms actions.
            extras: what the policy attached beside; sent if the client reads it.
            now: monotonic seconds.

        Returns:
            Whether a result with `number` will come. False: the client is away and the
            trainer knows; what comes next is its first result once it is back.

        Raises:
            UnknownEnv: no client of that name ever joined, or it has been forgotten.
            EnvBusy: it owes a result.
            BadAction: the action doesn't fit, or the response can't travel; nothing was sent.
        """
        seat, last = self._free_seat(client)
        session = seat.session
        if seat.unreported is not None:
            self._report_loss(seat, last, number, seat.unreported)
            return True
        if seat.early is not None and session is not None:
            result, seat.early = seat.early, None
            result.number = number
            self._emit(session, result)
            return True
        if session is None or not session.joined:
            return False
        parts = self._step_parts(session, action, extras)
        session.last_number += 1
        self._ask(seat, session, number, parts, "step", self._step_timeout, now)
        return True

    def submit_reset(
        self,
        client: str,
        number: int,
        seed: int | list[int] | None,
        options: dict[str, Any] | None,
        now: float,
    ) -> bool:
        """Ask `client` to reset; a first result that hasn't been taken yet is dropped for it.

        Returns and raises as `submit`; `ValueError` for options that can't travel.
        """
        seat, _ = self._free_seat(client)
        session = seat.session
        parts = [] if session is None else self._reset_parts(session, seed, options)
        seat.unreported = seat.early = None
        self._drop_first(seat)
        if session is None:
            return False
        session.last_number += 1
        self._ask(seat, session, number, parts, "reset", self._reset_timeout, now)
        return True

    def _free_seat(self, client: str) -> tuple[_Seat, _Seen]:
        seat = self._seats.get(client)
        if seat is None or seat.last is None:
            raise UnknownEnv(
                f"no client named {client!r} has joined {self._server_id}; joined are "
                f"{', '.join(map(repr, self.clients)) or 'none'}"
            )
        if seat.request is not None:
            raise EnvBusy(
                f"{self._server_id}/{client} still owes the result of a {seat.request.doing}; "
                "collect it first"
            )
        return seat, seat.last

    def _step_parts(self, session: _Session, action: Any, extras: Mapping[str, Any]) -> list[bytes]:
        """The next request of a session, if it is this step."""
        step = Step(session=session.token, number=session.last_number + 1)
        packed = Packed([], step.texts)
        try:
            if session.free_actions:
                step.action = action
            else:
                session.actions.pack(action, packed)
            if extras and session.reads_extras:
                step.extras = self._portable_extras(extras)
            return self._writer.write(step, packed.frames)
        except (Misfit, Untransferable) as error:
            raise BadAction(
                f"response for {session.meta.env_id}: {error}; nothing was sent"
            ) from None

    def _reset_parts(
        self, session: _Session, seed: int | list[int] | None, options: dict[str, Any] | None
    ) -> list[bytes]:
        """The next request of a session, if it is this reset."""
        number = session.last_number + 1
        reset = Reset(session=session.token, number=number, seed=seed, options=options)
        try:
            return self._writer.write(reset)
        except Untransferable as error:
            raise ValueError(
                f"reset of {session.meta.env_id}: seed or options can't be sent: {error}"
            ) from None

    def _portable_extras(self, extras: Mapping[str, Any]) -> dict[str, Any]:
        lost: list[str] = []
        kept = portable(extras, lost)
        if new := sorted({*lost} - self._dropped_extras):
            self._dropped_extras.update(new)
            _log.warning(
                "%s: what the policy attached as %s can't travel to a client and is dropped",
                self._server_id, ", ".join(new),
            )  # fmt: skip
        return kept

    def _ask(
        self,
        seat: _Seat,
        session: _Session,
        number: int,
        parts: list[bytes],
        doing: str,
        timeout: float | None,
        now: float,
    ) -> None:
        deadline = None if timeout is None else now + timeout
        seat.request = _Request(number, session.last_number, parts, doing, timeout, deadline)
        session.bad_results = 0
        if session.joined:
            self.outbox.append(Outgoing(session.route, parts))

    # Replies

    def _on_result(
        self, session: _Session, message: Result, frames: Sequence[Part], now: float
    ) -> None:
        number = self._number_answered(session, message.number)
        if number == _LATE:
            self.late += 1
            return
        try:
            if nests_too_deep(message.info) or nests_too_deep(message.extra):
                raise WireError(f"an info is nested more than {MAX_NESTING} deep")
            header = (message.reward, message.terminated, message.truncated)
            outcome = session.results.unpack(frames, message.texts, header)
        except WireError as error:
            self._complain(str(error), now)
            session.bad_results += 1
            if session.bad_results >= _MAX_BAD_RESULTS:
                self._dismiss(
                    session, f"its results don't fit what it announced: {in_one_line(str(error))}"
                )
            return
        request = session.seat.request
        result = RemoteResult(
            session.seat.name, number, *outcome, message.info, message.extra, message.busy_ns,
            message.sent_ns,
            is_reset=number is None or (request is not None and request.doing == "reset"),
        )  # fmt: skip
        if number is None:
            self._join(session, result)
        else:
            session.seat.request = None
            self._emit(session, result)

    def _number_answered(self, session: _Session, wire_number: int) -> int | None:
        """Of the request that `wire_number` stands for; None if it is the first result's."""
        request = session.seat.request
        if not session.joined:
            return None if wire_number == 0 else _LATE
        return request.number if request and request.wire_number == wire_number else _LATE

    def _join(self, session: _Session, result: RemoteResult) -> None:
        if self._kind is not None and session.kind != self._kind:
            # Another client of another kind joined while this one was resetting.
            self._dismiss(session, "its spaces differ from those of the other clients")
            return
        seat = session.seat
        self._kind = session.kind
        session.joined = True
        self.clients[seat.name] = session.meta
        if seat.request is not None:
            # A reset was asked for meanwhile; its result takes this one's place.
            self.outbox.append(Outgoing(session.route, seat.request.parts))
        elif seat.unreported is not None:
            seat.early = result
        else:
            self._emit(session, result)

    def _emit(self, session: _Session, result: RemoteResult) -> None:
        session.seat.last = _Seen(session.results, result.observation)
        self._results.append(result)

    def _on_failure(
        self, session: _Session, message: Failure, frames: Sequence[Part], now: float
    ) -> None:
        del frames, now
        number = self._number_answered(session, message.number)
        kind, text = in_one_line(message.exception_type), in_one_line(message.text)
        if number is None:
            self._lose(session, f"its first reset raised {kind}: {text}")
            return
        seat, request = session.seat, session.seat.request
        if number == _LATE or request is None:
            self.late += 1
            return
        if message.exception_type == STALE_REQUEST:
            # Not so: nothing newer was ever asked. The two no longer mean the same by a number.
            self._dismiss(session, f"it lost count: {text}")
            return
        seat.request = None
        error = EnvRaised(
            f"{session.meta.env_id} raised {kind} in {request.doing}: "
            f"{text}; it can be reset and used again",
            env_id=session.meta.env_id,
            exception_type=kind,
            exception_text=text,
            traceback_text=in_lines(message.traceback),
        )
        self._results.append(RemoteResult(seat.name, request.number, error=error))

    def take(self) -> list[RemoteResult]:
        """All results that are ready, oldest first; each is handed out once."""
        results, self._results = self._results, []
        return results

    @property
    def has_results(self) -> bool:
        """Whether `take` would return any."""
        return bool(self._results)

    # Signs of life

    def _on_ping(
        self, session: _Session, message: Ping, frames: Sequence[Part], now: float
    ) -> None:
        del frames, now
        self._send(session.route, Pong(session=session.token, number=message.number))
        # A client pings after its connection broke: what was under way is in doubt.
        self._repeat(session)

    def _on_pong(
        self, session: _Session, message: Pong, frames: Sequence[Part], now: float
    ) -> None:
        del frames, now
        request = session.seat.request
        # A client answers a ping only when it has done all that came before it. So what it
        # still owes of that time was lost, on the way there or back.
        if message.number == (request.wire_number if request and session.joined else 0):
            self._repeat(session)

    def _repeat(self, session: _Session) -> None:
        if not session.joined:
            self._welcome(session)
        elif session.seat.request is not None:
            self.outbox.append(Outgoing(session.route, session.seat.request.parts))

    def _ping(self, session: _Session, now: float) -> None:
        session.asked_at = now
        if session.unanswered_since is None:
            session.unanswered_since = now
        request = session.seat.request if session.joined else None
        number = request.wire_number if request else 0
        self._send(session.route, Ping(session=session.token, number=number))

    def deadline(self) -> float | None:
        """When `tick` is due (monotonic seconds); None if never."""
        return self._next_tick

    def tick(self, now: float) -> None:
        """Ping the silent, give up the gone. Call it after all that came was received."""
        if self._next_tick is None or now < self._next_tick:
            return
        for session in list(self._sessions.values()):
            cause = self._end_of_patience(session, now)
            if cause is not None:
                self._dismiss(session, cause)
            elif now - max(session.heard_at, session.asked_at) >= self._heartbeat / PATIENCE:
                self._ping(session, now)
        self._next_tick = now + self._tick_every if self._sessions else None

    def _end_of_patience(self, session: _Session, now: float) -> str | None:
        request = session.seat.request
        broken, silent = session.unreachable_since, session.unanswered_since
        if broken is not None and now - broken >= 2 * self._heartbeat / PATIENCE:
            return "its connection broke and it did not come back"
        if request is not None and request.deadline is not None and now >= request.deadline:
            return f"no result of a {request.doing} within {request.timeout} s"
        # A client that is busy can't answer; its connection tells whether it lives.
        idle = request is None and session.joined
        if idle and silent is not None and now - silent >= self._heartbeat:
            return f"no sign of life for {now - session.heard_at:.1f} s"
        return None

    def close(self, reason: str) -> None:
        """Tell every client that the server ends; nothing is reported as lost."""
        for session in self._sessions.values():
            self._send(session.route, Bye(session=session.token, reason=reason))
        self._sessions.clear()
        self._seats.clear()
        self._reserved = 0
        self.clients.clear()
        self._results.clear()
        self._next_tick = None

    def _send(self, route: bytes, message: Any) -> None:
        self.outbox.append(Outgoing(route, self._writer.write(message)))
