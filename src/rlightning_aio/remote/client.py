"""`RemoteEnvClient`: an env of this machine, stepped by a trainer on another.

Rule: a plain blocking loop on the caller's thread. The env is reset, stepped and stopped
by that thread alone; what is said to the server, and when, is `client_session`'s affair;
whether the connection lives is ZMQ's, whose own thread goes on while the env steps.
Absent on purpose: threads, and anything that unpickles.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import time
import traceback
from math import ceil
from threading import Thread
from typing import TYPE_CHECKING, Any, Final, Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from rlightning_aio.envs.results import (
    has_preprocess_fn,
    input_of,
    one_result,
    reads_extras,
    step_of,
)
from rlightning_aio.errors import ClientRefused, ConfigError
from rlightning_aio.protocol.net.client_session import (
    ClientSession,
    Ended,
    Phase,
    Refused,
    ResetRequest,
    StepRequest,
)
from rlightning_aio.protocol.net.payload import Outcome
from rlightning_aio.protocol.net.server_session import PATIENCE
from rlightning_aio.protocol.net.space_description import UnsupportedSpace
from rlightning_aio.protocol.net.wire import MAX_FRAME_BYTES, MAX_NAME_LENGTH
from rlightning_aio.remote.keys import read_client_keys
from rlightning_aio.remote.parts import receive_parts, send_parts

if TYPE_CHECKING:
    from types import TracebackType

    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.protocol.net.client_session import Event

__all__ = ["RemoteEnvClient"]

_RECONNECT_MS: Final = (100, 5000)
"""From one attempt to connect to the next: at first, and at most; doubled in between."""
_HANDSHAKE_MS: Final = 5000
_REDIAL_SECONDS: Final = (1.0, 8.0)
"""ZMQ gives up for good after a handshake that failed; then it is told to try again."""
_LINGER_MS: Final = 500

_log = logging.getLogger(__name__)

_Socket = zmq.Socket[bytes]
ENDING: Final = "end of an interrupted client's sockets"
"""Name of a thread."""


class RemoteEnvClient:
    """Lends one env to the env_server of a trainer's group.

    It dials in, and dials again with growing pauses whenever the server is gone; each time
    it is let in, the env is reset and a new session begins. Whenever a session ends and the env
    didn't end it, ``env.on_disconnect()`` is called, so that a robot stops.

    Args:
        env: newly built; the client owns it from now on, initialises it and closes it.
        hostname: of the server.
        port: of the server.
        keys: directory of the client's keys, see ``rlightning-aio keygen``; None connects
            without, which a server with keys refuses.
        name: unique at the server; by default this machine's name and the process id.
        heartbeat: seconds within which a dead server is found; the server's own setting
            takes over once it has answered.

    Attributes:
        name: as given, or made.
        num_steps: steps that the env has taken for trainers.
        num_sessions: how often it was let in.

    Raises:
        ConfigError: the name is too long, the env's spaces can't be announced, or the keys
            can't be read.
    """

    def __init__(
        self,
        env: BaseEnv,
        hostname: str,
        port: int,
        *,
        keys: str | os.PathLike[str] | None = None,
        name: str | None = None,
        heartbeat: float = 5.0,
    ) -> None:
        self.name = name or f"{socket.gethostname()}-{os.getpid()}"
        if len(self.name) > MAX_NAME_LENGTH:
            raise ConfigError(
                f"a client's name has {len(self.name)} characters; {MAX_NAME_LENGTH} are allowed"
            )
        self.num_steps = 0
        self.num_sessions = 0
        self._env = env
        self._address = f"tcp://{f'[{hostname}]' if ':' in hostname else hostname}:{port}"
        self._keys = None if keys is None else read_client_keys(keys)
        self._heartbeat = heartbeat
        try:
            self._session = ClientSession(
                env.initialised(),
                self.name,
                heartbeat=heartbeat,
                free_actions=env.transforms_actions or has_preprocess_fn(env),
                reads_extras=reads_extras(env),
            )
        except UnsupportedSpace as error:
            raise ConfigError(f"env {env.env_id!r} can't be a remote client: {error}") from None
        self._bare_step = env.bare_step()
        self._env_step = step_of(env)
        self._input = input_of(env)
        self._todo: StepRequest | ResetRequest | None = None
        self._trouble = ""
        self._redial_at: float | None = None
        self._redial_pause = _REDIAL_SECONDS[0]
        self._context: zmq.Context[_Socket] | None = None
        self._dealer: _Socket
        self._monitor: _Socket
        self._poller: zmq.Poller
        self._closed = False

    @property
    def state(self) -> str:
        """The state of the connection, in a few words."""
        trouble = self._session.refusal or self._trouble
        phase = self._session.phase.value
        if not trouble or self._session.phase is Phase.SERVING:
            return phase
        return f"{phase} ({trouble})"

    def connect(self, timeout: float | None = None) -> None:
        """Dial in and wait until the server has let this client in.

        Args:
            timeout: seconds; None waits as long as it takes.

        Raises:
            TimeoutError: nobody let it in; the message has the last known reason.
            ClientRefused: the server will never let it in as it is.
        """
        if self._closed:
            raise RuntimeError("this client is closed")
        if self._context is None:
            self._dial()
        end = None if timeout is None else time.monotonic() + timeout
        while self._session.phase is not Phase.SERVING:
            if end is not None and time.monotonic() >= end:
                raise TimeoutError(
                    f"{self._address} did not let {self.name!r} in within {timeout} s: {self.state}"
                )
            self._turn(end)

    def run(self) -> None:
        """Serve until ``env.is_finish()`` is true; connects first if necessary.

        ``is_finish`` is called after every reset, step and `on_disconnect`, among others.

        Raises:
            ClientRefused: the server will never let this client in.
            Exception: whatever the env raises in the reset that opens a session, in
                ``is_finish``, or in ``on_disconnect``. Errors of steps and later resets go to
                the trainer instead.
        """
        try:
            self.connect()
            while not self._env.is_finish():
                if self._todo is None:
                    self._turn(None)
                else:
                    request, self._todo = self._todo, None
                    self._execute(request)
        except BaseException as error:
            self._leave(f"{type(error).__name__}: {error}")
            raise
        self._leave("the env is finished")

    def close(self) -> None:
        """Leave the server and close the env; idempotent."""
        if self._closed:
            return
        self._closed = True
        if self._context is not None:
            self._leave("the client was closed")
            self._dealer.disable_monitor()
            self._monitor.close(linger=0)
            self._dealer.close(linger=_LINGER_MS)
            self._context.term()
        self._env.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        exc_traceback: TracebackType | None,
    ) -> None:
        self.close()

    # The connection

    def _dial(self) -> None:
        context = zmq.Context[_Socket]()
        try:
            self._dealer = context.socket(zmq.DEALER)
            self._set_options(self._dealer)
            self._monitor = self._dealer.get_monitor_socket()
            self._poller = zmq.Poller()
            self._poller.register(self._monitor, zmq.POLLIN)
            self._poller.register(self._dealer, zmq.POLLIN)
            self._dealer.connect(self._address)
            # Invariant: there is a context as soon as all of it is there, and not before.
            self._context = context
        except BaseException:
            self._context = None
            # The end of a context waits until all its sockets are closed, of which one may be
            # half made and in the hands of the error that is on its way.
            Thread(target=context.destroy, args=(0,), name=ENDING, daemon=True).start()
            raise

    def _set_options(self, dealer: _Socket) -> None:
        # A message for a connection that is no more must not wait for the next one.
        dealer.set(zmq.IMMEDIATE, 1)
        dealer.set(zmq.MAXMSGSIZE, MAX_FRAME_BYTES)
        dealer.set(zmq.RECONNECT_IVL, _RECONNECT_MS[0])
        dealer.set(zmq.RECONNECT_IVL_MAX, _RECONNECT_MS[1])
        dealer.set(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        dealer.set(zmq.HEARTBEAT_IVL, max(1, int(1000 * self._heartbeat / PATIENCE)))
        dealer.set(zmq.HEARTBEAT_TIMEOUT, max(2, int(2000 * self._heartbeat / PATIENCE)))
        if self._keys is not None:
            dealer.set(zmq.CURVE_SERVERKEY, self._keys.server)
            dealer.set(zmq.CURVE_PUBLICKEY, self._keys.public)
            dealer.set(zmq.CURVE_SECRETKEY, self._keys.secret)
        if "[" in self._address:
            dealer.set(zmq.IPV6, 1)

    def _turn(self, until: float | None) -> None:
        """Wait for something to happen, at most `until`, and take it in."""
        due = _earliest(_earliest(until, self._session.deadline()), self._redial_at)
        wait_ms = None if due is None else ceil(1000 * max(0.0, due - time.monotonic()))
        for source, _ in self._poller.poll(wait_ms):
            if source is self._dealer:
                first = self._dealer.recv(zmq.NOBLOCK, copy=False)
                parts = receive_parts(self._dealer, first)
                self._obey(self._session.receive(parts, time.monotonic()))
            else:
                self._watch()
        if due is not None and time.monotonic() >= due:
            self._obey(self._session.tick(time.monotonic()))
            if self._redial_at is not None and time.monotonic() >= self._redial_at:
                self._redial()
        self._flush()

    def _watch(self) -> None:
        """Take in what has become of the connection."""
        event, now = recv_monitor_message(self._monitor)["event"], time.monotonic()
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._trouble = ""
            self._redial_at, self._redial_pause = None, _REDIAL_SECONDS[0]
            self._session.connected(now)
        elif event == zmq.EVENT_DISCONNECTED:
            self._session.disconnected(now)
            self._redial_at = now + _REDIAL_SECONDS[1]
        elif event == zmq.EVENT_CONNECT_RETRIED and not self._trouble:
            self._trouble = f"nobody answers at {self._address}"
        elif event in _REFUSED_HANDSHAKES:
            self._trouble = _REFUSED_HANDSHAKES[event]
            self._redial_at = now + self._redial_pause

    def _redial(self) -> None:
        """Connect anew, in place of a connection that ZMQ may or may not be working on."""
        with contextlib.suppress(zmq.ZMQError):
            self._dealer.disconnect(self._address)
        self._dealer.connect(self._address)
        self._redial_pause = min(2 * self._redial_pause, _REDIAL_SECONDS[1])
        self._redial_at = time.monotonic() + _REDIAL_SECONDS[1]

    def _flush(self) -> None:
        outbox = self._session.outbox
        while outbox:
            parts = outbox.popleft()
            try:
                send_parts(self._dealer, parts)
            except zmq.Again:
                # No connection, or a full one; what is lost is asked for again.
                continue

    def _leave(self, reason: str) -> None:
        self._session.leave(reason)
        if self._context is not None:
            self._flush()

    # The env

    def _obey(self, event: Event | None) -> None:
        if isinstance(event, Refused):
            raise ClientRefused(f"{self._address} refused the client {self.name!r}: {event.text}")
        if isinstance(event, Ended):
            self._todo = None
            _log.warning("%s: session over: %s", self.name, event.cause)
            self._env.on_disconnect()
        elif event is not None:
            self._todo = event

    def _execute(self, request: StepRequest | ResetRequest) -> None:
        if request.number == 0:
            self.num_sessions += 1
            self._reset(ResetRequest(0))
            return
        try:
            if isinstance(request, ResetRequest):
                self._reset(request)
            else:
                self._step(request)
        except Exception as error:  # noqa: BLE001  # Whatever it is, the trainer learns of it.
            self._session.fail(request.number, *_in_words(error))
            self._flush()

    def _reset(self, request: ResetRequest) -> None:
        began_ns = time.perf_counter_ns()
        ret = self._env.reset(seed=request.seed, options=request.options)
        self._answer(request.number, "reset", ret, time.perf_counter_ns() - began_ns)

    def _step(self, request: StepRequest) -> None:
        began_ns = time.perf_counter_ns()
        if self._bare_step is not None:
            *outcome, info = self._bare_step(self._input(request.action, request.extras))
            busy_ns = time.perf_counter_ns() - began_ns
            self.num_steps += 1
            self._session.answer(
                request.number, Outcome(*outcome), info, {}, busy_ns, time.time_ns()
            )
            self._flush()
            return
        ret = self._env_step(self._input(request.action, request.extras))
        self.num_steps += 1
        self._answer(request.number, "step", ret, time.perf_counter_ns() - began_ns)

    def _answer(self, number: int, method: str, returned: Any, busy_ns: int) -> None:
        self._session.finish(number, one_result(self._env, method, returned), busy_ns)
        self._flush()


def _earliest(one: float | None, other: float | None) -> float | None:
    if one is None or other is None:
        return other if one is None else one
    return min(one, other)


def _in_words(error: Exception) -> tuple[str, str, str]:
    """Type, text and traceback of `error`; a broken ``__str__`` is no obstacle."""
    kind = type(error)
    name = f"{kind.__module__}.{kind.__qualname__}".removeprefix("builtins.")
    try:
        text, lines = str(error), "".join(traceback.format_exception(error))
    except Exception as broken:  # noqa: BLE001  # It is the env author's code.
        text = f"<its __str__ raised {type(broken).__name__}>"
        lines = "".join(traceback.format_tb(error.__traceback__)) + f"{name}: {text}\n"
    return name, text, lines


_REFUSED_HANDSHAKES: Final[dict[int, str]] = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "the server does not know this client's key",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "the server uses other security: keys on one side only?",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: "the handshake was not completed: is the key right?",
}
