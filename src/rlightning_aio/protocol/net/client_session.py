"""`ClientSession`: a client's end of env_server, without I/O.

Rule: a connection is a session. It begins with a hello and ends with the connection or a goodbye,
and nothing of it passes to the next one. Messages come in and are queued. Deliberately left out:
sockets, keys, the times of attempts, and the env itself.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, cast

from rlightning_aio.protocol.error_text import LOG, ErrorText, in_one_line
from rlightning_aio.protocol.net.payload import Packed, ResultFields, ResultLayout, SpaceLayout
from rlightning_aio.protocol.net.space_description import describe
from rlightning_aio.protocol.net.wire import (
    VERSION,
    Bye,
    ClientHello,
    ClientResult,
    Compression,
    Failure,
    FromServer,
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
    from collections.abc import Sequence

    import gymnasium as gym

    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet

_MAX_TEXT: Final = 50_000
_LATEST_NS: Final = 2**63 - 1


class Phase(Enum):
    """State of a client's connection to its server."""

    AWAY = "not connected"
    GREETING = "asking to be let in"
    SERVING = "serving"


@dataclass(frozen=True, slots=True)
class Ended:
    """The session has ended, and with it the trainer's control of the env; hang up."""

    cause: str


@dataclass(frozen=True, slots=True)
class Refused:
    """The server didn't let this client in; hang up. With `retry` it may do so later."""

    text: str
    retry: bool


Event = Step | Reset | Welcome | Ended | Refused
"""Step or reset the env, then call `ClientSession.finish` or `ClientSession.fail`; or the server
has let this client in; or the session, or the attempt to begin one, is over."""


class ClientSession:
    """All sessions of one client, one after the other.

    Args:
        meta: of the env.
        name: of the client, unique at its server.
        free_actions: the env accepts actions that do not fit its action space.
        reads_extras: the env reads columns that the policy attaches to the action.
        hardware: the env moves something real.
        compression: of images in observations.

    Attributes:
        phase: state of the connection.
        outbox: messages that wait to be sent, oldest first; the sender removes them.

    Raises:
        UnsupportedSpace: a space can't be announced.
        WireError: the library for `compression` is not installed.
    """

    def __init__(
        self,
        meta: EnvMeta,
        name: str,
        *,
        free_actions: bool = False,
        reads_extras: bool = False,
        hardware: bool = True,
        compression: Compression | None = None,
    ) -> None:
        self.phase = Phase.AWAY
        self.outbox: deque[list[bytes]] = deque()
        self._name = name
        self._hello = ClientHello(
            version=VERSION,
            name=name,
            observation_space=describe(meta.observation_space, "the observation space"),
            action_space=describe(meta.action_space, "the action space"),
            num_envs=meta.num_envs,
            agents=[*meta.agents],
            max_episode_steps=meta.max_episode_steps,
            autoreset=meta.autoreset,
            free_actions=free_actions,
            reads_extras=reads_extras,
            hardware=hardware,
            compression=compression,
        )
        # Neither is None, because `describe` accepted them.
        observation_space = cast("gym.Space[Any]", meta.observation_space)
        action_space = cast("gym.Space[Any]", meta.action_space)
        self._results = ResultLayout(observation_space, meta.num_envs, meta.agents, compression)
        self._actions = SpaceLayout(action_space, "action")
        self._reader: Reader[FromServer] = Reader(FromServer)
        self._writer = Writer()
        self._lost_keys: set[str] = set()
        self._last_number = 0

    # The connection

    def connected(self) -> None:
        """Say hello over a new connection."""
        self.phase = Phase.GREETING
        self._send(self._hello)

    def disconnected(self, cause: str) -> Event | None:
        """Record that the connection is gone."""
        return None if self.phase is Phase.AWAY else self._end(cause)

    def leave(self, reason: str) -> None:
        """Send a goodbye if there is a session."""
        if self.phase is Phase.SERVING:
            self._send(Bye(reason=reason))
        self.phase = Phase.AWAY

    def _end(self, cause: str) -> Ended | Refused:
        held, self.phase = self.phase is Phase.SERVING, Phase.AWAY
        return Ended(cause) if held else Refused(cause, retry=True)

    # Messages

    def receive(self, parts: Sequence[Part]) -> Event:
        """Read one message. No content makes it raise.

        Returns:
            The event to act on. Until a `Step` or `Reset` is answered, the server sends nothing
            but a goodbye.
        """
        try:
            message, frames = self._reader.read(parts)
            if isinstance(message, Bye):
                return self._end(f"the server ended the session: {in_one_line(message.reason)}")
            if isinstance(message, Welcome | Refusal):
                return self._on_answer(message)
            return self._on_request(message, frames)
        except WireError as error:
            text = f"a message of the server is malformed: {in_one_line(str(error))}"
            if self.phase is Phase.SERVING:
                self._send(Bye(reason=text))
            return self._end(text)

    def _on_answer(self, message: Welcome | Refusal) -> Event:
        if self.phase is not Phase.GREETING:
            raise WireError("an answer to a hello that was answered")
        if isinstance(message, Refusal):
            self.phase = Phase.AWAY
            return Refused(in_one_line(message.text), message.retry)
        self.phase = Phase.SERVING
        self._last_number = 0
        return message

    def _on_request(self, message: Step | Reset, frames: Sequence[Part]) -> Event:
        if self.phase is not Phase.SERVING:
            raise WireError("a request without a session")
        if not self._last_number and not isinstance(message, Reset):
            raise WireError("the first request of a session is not a reset")
        self._last_number = message.number
        if isinstance(message, Step) and not self._hello.free_actions:
            message.action = self._actions.unpack(frames, message.texts)
        return message

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
        if self.phase is not Phase.SERVING:
            return
        result = ClientResult(
            number=number, busy_ns=busy_ns, sent_ns=sent_ns, info=info, extra=extra
        )
        packed = Packed([], result.texts)
        header = self._results.pack(outcome, packed)
        result.reward, result.terminated, result.truncated = header[1:]
        self.outbox.append(self._written(result, packed.frames))

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
        if self.phase is Phase.SERVING:
            failure = Failure(
                number=number,
                exception_type=_encodable(error.type_name),
                text=_encodable(error.text),
                traceback=_encodable(error.traceback),
                blame=error.blame,
            )
            self._send(failure)

    def _send(self, message: Any) -> None:
        self.outbox.append(self._writer.write(message))


def _encodable(text: str) -> str:
    """Return `text` without characters that UTF-8 cannot encode, cut to a readable length."""
    if len(text) > 2 * _MAX_TEXT:
        text = f"{text[:_MAX_TEXT]}\n…\n{text[-_MAX_TEXT:]}"
    return text.encode(errors="replace").decode()
