"""Data of the trainer's end of env_server: clients, their sessions, requests and results.

Rule: a `Session` ends when its client is lost or starts over; a `ClientRecord` outlives the
sessions of one client name. Deliberately left out: what changes these records, see
`client_registry`, `admission`, `client_requests` and `server_session`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rlightning_aio.protocol.error_text import ErrorText
    from rlightning_aio.protocol.net.payload import ResultLayout, SpaceLayout
    from rlightning_aio.types import ClientTraits, EnvMeta

__all__ = [
    "Announcement",
    "ClientKind",
    "ClientRecord",
    "LastObservation",
    "MessageEffect",
    "PendingRequest",
    "RemoteResult",
    "Session",
]


class MessageEffect(Enum):
    """The effect of a message that the server received."""

    IN_SESSION = "it belongs to a session, or opened one"
    TURNED_AWAY = "it was understood and refused"
    MALFORMED = "it was dropped"


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


@dataclass(slots=True)
class PendingRequest:
    """A request that a client has not answered.

    Attributes:
        number: as the trainer submitted it; wire_number: its number within the session.
        parts: the message, for repetitions.
        operation: ``step`` or ``reset``.
        timeout: seconds allowed; deadline: when they end (monotonic seconds).
    """

    number: int
    wire_number: int
    parts: list[bytes]
    operation: str
    timeout: float | None
    deadline: float | None


class ClientKind(NamedTuple):
    """Properties that all clients of one server share, so that their results stack."""

    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    num_envs: int
    agents: tuple[str, ...]


class Announcement(NamedTuple):
    """The contents of a valid hello, and the layouts that follow from it."""

    kind: ClientKind
    meta: EnvMeta
    traits: ClientTraits
    results: ResultLayout
    actions: SpaceLayout

    @property
    def num_bytes(self) -> int:
        """Size of one result and one action."""
        return self.results.num_bytes + self.actions.num_bytes


class LastObservation(NamedTuple):
    """The observation that the trainer received last, and the layout to mark a loss with it."""

    results: ResultLayout
    observation: Any


@dataclass(slots=True, eq=False)
class Session:
    """One session of a client.

    Attributes:
        token: number that the client puts into its messages.
        nonce: number of the hello that opened the session.
        record: of the client.
        announced: contents of that hello.
        route: address of the client's connection.
        user: name of the client's key; None without keys.
        received_at, pinged_at: times of the last message and the last ping (monotonic seconds).
        joined: the first result has arrived.
        unanswered_since: time of the first ping since the last message.
        unreachable_since: time of the first message that found no connection.
        last_number: wire number of the last request.
        num_malformed: malformed answers to the current request.
    """

    token: int
    nonce: int
    record: ClientRecord
    announced: Announcement
    route: bytes
    user: str | None
    received_at: float
    pinged_at: float
    joined: bool = False
    unanswered_since: float | None = None
    unreachable_since: float | None = None
    last_number: int = 0
    num_malformed: int = 0

    @property
    def request(self) -> PendingRequest | None:
        """The request that the client has received and not answered."""
        return self.record.request if self.joined else None


@dataclass(slots=True)
class ClientRecord:
    """State that outlives the sessions of a client, by its name.

    Attributes:
        session: the current session.
        request: the request that the client must answer.
        unreported: reason why an earlier session ended, until the next request reports it.
        early: first result of the current session, kept back for as long.
        last: the trainer's last observation; None until the client has joined once.
        num_bytes: memory reserved for the client's actions and results.
    """

    name: str
    num_bytes: int = 0
    session: Session | None = None
    request: PendingRequest | None = None
    unreported: str | None = None
    early: RemoteResult | None = None
    last: LastObservation | None = None
