"""`ClientSession`: a client's end of env_server, without I/O.

Rule: a request is executed at most once. A repeated request gets the earlier reply again, an older
one is refused. Messages and changes of the connection come in, messages are queued, and time is an
argument. Deliberately left out: sockets, keys, and the env itself.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, cast

from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.net.limited_log import LOG, LimitedLog
from rlightning_aio.protocol.net.payload import Packed, ResultFields, ResultLayout, SpaceLayout
from rlightning_aio.protocol.net.space_description import describe
from rlightning_aio.protocol.net.texts import in_one_line
from rlightning_aio.protocol.net.wire import (
    PINGS_PER_HEARTBEAT,
    STALE_REQUEST,
    VERSION,
    Bye,
    ClientHello,
    ClientResult,
    Failure,
    FromServer,
    Gone,
    Part,
    Ping,
    Pong,
    Reader,
    Refusal,
    Reset,
    Step,
    Untransferable,
    Welcome,
    WireError,
    Writer,
    portable,
    random_token,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import gymnasium as gym

    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet

__all__ = ["ClientSession", "Ended", "Phase", "Refused", "ResetRequest", "StepRequest"]

_SECONDS_BETWEEN_HELLOS: Final = (0.5, 8.0)
"""The first pause, and the longest; each refusal doubles it."""

_MAX_TEXT: Final = 50_000
_LATEST_NS: Final = 2**63 - 1


class Phase(Enum):
    """State of a client's connection to its server."""

    AWAY = "not connected"
    GREETING = "asking to be let in"
    RESUMING = "reconnected, asking whether the session continues"
    SERVING = "serving"


@dataclass(frozen=True, slots=True)
class StepRequest:
    """Step the env, then call `ClientSession.finish` or `ClientSession.fail`."""

    number: int
    action: Any
    extras: dict[str, Any]


@dataclass(frozen=True, slots=True)
class ResetRequest:
    """Reset the env, then call `ClientSession.finish` or `ClientSession.fail`."""

    number: int
    seed: int | list[int] | None = None
    options: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Ended:
    """The session has ended, and with it the trainer's control of the env; another may follow."""

    cause: str


@dataclass(frozen=True, slots=True)
class Refused:
    """The server will never admit this client."""

    code: str
    text: str


Event = StepRequest | ResetRequest | Ended | Refused


