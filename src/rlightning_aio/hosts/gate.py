"""`Gate`: whose connection to an env_server goes on, and when (ZMQ's ZAP, RFC 27).

Rule: ZMQ asks about every connection in the middle of its handshake, and reads nothing of it until
it has the answer. Whoever has a known key is let in at once. Strangers wait until there is an
allowance for one more of them, and nothing that they send is read meanwhile. Their addresses take
turns, so a crowd at one of them keeps out nobody at another.
With a gate, ZMQ also refuses connections in protocols before ZMTP 3. One of these that came while
the socket closes would end the process (an assertion of libzmq 4.3).
"""

from __future__ import annotations

import logging
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple, cast

import zmq
from zmq.utils import z85

from rlightning_aio.hosts.allowance import CONNECTION
from rlightning_aio.remote.keys import AllowedKeys, read_server_keys
from rlightning_aio.remote.parts import is_readable

if TYPE_CHECKING:
    from pathlib import Path

    from rlightning_aio.hosts.allowance import Allowance

__all__ = ["HANDSHAKE_SECONDS", "Gate", "Question", "Turns"]

HANDSHAKE_SECONDS: Final = 5.0
"""After which ZMQ gives a connection up that hasn't been answered."""
_SECONDS_BETWEEN_WARNINGS: Final = 10.0

_log = logging.getLogger(__name__)


class Question(NamedTuple):
    """ZMQ's, about one connection.

    Attributes:
        envelope: what an answer begins with: whom it is for, and to what.
        address: where the connection comes from.
        key: that it has proved, as Z85 text; empty without keys.
        at: when it was asked (monotonic seconds).
    """

    envelope: list[bytes]
    address: str
    key: bytes
    at: float


class Turns:
    """Questions that wait, the oldest of each address in turn."""

    def __init__(self) -> None:
        self._by_address: dict[str, deque[Question]] = {}

    def __len__(self) -> int:
        return sum([len(asked) for asked in self._by_address.values()])

    def add(self, question: Question) -> None:
        """It comes after those of its address."""
        self._by_address.setdefault(question.address, deque()).append(question)

    def next(self) -> Question | None:
        """Whose turn it is; its address is the last one now."""
        for address, asked in self._by_address.items():
            question = asked.popleft()
            del self._by_address[address]
            if asked:
                self._by_address[address] = asked
            return question
        return None

    def forget(self, before: float) -> None:
        """Drop what was asked before that time."""
        for address, asked in list(self._by_address.items()):
            while asked and asked[0].at < before:
                asked.popleft()
            if not asked:
                del self._by_address[address]


class Gate:
    """Answers for one socket.

    Args:
        keys: the env_server's directory, as `remote.keys.make_keys` lays it out; None lets
            everybody in.
        allowance: for strangers, in seconds.

    Raises:
        ConfigError: the env_server's key can't be read.
    """

    def __init__(self, keys: Path | None, allowance: Allowance) -> None:
        self._secret, self._allowed = b"", None
        if keys is not None:
            self._secret, clients = read_server_keys(keys)
            self._allowed = AllowedKeys(clients)
        self._allowance = allowance
        self._turns = Turns()
        self._warned_at: float | None = None
        self._socket: zmq.Socket[bytes]

    @property
    def has_keys(self) -> bool:
        """Whether who comes in has proved to have a key."""
        return self._allowed is not None

    def open(self, context: zmq.Context[zmq.Socket[bytes]], router: zmq.Socket[bytes]) -> None:
        """Have ZMQ ask about whoever dials `router`, which is bound to nothing yet."""
        socket = self._socket = context.socket(zmq.ROUTER)
        # Answers to those who have hung up meanwhile must fail, as they cost nothing.
        socket.set(zmq.ROUTER_MANDATORY, 1)
        socket.bind("inproc://zeromq.zap.01")
        router.set_string(zmq.ZAP_DOMAIN, "rlightning-aio")
        router.set(zmq.ZAP_ENFORCE_DOMAIN, 1)
        router.set(zmq.HANDSHAKE_IVL, int(1000 * HANDSHAKE_SECONDS))
        if self._allowed is not None:
            router.set(zmq.CURVE_SERVER, 1)
            router.set(zmq.CURVE_SECRETKEY, self._secret)

    def fileno(self) -> int:
        """Tells of a question."""
        return cast("int", self._socket.get(zmq.FD))

    def look(self, now: float) -> bool:
        """Take in all questions, and answer those that may be; whether there was a new one."""
        self._turns.forget(now - HANDSHAKE_SECONDS)
        asked = self._take_in(now)
        while self._allowance.left(now) >= CONNECTION and (question := self._turns.next()):
            self._answer(question, now)
            # Answering takes in what ZMQ has to tell, so its descriptor may have fallen silent.
            asked |= self._take_in(now)
        return asked

    def _take_in(self, now: float) -> bool:
        asked = False
        while is_readable(self._socket):
            asked = True
            question = _question(self._socket.recv_multipart(), now)
            # To look for the key among the files, which takes longer, is a stranger's expense.
            if self._allowed is not None and self._allowed.knew(question.key):
                self._answer(question, now)
            else:
                self._turns.add(question)
        return asked

    def deadline(self, now: float) -> float | None:
        """When somebody's turn comes; None if nobody waits."""
        return self._allowance.time_of(CONNECTION, now) if self._turns else None

    def _answer(self, question: Question, now: float) -> None:
        verdict, user = b"200", b""
        if self._allowed is not None:
            name = self._allowed.owner(question.key)
            verdict, user = (b"400", b"") if name is None else (b"200", name.encode())
        try:
            self._socket.send_multipart([*question.envelope, verdict, b"", user, b""])
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            return
        if not user:
            self._allowance.spend(CONNECTION, now)
        if verdict != b"200":
            self._warn(question.address, now)

    def _warn(self, address: str, now: float) -> None:
        assert self._allowed is not None
        if self._warned_at is None or now - self._warned_at >= _SECONDS_BETWEEN_WARNINGS:
            self._warned_at = now
            _log.warning(
                "a client at %s has a key that is not in %s", address, self._allowed.directory
            )


def _question(parts: list[bytes], now: float) -> Question:
    asker, empty, version, request_id, _, address, _, mechanism, *credentials = parts
    key = z85.encode(credentials[0]) if mechanism == b"CURVE" else b""
    return Question([asker, empty, version, request_id], address.decode(errors="replace"), key, now)
