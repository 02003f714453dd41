"""`Admission`: which clients an env_server admits.

Rule: whatever a hello contains, it is answered by a welcome or by a refusal with the reason, and
costs only its description. Memory for results and actions is reserved here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.protocol.net.client_registry import NoRoom
from rlightning_aio.protocol.net.payload import ResultLayout, SpaceLayout
from rlightning_aio.protocol.net.server_records import (
    Announcement,
    ClientKind,
    MessageEffect,
    Session,
)
from rlightning_aio.protocol.net.space_description import describe, space_from
from rlightning_aio.protocol.net.texts import in_one_line
from rlightning_aio.protocol.net.wire import MAX_HELLO_BYTES, VERSION, Refusal, WireError
from rlightning_aio.types import ClientTraits, EnvMeta

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.protocol.net.client_registry import ClientRegistry
    from rlightning_aio.protocol.net.limited_log import LimitedLog
    from rlightning_aio.protocol.net.outbox import Outbox
    from rlightning_aio.protocol.net.session_monitor import SessionMonitor
    from rlightning_aio.protocol.net.wire import ClientHello

__all__ = ["Admission", "Peer"]

_MAX_SESSIONS: Final = 512


class Peer(NamedTuple):
    """The other end of a connection: its route, and the name of its key (None without keys)."""

    route: bytes
    user: str | None


class _Reason(NamedTuple):
    """A reason to refuse a client; `retry` if the same hello may succeed later."""

    code: str
    text: str
    retry: bool


class Admission:
    """Answers hellos and opens sessions.

    Args:
        server_id: env_id of the server; its clients' envs are ``<server_id>/<name>``.
        registry, monitor, outbox, log: of the server.
        objection: returns the trainer's reason to refuse an env, or None.
        new_token: makes session tokens.
    """

    def __init__(
        self,
        server_id: str,
        registry: ClientRegistry,
        monitor: SessionMonitor,
        outbox: Outbox,
        log: LimitedLog,
        *,
        objection: Callable[[EnvMeta], str | None],
        new_token: Callable[[], int],
    ) -> None:
        self._server_id = server_id
        self._registry = registry
        self._monitor = monitor
        self._outbox = outbox
        self._log = log
        self._objection_to = objection
        self._new_token = new_token

    def on_hello(self, hello: ClientHello, size: int, peer: Peer, now: float) -> MessageEffect:
        """Answer a hello whose header has `size` bytes."""
        current = self._registry.session_named(hello.name)
        if current and current.nonce == hello.nonce and current.user == peer.user:
            current.route, current.received_at = peer.route, now
            self._monitor.welcome(current)
            return MessageEffect.IN_SESSION
        reason = self._reason_to_refuse(hello, size, peer, now) or self._admit(hello, peer, now)
        if reason is None:
            return MessageEffect.IN_SESSION
        text = in_one_line(reason.text)
        line = in_one_line(f"refused the client {hello.name!r}: {text}")
        self._log.warn(reason.code, line, now)
        refusal = Refusal(nonce=hello.nonce, code=reason.code, text=text, retry=reason.retry)
        self._outbox.post(peer.route, refusal)
        return MessageEffect.TURNED_AWAY

    def _admit(self, hello: ClientHello, peer: Peer, now: float) -> _Reason | None:
        """Open a session for `hello`, or return the reason why that is impossible."""
        try:
            # The trainer may let its own arithmetic raise; a client's bounds must not.
            with np.errstate(all="ignore"):
                self._monitor.welcome(self._open(hello, peer, now))
        except NoRoom as error:
            return _Reason("full", str(error), retry=True)
        except WireError as error:
            return _Reason("spaces", str(error), retry=False)
        # Gymnasium, NumPy and pydantic raise their own errors for unexpected inputs.
        except Exception as error:  # noqa: BLE001  # A peer's mistake must not end the trainer.
            return _Reason("spaces", f"{type(error).__name__}: {error}", retry=False)
        return None

    def _reason_to_refuse(
        self, hello: ClientHello, size: int, peer: Peer, now: float
    ) -> _Reason | None:
        """Return a reason that can be found without looking at the announced spaces."""
        if hello.version != VERSION:
            text = f"this server speaks version {VERSION}, not {hello.version}"
            return _Reason("version", text, retry=False)
        if size > MAX_HELLO_BYTES:
            text = f"a hello has {size} bytes; {MAX_HELLO_BYTES} are allowed"
            return _Reason("spaces", text, retry=False)
        if not hello.name.isprintable() or "/" in hello.name:
            text = "a client's name must be printable and without '/'"
            return _Reason("name", text, retry=False)
        self._end_predecessor(hello, peer.user)
        session = self._registry.session_named(hello.name)
        if session is not None:
            self._monitor.ping(session, now)
            text = f"a client named {hello.name!r} is here already"
            return _Reason("taken", text, retry=True)
        if len(self._registry.sessions) >= _MAX_SESSIONS:
            text = f"{len(self._registry.sessions)} clients are here already"
            return _Reason("full", text, retry=True)
        return None

    def _end_predecessor(self, hello: ClientHello, user: str | None) -> None:
        """End the session that `hello` names as its previous one, or that is unreachable."""
        session = self._registry.session_named(hello.name)
        if session is None or session.user != user:
            return
        if session.token == hello.previous:
            self._registry.lose(session, "it started over")
        elif session.unreachable_since is not None:
            cause = "its connection broke and it came back as another"
            self._registry.lose(session, cause)

    def _open(self, hello: ClientHello, peer: Peer, now: float) -> Session:
        announced = self._announcement(hello)
        record = self._registry.reserve(hello.name, announced.num_bytes)
        session = record.session = Session(
            self._new_token(), hello.nonce, record, announced, peer.route, peer.user, now, now
        )
        self._registry.sessions[session.token] = session
        self._monitor.start(now)
        return session

    def _announcement(self, hello: ClientHello) -> Announcement:
        """Check the spaces of `hello` and lay out results and actions.

        Raises:
            WireError: they are invalid, or do not fit the other clients or the trainer.
        """
        observation_space = space_from(hello.observation_space)
        action_space = space_from(hello.action_space)
        kind = ClientKind(
            describe(observation_space, "observation"),
            describe(action_space, "action"),
            hello.num_envs,
            tuple(hello.agents),
        )
        if self._registry.kind is not None and kind != self._registry.kind:
            raise WireError(
                "its spaces, num_envs or agents differ from those of this server's other "
                "clients; give each kind of env an env_server entry of its own"
            )
        if hello.agents:
            _check_agents(hello.agents, observation_space, action_space)
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
        return Announcement(
            kind,
            meta,
            ClientTraits(hello.free_actions, hello.reads_extras),
            ResultLayout(observation_space, hello.num_envs, hello.agents),
            SpaceLayout(action_space, "action"),
        )


def _check_agents(agents: list[str], *spaces: gym.Space[Any]) -> None:
    for space in spaces:
        if (
            not isinstance(space, gym.spaces.Dict)
            or [*cast("gym.spaces.Dict[Any]", space).spaces] != agents
        ):
            raise WireError("the spaces of a multi-agent env must be Dicts by agent")
