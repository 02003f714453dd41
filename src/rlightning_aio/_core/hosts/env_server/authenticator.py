"""`Authenticator`: decides which connections to an env_server continue (ZMQ's ZAP, RFC 27).

Rule: ZMQ asks about every connection in the middle of its handshake, and reads nothing from it
before the answer, which `zmq.auth` gives. ZMQ asks without keys, too: with an authenticator it
refuses protocols before ZMTP 3, and a connection in one of these that came while the socket closes
would end the process (an assertion of libzmq 4.3).
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, cast

import zmq
import zmq.auth

from rlightning_aio.remote.keys import ListedKeys, read_server_keys
from rlightning_aio.remote.zmq_messages import is_readable, next_message

if TYPE_CHECKING:
    from pathlib import Path

_DOMAIN = "rlightning-aio"


class Authenticator:
    """Answers ZMQ's questions for one socket.

    Args:
        keys: the env_server's directory, as `remote.keys.make_keys` lays it out; None admits
            every peer.

    Raises:
        ConfigError: the env_server's key can't be read.
    """

    def __init__(self, keys: Path | None) -> None:
        self._keys = None if keys is None else read_server_keys(keys)
        self._listed = None if self._keys is None else ListedKeys(self._keys.clients)
        self._zap: zmq.auth.Authenticator

    @property
    def socket(self) -> zmq.Socket[bytes]:
        """The socket on which ZMQ asks."""
        return cast("zmq.Socket[bytes]", self._zap.zap_socket)  # pyright: ignore[reportUnknownMemberType]

    def open(self, context: zmq.Context[zmq.Socket[bytes]], router: zmq.Socket[bytes]) -> None:
        """Make ZMQ ask about all connections to `router`, which is not bound yet."""
        self._zap = zmq.auth.Authenticator(context)
        self._zap.start()
        router.set_string(zmq.ZAP_DOMAIN, _DOMAIN)
        router.set(zmq.ZAP_ENFORCE_DOMAIN, 1)
        if self._keys is not None:
            self._zap.configure_curve_callback(_DOMAIN, self._listed)
            router.set(zmq.CURVE_SERVER, 1)
            router.set(zmq.CURVE_SECRETKEY, self._keys.secret)

    def names_of(self, frame: zmq.Frame) -> set[str] | None:
        """Return the names that the key of a message's sender was made for; None without keys."""
        if self._listed is None:
            return None
        return self._listed.names(cast("str", frame.get("User-Id")).encode())

    def answer(self) -> None:
        """Answer all questions that have come."""
        while is_readable(self.socket) and (question := next_message(self.socket)) is not None:
            with contextlib.suppress(StopIteration):  # It awaits nothing.
                self._zap.handle_zap_message(question).send(None)
