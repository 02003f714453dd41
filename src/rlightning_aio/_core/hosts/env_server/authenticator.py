"""`Authenticator`: decides which connections to an env_server continue (ZMQ's ZAP, RFC 27).

Rule: ZMQ asks about every connection in the middle of its handshake, and reads nothing from it
before the answer. A known key is admitted at once. All other peers wait until the rate limiter has
budget for one more. Their addresses take turns, so a crowd at one address does not keep out peers
at another. (That is why `zmq.auth` only makes and reads the certificates: its authenticator answers
one question after the other.) With an authenticator, ZMQ also refuses protocols before ZMTP 3. A
connection in one of these that came while the socket closes would end the process (an assertion of
libzmq 4.3).
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple, cast

import zmq
from zmq.utils import z85

from rlightning_aio._core.hosts.env_server.rate_limiter import CONNECTION_COST
from rlightning_aio.protocol.net.wire import HANDSHAKE_SECONDS
from rlightning_aio.remote.keys import AllowedKeys, read_server_keys
from rlightning_aio.remote.zmq_messages import is_readable, next_message

if TYPE_CHECKING:
    from pathlib import Path

    from rlightning_aio._core.hosts.env_server.rate_limiter import RateLimiter
    from rlightning_aio.protocol.net.limited_log import LimitedLog

__all__ = ["Authenticator", "Question", "QuestionQueue"]


class Question(NamedTuple):
    """ZMQ's question about one connection.

    Attributes:
        envelope: the first parts of the answer.
        address: origin of the connection.
        key: the key that it has proved, as Z85 text; empty without keys.
        at: time of the question (monotonic seconds).
    """

    envelope: list[bytes]
    address: str
    key: bytes
    at: float


class QuestionQueue:
    """Questions that wait. Addresses take turns, each with its oldest question."""

    def __init__(self) -> None:
        self._by_address: dict[str, deque[Question]] = {}

    def __len__(self) -> int:
        return sum([len(questions) for questions in self._by_address.values()])

    def add(self, question: Question) -> None:
        """Append a question to those of its address."""
        self._by_address.setdefault(question.address, deque()).append(question)

    def next(self) -> Question | None:
        """Remove and return the next question; its address moves to the end."""
        for address, questions in self._by_address.items():
            question = questions.popleft()
            del self._by_address[address]
            if questions:
                self._by_address[address] = questions
            return question
        return None

    def drop_before(self, time: float) -> None:
        """Drop questions that are older than `time`."""
        for address, questions in list(self._by_address.items()):
            while questions and questions[0].at < time:
                questions.popleft()
            if not questions:
                del self._by_address[address]


class Authenticator:
    """Answers ZMQ's questions for one socket.

    Args:
        keys: the env_server's directory, as `remote.keys.make_keys` lays it out; None admits
            every peer.
        limiter: for unauthenticated peers, in seconds.
        log: of the env_server.

    Raises:
        ConfigError: the env_server's key can't be read.
    """

    def __init__(self, keys: Path | None, limiter: RateLimiter, log: LimitedLog) -> None:
        self._secret, self._allowed = b"", None
        if keys is not None:
            self._secret, clients = read_server_keys(keys)
            self._allowed = AllowedKeys(clients)
        self._limiter = limiter
        self._log = log
        self._waiting = QuestionQueue()
        self._socket: zmq.Socket[bytes]

    @property
    def has_keys(self) -> bool:
        """True if every admitted connection has proved a key."""
        return self._allowed is not None

    def open(self, context: zmq.Context[zmq.Socket[bytes]], router: zmq.Socket[bytes]) -> None:
        """Make ZMQ ask about all connections to `router`, which is not bound yet."""
        socket = self._socket = context.socket(zmq.ROUTER)
        # Answers to peers that have hung up must fail, because they cost nothing.
        socket.set(zmq.ROUTER_MANDATORY, 1)
        socket.bind("inproc://zeromq.zap.01")
        router.set_string(zmq.ZAP_DOMAIN, "rlightning-aio")
        router.set(zmq.ZAP_ENFORCE_DOMAIN, 1)
        router.set(zmq.HANDSHAKE_IVL, int(1000 * HANDSHAKE_SECONDS))
        if self._allowed is not None:
            router.set(zmq.CURVE_SERVER, 1)
            router.set(zmq.CURVE_SECRETKEY, self._secret)

    def fileno(self) -> int:
        """Return a descriptor that is readable when a question has come."""
        return cast("int", self._socket.get(zmq.FD))

    def answer_questions(self, now: float) -> bool:
        """Read all questions and answer those that the budget allows. Return True if any came."""
        self._waiting.drop_before(now - HANDSHAKE_SECONDS)
        any_question = self._read_questions(now)
        while self._limiter.budget(now) >= CONNECTION_COST and (question := self._waiting.next()):
            self._answer(question, now)
            # Answering reads ZMQ's signals, so the descriptor may not report the next question.
            any_question |= self._read_questions(now)
        return any_question

    def _read_questions(self, now: float) -> bool:
        any_question = False
        while is_readable(self._socket) and (parts := next_message(self._socket)) is not None:
            any_question = True
            question = _question(parts, now)
            # Searching the key files takes longer, so only the budget of peers pays for it.
            if self._allowed is not None and self._allowed.is_known(question.key):
                self._answer(question, now)
            else:
                self._waiting.add(question)
        return any_question

    def deadline(self, now: float) -> float | None:
        """Return the time at which the next question can be answered; None if none waits."""
        return self._limiter.time_of(CONNECTION_COST, now) if self._waiting else None

    def _answer(self, question: Question, now: float) -> None:
        is_client = self._allowed is not None and self._allowed.holds(question.key)
        verdict = b"200" if self._allowed is None or is_client else b"400"
        try:
            self._socket.send_multipart([*question.envelope, verdict, b"", b"", b""])
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            return
        if not is_client:
            self._limiter.spend(CONNECTION_COST, now)
        if verdict != b"200":
            assert self._allowed is not None
            keys = self._allowed.directory
            text = f"a client at {question.address} has a key that is not in {keys}"
            self._log.warn("key", text, now)


def _question(parts: list[bytes], now: float) -> Question:
    asker, empty, version, request_id, _, address, _, mechanism, *credentials = parts
    key = z85.encode(credentials[0]) if mechanism == b"CURVE" else b""
    return Question([asker, empty, version, request_id], address.decode(errors="replace"), key, now)