class ClientSession:
    """All sessions of one client, one after the other.

    Args:
        meta: of the env.
        name: of the client, unique at its server.
        heartbeat: seconds within which a dead server is found, until the server sends its own.
        free_actions: the env accepts actions that do not fit its action space.
        reads_extras: the env reads columns that the policy attaches to the action.
        new_token: makes nonces.

    Attributes:
        phase: state of the connection.
        outbox: messages that wait to be sent, oldest first; the sender removes them.
        num_malformed: messages that were dropped as malformed.
        refusal: reason of the server's last refusal, until it admits the client.

    Raises:
        UnsupportedSpace: a space can't be announced.
    """

    def __init__(
        self,
        meta: EnvMeta,
        name: str,
        *,
        heartbeat: float,
        free_actions: bool = False,
        reads_extras: bool = False,
        new_token: Callable[[], int] = random_token,
    ) -> None:
        self.phase = Phase.AWAY
        self.outbox: deque[list[bytes]] = deque()
        self.num_malformed = 0
        self.refusal: str | None = None
        self._name = name
        self._heartbeat = heartbeat
        self._new_token = new_token
        self._free_actions = free_actions
        self._hello = ClientHello(
            version=VERSION,
            name=name,
            nonce=0,
            observation_space=describe(meta.observation_space, "the observation space"),
            action_space=describe(meta.action_space, "the action space"),
            num_envs=meta.num_envs,
            agents=[*meta.agents],
            max_episode_steps=meta.max_episode_steps,
            autoreset=meta.autoreset,
            free_actions=free_actions,
            reads_extras=reads_extras,
        )
        # Neither is None, because `describe` accepted them.
        observation_space = cast("gym.Space[Any]", meta.observation_space)
        action_space = cast("gym.Space[Any]", meta.action_space)
        self._results = ResultLayout(observation_space, meta.num_envs, meta.agents)
        self._actions = SpaceLayout(action_space, "action")
        self._reader: Reader[FromServer] = Reader(FromServer)
        self._writer = Writer()
        self._session: int | None = None
        self._number = -1
        self._reply: list[bytes] = []
        self._ask_at: float | None = None
        self._give_up_at: float | None = None
        self._pause = _SECONDS_BETWEEN_HELLOS[0]
        self._lost_keys: set[str] = set()
        self._log = LimitedLog(name)

    # The connection

    def connected(self, now: float) -> None:
        """Record that a connection to the server is open."""
        self._give_up_at = None
        self._pause = _SECONDS_BETWEEN_HELLOS[0]
        if self._session is None:
            self._say_hello_at(now)
        else:
            self.phase = Phase.RESUMING
        self._ask(now)

    def disconnected(self, now: float) -> None:
        """Record that the connection broke; it may come back."""
        if self.phase is not Phase.AWAY:
            self.phase, self._ask_at = Phase.AWAY, None
            if self._session is not None:
                self._give_up_at = now + 2 * self._heartbeat / PINGS_PER_HEARTBEAT

    def _say_hello_at(self, when: float) -> None:
        self.phase, self._ask_at = Phase.GREETING, when
        self._hello.nonce = self._new_token()

    def _ask(self, now: float) -> None:
        """Send a hello or a ping, and set the time to repeat it: it may get lost."""
        if self.phase is Phase.GREETING:
            self._send(self._hello)
        elif self._session is not None:
            self._send(Ping(session=self._session))
        serving = self.phase is Phase.SERVING
        self._ask_at = now + (self._heartbeat if serving else self._pause)

    def deadline(self) -> float | None:
        """Return the time at which `tick` is due (monotonic seconds); None if never."""
        return self._ask_at if self._give_up_at is None else self._give_up_at

    def tick(self, now: float) -> Ended | None:
        """Repeat a hello or ping, or give the server up, if that is due."""
        if self._give_up_at is not None and now >= self._give_up_at:
            return self._end("the connection to the server broke and did not come back")
        if self._ask_at is not None and now >= self._ask_at:
            self._ask(now)
        return None

    # Messages

    def receive(self, parts: Sequence[Part], now: float) -> Event | None:
        """Read one message. No content makes it raise.

        Returns:
            The event to act on. A `StepRequest` or `ResetRequest` must be answered before the
            next message is received.
        """
        try:
            message, frames = self._reader.read(parts)
            if isinstance(message, Welcome | Refusal):
                return self._on_answer(message, now)
            if message.session != self._session:
                self._on_other_session(message)
                return None
            return self._on_message(message, frames, now)
        except WireError as error:
            self._complain(str(error), now)
            return None

    def _on_message(
        self,
        message: Step | Reset | Ping | Pong | Gone | Bye,
        frames: Sequence[Part],
        now: float,
    ) -> Event | None:
        if isinstance(message, Gone):
            self._say_hello_at(now)
            return self._end(f"the server ended the session: {in_one_line(message.text)}")
        if isinstance(message, Bye):
            # A server that closes answers no hello, so wait.
            self._say_hello_at(now + self._pause)
            return self._end(f"the server closed: {in_one_line(message.reason)}")
        # A server may have forgotten this session while its `gone` got lost; then it is silent.
        self.phase, self._ask_at = Phase.SERVING, now + self._heartbeat
        if isinstance(message, Step | Reset):
            return self._on_request(message, frames, now)
        if isinstance(message, Ping):
            self._send(Pong(session=message.session, number=message.number))
        return None

    def _on_request(
        self, message: Step | Reset, frames: Sequence[Part], now: float
    ) -> Event | None:
        if message.number == self._number:
            self.outbox.append(self._reply)
            return None
        if message.number < self._number:
            self._refuse_stale(message)
            return None
        if isinstance(message, Reset):
            return ResetRequest(message.number, message.seed, message.options)
        if self._free_actions:
            return StepRequest(message.number, message.action, message.extras)
        try:
            action = self._actions.unpack(frames, message.texts)
        except WireError as error:
            self._complain(str(error), now)
            self.fail(message.number, ErrorText(type(error).__name__, str(error), ""))
            return None
        return StepRequest(message.number, action, message.extras)

    def _refuse_stale(self, message: Step | Reset) -> None:
        text = f"request {message.number} is older than {self._number}, which is done"
        self._send(
            Failure(
                session=message.session,
                number=message.number,
                exception_type=STALE_REQUEST,
                text=text,
                traceback="",
            )
        )

    def _on_answer(self, message: Welcome | Refusal, now: float) -> Event | None:
        if isinstance(message, Welcome):
            return self._on_welcome(message, now)
        return self._on_refusal(message, now)

    def _on_welcome(self, welcome: Welcome, now: float) -> Event | None:
        if welcome.session == self._session:
            # The server waits for the first result, or waited when it sent this.
            if self._number == 0:
                self.outbox.append(self._reply)
            return None
        if self.phase is not Phase.GREETING or welcome.nonce != self._hello.nonce:
            return None
        self.phase, self.refusal = Phase.SERVING, None
        self._session = self._hello.previous = welcome.session
        self._heartbeat = welcome.heartbeat
        self._ask_at = now + welcome.heartbeat
        self._number = -1
        return ResetRequest(0)

    def _on_refusal(self, refusal: Refusal, now: float) -> Event | None:
        if self.phase is not Phase.GREETING or refusal.nonce != self._hello.nonce:
            return None
        self.refusal = text = in_one_line(refusal.text)
        if not refusal.retry:
            self._ask_at = None
            return Refused(in_one_line(refusal.code), text)
        self._pause = min(2 * self._pause, _SECONDS_BETWEEN_HELLOS[1])
        self._ask_at = now + self._pause
        return None

    def _on_other_session(self, message: Step | Reset | Ping | Pong | Gone | Bye) -> None:
        # The server has a session that this client has given up or never had.
        if not isinstance(message, Gone | Bye | Pong):
            self._send(Bye(session=message.session, reason="this client holds no such session"))

    def _end(self, cause: str) -> Ended:
        self._session = self._give_up_at = None
        self._reply = []
        return Ended(cause)

    def _complain(self, text: str, now: float) -> None:
        self.num_malformed += 1
        self._log.warn(
            "malformed",
            in_one_line(f"dropped a message ({self.num_malformed} so far): {text}"),
            now,
        )

    # Answers

    def finish(self, number: int, ret: EnvRet | MultiAgentEnvRet, busy_ns: int = 0) -> None:
        """Answer request `number` with what `reset` or `step` of a `BaseEnv` returned."""
        outcome = ResultFields(
            ret.observation, ret.last_reward, ret.last_terminated, ret.last_truncated
        )
        # The contract gives this field its name.
        extra = ret._extra  # pyright: ignore[reportPrivateUsage]
        sent_ns = min(max(0, ret.ts_env_sent_ns), _LATEST_NS)
        self.answer(number, outcome, ret.info, extra, busy_ns, sent_ns)

    def answer(
        self,
        number: int,
        outcome: ResultFields,
        info: dict[str, Any],
        extra: dict[str, Any],
        busy_ns: int,
        sent_ns: int,
    ) -> None:
        """Answer request `number` with the parts of a result.

        The env produced `outcome` in `busy_ns`, at `sent_ns` (since the epoch).

        Values of `info` and `extra` that cannot be sent are left out; one warning names each key.

        Raises:
            Misfit: the outcome doesn't fit the announced spaces; nothing was sent.
        """
        if self._session is None:
            return
        result = ClientResult(
            session=self._session, number=number, busy_ns=busy_ns, sent_ns=sent_ns,
            info=info, extra=extra,
        )  # fmt: skip
        packed = Packed([], result.texts)
        header = self._results.pack(outcome, packed)
        result.reward, result.terminated, result.truncated = header[1:]
        self._answer(number, self._written(result, packed.frames))

    def _written(self, result: ClientResult, frames: list[bytes]) -> list[bytes]:
        try:
            return self._writer.write(result, [*frames])
        except Untransferable:
            lost: list[str] = []
            result.info = portable(result.info, lost)
            result.extra = portable(result.extra, lost)
        try:
            parts = self._writer.write(result, [*frames])
        except Untransferable as error:
            lost.append(f"everything ({error})")
            result.info, result.extra = {}, {}
            parts = self._writer.write(result, [*frames])
        if new := sorted({*lost} - self._lost_keys):
            self._lost_keys.update(new)
            LOG.warning(
                "%s: %s of the env's info can't be sent and is left out",
                self._name, ", ".join(new),
            )  # fmt: skip
        return parts

    def fail(self, number: int, error: ErrorText) -> None:
        """Answer request `number` with the exception that the env raised."""
        if self._session is not None:
            failure = Failure(
                session=self._session,
                number=number,
                exception_type=_encodable(error.type_name),
                text=_encodable(error.text),
                traceback=_encodable(error.traceback),
                blame=error.blame,
            )
            self._answer(number, self._writer.write(failure))

    def _answer(self, number: int, parts: list[bytes]) -> None:
        self._number, self._reply = number, parts
        self.outbox.append(parts)

    def leave(self, reason: str) -> None:
        """Send a goodbye if there is a session."""
        if self._session is not None:
            self._send(Bye(session=self._session, reason=reason))
        self._session = self._ask_at = None
        self.phase = Phase.AWAY

    def _send(self, message: Any) -> None:
        self.outbox.append(self._writer.write(message))


def _encodable(text: str) -> str:
    """Return `text` without characters that UTF-8 cannot encode, cut to a readable length."""
    if len(text) > 2 * _MAX_TEXT:
        text = f"{text[:_MAX_TEXT]}\n…\n{text[-_MAX_TEXT:]}"
    return text.encode(errors="replace").decode()
