"""`ServerSessions`: the trainer's end of env_server, without I/O.

Rule: an env_server has places, and a connection of a client that was let in is a session at one of
them. It begins with a hello and ends with the connection, a goodbye or the first message that
breaks the rules. Nothing is sent twice, and nothing is sent unasked. Every request of a session
ends in its result, in its error, or with the session. Messages come in, and messages are queued;
what happens at a place goes to its host. Deliberately left out: sockets, keys, time limits, and
what the end of a session means.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, TypeAlias, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.errors import BadAction
from rlightning_aio.outcomes import BLAMES
from rlightning_aio.protocol.columns import Misfit
from rlightning_aio.protocol.error_text import LOG, ErrorText, in_lines, in_one_line
from rlightning_aio.protocol.net.payload import Packed, ResultLayout, SpaceLayout
from rlightning_aio.protocol.net.space_description import describe, space_from
from rlightning_aio.protocol.net.wire import (
    DEFAULT_HEARTBEAT,
    HARDWARE_HEARTBEAT,
    MAX_HELLO_BYTES,
    VERSION,
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
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from rlightning_aio.protocol.net.payload import ResultFields

_MAX_REFUSED: Final = 8
"""Refusals that an error repeats."""


class OutgoingMessage(NamedTuple):
    """A message and the route of the connection that it is for."""

    route: bytes
    parts: list[bytes]


Answer: TypeAlias = "tuple[ResultFields, ClientResult] | ErrorText"
"""The result of a request, as values in the shape of the spaces and as the client's message; or the
error."""


class PlaceEvents(Protocol):
    """What learns of the events at a place."""

    def on_taken(self, announced: Announcement) -> None:
        """Note that a client has taken the place; it gets nothing until it is asked."""
        ...

    def on_answer(self, answer: Answer) -> None:
        """Note the result or the error of the request in flight."""
        ...

    def on_lost(self, cause: str, *, in_order: bool) -> None:
        """Note that the client is gone; `in_order`: it said goodbye."""
        ...

    def waits_since(self) -> float | None:
        """Return when the request that waits for a client was sent; None if there is none."""
        ...


@dataclass(slots=True, eq=False)
class ClientPlace:
    """One env of an env_server, which one client at a time may provide.

    Attributes:
        env_id: of the env.
        events: of its host.
        name: of the only client that may take it; empty for any.
        last: name of the client that had it last.
        session: of the client that is there.
    """

    env_id: str
    events: PlaceEvents
    name: str = ""
    last: str = ""
    session: ServerSession | None = None


@dataclass(slots=True, eq=False)
class ServerSession:
    """One connection of a client that was let in.

    Attributes:
        name: of the client.
        route: address of the connection.
        announced: contents of its hello.
        place: that it has taken.
        last_number: number of the last request.
        is_asked: that request is in flight.
    """

    name: str
    route: bytes
    announced: Announcement
    place: ClientPlace
    last_number: int = 0
    is_asked: bool = False


class ServerSessions:
    """All sessions of one env_server.

    Args:
        server_id: id of the server.
        places: of the server, in order.
        num_envs: sub-environments of each client's env.
        heartbeat: seconds that clients are told; None: 5, and 1 for those that are hardware.
        objection: returns the trainer's reason to refuse an env, or None.

    Attributes:
        outbox: messages that wait to be sent, oldest first; the sender removes them.
        refused: why clients were refused for good, by name; only the last ones, and none that has
            been let in since.
    """

    def __init__(
        self,
        server_id: str,
        places: Sequence[ClientPlace],
        *,
        num_envs: int = 1,
        heartbeat: float | None = None,
        objection: Callable[[EnvMeta], str | None] = lambda _: None,
    ) -> None:
        self.outbox: deque[OutgoingMessage] = deque()
        self.refused: dict[str, str] = {}
        self._server_id = server_id
        self._places = places
        self._num_envs = num_envs
        self._heartbeat = heartbeat
        self._objection = objection
        self._reader: Reader[FromClient] = Reader(FromClient)
        self._writer = Writer()
        self._last_warning = ""
        self._dropped_extras: set[str] = set()
        # Of the first client, which decides for all places.
        self._kind: ClientKind | None = None
        self._by_route: dict[bytes, ServerSession] = {}

    def clients(self) -> dict[str, str]:
        """Return the names of the clients that are there, by the ids of their envs."""
        return {p.env_id: p.session.name for p in self._places if p.session is not None}

    def holds(self, route: bytes) -> bool:
        """Return True if the connection `route` has a session."""
        return route in self._by_route

    # -- requests -------------------------------------------------------------------

    def check_step(self, place: ClientPlace, action: Any, extras: Mapping[str, Any]) -> None:
        """Raise `BadAction` if a client is there and the step can't be sent to it."""
        if place.session is not None:
            self._step_parts(place.session, action, extras)

    def check_reset(
        self, env_id: str, seed: int | list[int] | None, options: dict[str, Any] | None
    ) -> None:
        """Raise `ValueError` if the reset can't be sent to any client."""
        try:
            self._writer.write(Reset(number=1, seed=seed, options=options))
        except Untransferable as error:
            raise ValueError(f"reset of {env_id}: seed or options can't be sent: {error}") from None

    def step(self, place: ClientPlace, action: Any, extras: Mapping[str, Any]) -> None:
        """Request a step of the client that is there.

        Args:
            place: of the client, which has answered its last request.
            action: fits the client's action space, unless the client transforms actions.
            extras: columns that the policy attached; sent if the client reads them.

        Raises:
            BadAction: the action doesn't fit, or the response can't be sent.
        """
        session = _session_at(place)
        self._send(session, self._step_parts(session, action, extras))

    def reset(
        self, place: ClientPlace, seed: int | list[int] | None, options: dict[str, Any] | None
    ) -> None:
        """Request a reset of the client that is there."""
        session = _session_at(place)
        number = session.last_number + 1
        self._send(session, self._writer.write(Reset(number=number, seed=seed, options=options)))

    def _step_parts(
        self, session: ServerSession, action: Any, extras: Mapping[str, Any]
    ) -> list[bytes]:
        step = Step(number=session.last_number + 1)
        packed = Packed([], step.texts)
        client = session.announced
        try:
            if client.hello.free_actions:
                step.action = action
            else:
                client.actions.pack(action, packed)
            if extras and client.hello.reads_extras:
                step.extras = self._portable_extras(extras)
            return self._writer.write(step, packed.frames)
        except (Misfit, Untransferable) as error:
            raise BadAction(
                f"response for {session.place.env_id}: {error}; nothing was sent"
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

    def _send(self, session: ServerSession, parts: list[bytes]) -> None:
        assert not session.is_asked
        session.last_number += 1
        session.is_asked = True
        self.outbox.append(OutgoingMessage(session.route, parts))

    # -- messages -------------------------------------------------------------------

    def receive(
        self, route: bytes, parts: Sequence[Part], allowed: Collection[str] | None = None
    ) -> None:
        """Read one message and answer it. No content makes it raise.

        Args:
            route: of the connection, for answers.
            parts: header and frames.
            allowed: names that the key of the connection was made for; None: any.
        """
        session = self._by_route.get(route)
        try:
            message, frames = self._reader.read(parts)
            if session is not None:
                self._handle(session, message, frames)
            elif isinstance(message, ClientHello):
                self._on_hello(message, len(parts[0]), route, allowed)
            # A client may have sent other messages before it read that its session is over.
        except WireError as error:
            text = in_one_line(str(error))
            if session is None:
                self._warn(f"dropped a message: {text}")
            else:
                self._drop(session, f"a message of it is malformed: {text}")

    def _warn(self, text: str) -> None:
        """Log a warning, unless it repeats the last one."""
        if text != self._last_warning:
            self._last_warning = text
            LOG.warning("%s: %s", self._server_id, text)

    def _on_hello(
        self, hello: ClientHello, size: int, route: bytes, allowed: Collection[str] | None
    ) -> None:
        """Answer a hello whose header has `size` bytes."""
        try:
            self._let_in(hello, size, route, allowed)
        except Rejection as error:
            text = in_one_line(str(error))
            self._warn(in_one_line(f"refused the client {hello.name!r}: {text}"))
            if not error.retry:
                name = in_one_line(hello.name)
                self.refused.pop(name, None)
                self.refused[name] = text
                if len(self.refused) > _MAX_REFUSED:
                    del self.refused[next(iter(self.refused))]
            self._post(route, Refusal(text=text, retry=error.retry))

    def _let_in(
        self, hello: ClientHello, size: int, route: bytes, allowed: Collection[str] | None
    ) -> None:
        if allowed is not None and hello.name not in allowed:
            names = ", ".join(map(repr, sorted(allowed)))
            raise Rejection(f"its key was made for {names}, not for {hello.name!r}")
        listed = [place.name for place in self._places if place.name]
        if listed and hello.name not in listed:
            names = ", ".join(listed)
            raise Rejection(
                f"the places of {self._server_id} are for {names}, as env_kwargs.clients says"
            )
        # Of a client that is refused for good, whether there is room doesn't matter.
        found = self._announced(hello, size)
        if any(session.name == hello.name for session in self._by_route.values()):
            raise Rejection(f"a client named {hello.name!r} is here already", retry=True)
        place = self._place_for(hello.name)
        if place is None:
            count = len(self._places)
            taken = "the only place is taken" if count == 1 else f"all {count} places are taken"
            raise Rejection(f"{taken}; for more, set env_kwargs.clients of the entry", retry=True)
        self._kind = found.kind
        self.refused.pop(hello.name, None)
        place.last = hello.name
        place.session = self._by_route[route] = ServerSession(hello.name, route, found, place)
        heartbeat = self._heartbeat
        if heartbeat is None:
            heartbeat = HARDWARE_HEARTBEAT if hello.hardware else DEFAULT_HEARTBEAT
        self._post(route, Welcome(env_id=place.env_id, heartbeat=heartbeat))
        LOG.info("%s: the client %r has taken %s", self._server_id, hello.name, place.env_id)
        place.events.on_taken(found)

    def _announced(self, hello: ClientHello, size: int) -> Announcement:
        """Return the contents of a hello whose header has `size` bytes.

        Raises:
            Rejection: it is invalid, or does not fit the other clients or the trainer.
        """
        if hello.version != VERSION:
            raise Rejection(f"this server speaks version {VERSION}, not {hello.version}")
        if size > MAX_HELLO_BYTES:
            raise Rejection(f"a hello has {size} bytes; {MAX_HELLO_BYTES} are allowed")
        if not hello.name.isprintable() or "/" in hello.name:
            raise Rejection("a client's name must be printable and without '/'")
        try:
            # The trainer may let its own arithmetic raise; a client's bounds must not.
            with np.errstate(all="ignore"):
                return _announcement(hello, self._kind, self._num_envs, self._objection)
        except WireError as error:
            raise Rejection(str(error)) from None
        # Gymnasium, NumPy and pydantic raise their own errors for unexpected inputs.
        except Exception as error:  # noqa: BLE001  # A peer's mistake must not end the trainer.
            raise Rejection(f"{type(error).__name__}: {error}") from None

    def _place_for(self, name: str) -> ClientPlace | None:
        """Return the empty place that a client gets; None if there is none.

        It is the one that has its name, or that it had last; else where a request has waited
        longest; else the first.
        """
        empty = [place for place in self._places if place.session is None]
        empty = [place for place in empty if place.name in {"", name}]
        for place in empty:
            if name in {place.name, place.last}:
                return place
        waiting = [(since, k) for k, p in enumerate(empty) if (since := p.events.waits_since())]
        if waiting:
            return empty[min(waiting)[1]]
        return empty[0] if empty else None

    def _handle(self, session: ServerSession, message: FromClient, frames: Sequence[Part]) -> None:
        """Read a message of a session.

        Raises:
            WireError: it breaks the rules.
        """
        if isinstance(message, Bye):
            cause = f"it left: {in_one_line(message.reason) or 'no reason given'}"
            self._end(session, cause, in_order=True)
            return
        if isinstance(message, ClientHello):
            raise WireError("a second hello")
        if message.number != session.last_number or not session.is_asked:
            raise WireError(f"an answer to request {message.number}, which is not in flight")
        if isinstance(message, ClientResult):
            header = (message.reward, message.terminated, message.truncated)
            answer = session.announced.results.unpack(frames, message.texts, header), message
        else:
            answer = ErrorText(
                in_one_line(message.exception_type),
                in_one_line(message.text),
                in_lines(message.traceback),
                message.blame if message.blame in BLAMES else "",
            )
        session.is_asked = False
        session.place.events.on_answer(answer)

    def _post(self, route: bytes, message: Welcome | Refusal | Bye) -> None:
        self.outbox.append(OutgoingMessage(route, self._writer.write(message)))

    # -- ends of sessions -----------------------------------------------------------

    def disconnected(self, route: bytes) -> None:
        """Record that a connection is gone, after all of its messages have been received."""
        if (session := self._by_route.get(route)) is not None:
            self._end(session, "its connection broke")

    def drop(self, place: ClientPlace, cause: str) -> None:
        """Send the client at a place away, with the reason."""
        if place.session is not None:
            self._drop(place.session, cause)

    def close(self, reason: str) -> None:
        """End all sessions and send every client the reason. No place hears of that."""
        for route, session in self._by_route.items():
            session.place.session = None
            self._post(route, Bye(reason=reason))
        self._by_route.clear()

    def _drop(self, session: ServerSession, cause: str) -> None:
        """End a session and send its client the reason."""
        self._post(session.route, Bye(reason=cause))
        self._end(session, cause)

    def _end(self, session: ServerSession, cause: str, *, in_order: bool = False) -> None:
        """End a session."""
        level = logging.INFO if in_order else logging.WARNING
        LOG.log(level, "%s: lost the client %r: %s", self._server_id, session.name, cause)
        del self._by_route[session.route]
        session.place.session = None
        session.place.events.on_lost(f"client {session.name!r}: {cause}", in_order=in_order)


def _session_at(place: ClientPlace) -> ServerSession:
    assert place.session is not None
    return place.session


# -- what a client announces. Whatever a hello contains, reading it costs only its description, and
# ends in an `Announcement` or a `Rejection` with the reason.


class Rejection(Exception):
    """A reason to refuse a client; `retry` if the same hello may succeed later."""

    def __init__(self, text: str, *, retry: bool = False) -> None:
        super().__init__(text)
        self.retry = retry


class ClientKind(NamedTuple):
    """Properties that all clients of one server share, so that their results stack."""

    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    agents: tuple[str, ...]


class Announcement(NamedTuple):
    """The contents of a valid hello, and the layouts that follow from it."""

    hello: ClientHello
    kind: ClientKind
    meta: EnvMeta
    results: ResultLayout
    actions: SpaceLayout


def _announcement(
    hello: ClientHello,
    known: ClientKind | None,
    num_envs: int,
    objection: Callable[[EnvMeta], str | None],
) -> Announcement:
    observation_space = space_from(hello.observation_space)
    action_space = space_from(hello.action_space)
    kind = ClientKind(
        describe(observation_space, "observation"),
        describe(action_space, "action"),
        tuple(hello.agents),
    )
    if hello.num_envs != num_envs:
        raise WireError(
            f"its env has {hello.num_envs} sub-environments, and num_envs of the entry is "
            f"{num_envs}"
        )
    if known is not None and kind != known:
        raise WireError(
            "its spaces or agents differ from those of this server's first client; give each "
            "kind of env an env_server entry of its own"
        )
    if hello.agents:
        _check_agents(hello.agents, observation_space, action_space)
    meta = EnvMeta(
        env_id=hello.name,
        observation_space=observation_space,
        action_space=action_space,
        num_envs=hello.num_envs,
        agents=kind.agents,
        max_episode_steps=hello.max_episode_steps,
        autoreset=hello.autoreset,
    )
    if (reason := objection(meta)) is not None:
        raise WireError(reason)
    return Announcement(
        hello,
        kind,
        meta,
        ResultLayout(observation_space, hello.num_envs, hello.agents, hello.compression),
        SpaceLayout(action_space, "action"),
    )


def _check_agents(agents: list[str], *spaces: gym.Space[Any]) -> None:
    for space in spaces:
        if (
            not isinstance(space, gym.spaces.Dict)
            or [*cast("gym.spaces.Dict[Any]", space).spaces] != agents
        ):
            raise WireError("the spaces of a multi-agent env must be Dicts by agent")
