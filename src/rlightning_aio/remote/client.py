"""`RemoteEnvClient`: an env of this machine that a trainer on another machine steps.

Rule: a plain blocking loop on the caller's thread, which alone resets and steps the env. A socket
of ZMQ has one connection at most, which is one session; after its end, another socket dials again.
ZMQ's own thread keeps the connection alive while the env steps, and notices if the server is
silent. While hardware is at work, a thread has the sockets, and stops it when the session is over.
Deliberately left out: the meaning of messages (`client_session`), and anything that unpickles.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import socket
import time
from math import ceil
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import gymnasium as gym
import zmq
from zmq.utils.monitor import recv_monitor_message

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.base import BaseEnv, initialised
from rlightning_aio.envs.fast_path import fast_path_of
from rlightning_aio.envs.hardware import (
    HELD,
    checked_input_of,
    says_hardware,
    signals_held_back,
    stop,
    stop_all,
    watched,
)
from rlightning_aio.envs.results import (
    explained,
    has_preprocess_fn,
    input_of,
    is_awaitable,
    one_result,
    reads_extras,
    step_of,
)
from rlightning_aio.envs.simulators.callable import env_of_callable
from rlightning_aio.errors import ClientRefused, ConfigError
from rlightning_aio.protocol.error_text import LOG, ErrorText
from rlightning_aio.protocol.net.client_session import (
    ClientSession,
    Phase,
    Refused,
)
from rlightning_aio.protocol.net.payload import ResultFields
from rlightning_aio.protocol.net.space_description import UnsupportedSpace
from rlightning_aio.protocol.net.wire import (
    DEFAULT_HEARTBEAT,
    HANDSHAKE_SECONDS,
    HARDWARE_HEARTBEAT,
    MAX_HEARTBEAT,
    MAX_NAME_LENGTH,
    Reset,
    Step,
    Welcome,
    WireError,
)
from rlightning_aio.remote.keys import read_client_keys
from rlightning_aio.remote.zmq_messages import next_frame, receive_parts, send_parts, set_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from rlightning_aio.protocol.net.client_session import Event

_SECONDS_BETWEEN_ATTEMPTS: Final = (0.1, 5.0)
"""The first pause, and the longest. Each attempt doubles it, until a server requests something."""
_ATTEMPT_SECONDS: Final = 3 * HANDSHAKE_SECONDS
"""Time after which an attempt that ZMQ says nothing about is over."""
_LINGER_MS: Final = 500
_NEVER_MS: Final = 24 * 3600 * 1000
"""Time after which ZMQ itself would dial again. The socket is closed long before."""

_ADDRESS: Final = re.compile(r"tcp://(?:\[[0-9A-Fa-f:.]+\]|[\w.-]+):([0-9]{1,5})")
_MAX_PORT: Final = 65535

_Socket = zmq.Socket[bytes]


class RemoteEnvClient:
    """Lends one env to the env_server of a trainer's group.

    It dials in, and dials again with growing pauses whenever the server is gone. When the server
    lets it in, it waits: a trainer's first request is always a reset, and nothing moves before.
    When a session ends and the env did not end it, the client calls ``env.on_disconnect()``, so
    that a robot stops.

    Args:
        env: newly built: a `BaseEnv` or a Gymnasium env, or a callable that returns one. The client
            owns it, initialises it and closes it.
        hostname: of the server, or its whole address, such as ``group["arms"].address``.
        port: of the server; None with a whole address.
        keys: directory of the client's keys, see ``rlightning-aio keygen``; None connects
            without, which a server with keys refuses.
        name: unique at the server; by default that of the keys, or else this machine's name and
            the process id.
        hardware: the env moves something real: a trainer then never resets it by itself, an action
            that its space does not contain never reaches it, and `BaseEnv.stop` is called whatever
            goes wrong. None: what a `BaseEnv` or its backend says; True of any
            other env, whose method ``stop`` is then called, if it has one.
        compression: ``zstd`` compresses images of observations, without loss; None sends them as
            they are. Both ends need the extra ``zstd``.
        heartbeat: seconds of silence after which the server counts as gone, 0.1 to 86400. None: as
            the server says; until then 1 for hardware, else 5.

    Attributes:
        name: of the client.
        num_steps: steps that trainers have requested.
        num_sessions: sessions so far.

    Raises:
        ConfigError: the name is too long, the address is incomplete, the env's spaces can't be
            announced, the env is awaitable, the heartbeat is no such number, or the keys can't be
            read.
    """

    def __init__(
        self,
        env: BaseEnv | gym.Env[Any, Any] | Callable[[], Any],
        hostname: str,
        port: int | None = None,
        *,
        keys: str | os.PathLike[str] | None = None,
        name: str | None = None,
        hardware: bool | None = None,
        heartbeat: float | None = None,
        compression: Literal["zstd"] | None = None,
    ) -> None:
        given_by_keys = "" if keys is None else Path(keys).name
        self.name = name or given_by_keys or f"{socket.gethostname()}-{os.getpid()}"
        if len(self.name) > MAX_NAME_LENGTH:
            raise ConfigError(
                f"a client's name has {len(self.name)} characters; {MAX_NAME_LENGTH} are allowed"
            )
        self.num_steps = 0
        self.num_sessions = 0
        self._address = _address(hostname, port)
        self._keys = None if keys is None else read_client_keys(keys)
        if hardware is None:
            hardware = not isinstance(env, BaseEnv) or says_hardware(env) or env.config.is_hardware
        self._is_hardware = hardware
        self._own_heartbeat = _checked_heartbeat(heartbeat)
        self._heartbeat = heartbeat or (HARDWARE_HEARTBEAT if hardware else DEFAULT_HEARTBEAT)
        compression = _checked_compression(compression)
        self._env = env = _own_env(env, self.name)
        with _held(env, is_hardware=hardware):
            self._session = ClientSession(
                initialised(env),
                self.name,
                free_actions=env.transforms_actions or has_preprocess_fn(env),
                reads_extras=reads_extras(env),
                hardware=hardware,
                compression=compression,
            )
        bare = fast_path_of(env).bare_step()
        self._is_bare = bare is not None
        self._env_step: Callable[[Any], Any] = bare or step_of(env)
        self._input = checked_input_of(env) if hardware else input_of(env)
        # The one that uses the sockets: the caller's thread, or the one that stops hardware.
        self._using_sockets = Lock()
        self._is_at_work = False
        self._late_events: list[Event] = []
        self._end_watch: Callable[[], None] | None = None
        self._request: Step | Reset | None = None
        # The env was reset or stepped, or a session has ended, since it was asked that last.
        self._asks_if_finished = False
        self._trouble = ""
        self._logged_state = Phase.AWAY.value
        self._pause = _SECONDS_BETWEEN_ATTEMPTS[0]
        self._due = 0.0
        self._context = zmq.Context[_Socket]()
        self._dealer: _Socket | None = None
        self._monitor: _Socket
        self._poller = zmq.Poller()
        self._closed = False

    @property
    def state(self) -> str:
        """The state of the connection, in a few words."""
        phase = self._session.phase
        is_well = phase is Phase.SERVING or not self._trouble
        return phase.value if is_well else f"{phase.value} ({self._trouble})"

    def connect(self, timeout: float | None = None) -> None:
        """Dial in and wait until the server lets this client in.

        Args:
            timeout: seconds; None waits without limit.

        Raises:
            TimeoutError: no server let it in; the message has the last known reason.
            ClientRefused: the server will never let this client in.
        """
        if self._closed:
            raise RuntimeError("this client is closed")
        end = None if timeout is None else time.monotonic() + timeout
        num_sessions = self.num_sessions  # A session may end in the wait in which it began.
        while self._session.phase is not Phase.SERVING and self.num_sessions == num_sessions:
            if end is not None and time.monotonic() >= end:
                raise TimeoutError(
                    f"{self._address} did not let {self.name!r} in within {timeout} s: {self.state}"
                )
            self._wait(end)

    def run(self) -> None:
        """Serve until ``env.is_finish()`` is true; connect first if necessary.

        ``is_finish`` is called after every reset, step and `on_disconnect`, and not before.

        Raises:
            ClientRefused: the server will never let this client in.
            Exception: an error of the env in ``is_finish`` or in ``on_disconnect``. Errors of
                steps and resets go to the trainer.
        """
        reason = "the env is finished"
        try:
            self.connect()
            while not self._is_finished():
                if self._request is None:
                    self._wait(None)
                else:
                    request, self._request = self._request, None
                    self._execute(request)
        except BaseException as error:
            reason = f"{type(error).__name__}: {error}"
            raise
        finally:
            if self._is_hardware:
                stop(self._env)
            self._leave(reason)

    def _is_finished(self) -> bool:
        asks, self._asks_if_finished = self._asks_if_finished, False
        return asks and self._env.is_finish()

    def close(self) -> None:
        """Leave the server and close the env; idempotent."""
        if self._closed:
            return
        self._closed = True
        with contextlib.ExitStack() as last:  # Also after a Ctrl-C.
            last.callback(_close, self._env, is_hardware=self._is_hardware)
            last.callback(self._context.destroy, linger=0)
            self._leave("the client was closed")
            if self._end_watch is not None:
                self._end_watch()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- connection -----------------------------------------------------------------

    def _dial(self) -> None:
        """Begin an attempt; a socket that is interrupted here is closed with its context."""
        now = time.monotonic()
        self._due = now + _ATTEMPT_SECONDS
        with signals_held_back():  # An exception within pyzmq could leave a socket to nobody.
            dealer = self._context.socket(zmq.DEALER)
            self._set_options(dealer)
            self._monitor = dealer.get_monitor_socket()
            self._poller = zmq.Poller()
            # The goodbye of a server comes before the end of its connection.
            self._poller.register(dealer, zmq.POLLIN)
            self._poller.register(self._monitor, zmq.POLLIN)
            dealer.connect(self._address)
            self._dealer = dealer

    def _set_options(self, dealer: _Socket) -> None:
        # -1 would have ZMQ drop what nobody has read when the connection ends, as a goodbye.
        dealer.set(zmq.RECONNECT_IVL, _NEVER_MS)
        dealer.set(zmq.LINGER, 0)
        dealer.set(zmq.CONNECT_TIMEOUT, int(1000 * HANDSHAKE_SECONDS))
        set_limits(dealer, self._heartbeat)
        if self._keys is not None:
            dealer.set(zmq.CURVE_SERVERKEY, self._keys.server)
            dealer.set(zmq.CURVE_PUBLICKEY, self._keys.public)
            dealer.set(zmq.CURVE_SECRETKEY, self._keys.secret)
        if "[" in self._address:
            dealer.set(zmq.IPV6, 1)

    def _close_connection(self, linger_ms: int = _LINGER_MS) -> None:
        """End the attempt or the connection, and set the time of the next attempt."""
        if self._dealer is not None:
            with signals_held_back():
                self._poller = zmq.Poller()
                self._dealer.disable_monitor()
                self._monitor.close(linger=0)
                self._dealer.close(linger_ms)
                self._dealer = None
            self._due = time.monotonic() + self._pause
            self._pause = min(2 * self._pause, _SECONDS_BETWEEN_ATTEMPTS[1])

    def _wait(self, until: float | None) -> None:
        """Wait for messages and events, at most `until`, and process them."""
        if self._dealer is None and time.monotonic() >= self._due:
            self._dial()
        # An attempt that has succeeded has no end.
        times = [until, self._due if self._session.phase is Phase.AWAY else None]
        due = min([moment for moment in times if moment is not None], default=None)
        wait_ms = None if due is None else ceil(1000 * max(0.0, due - time.monotonic()))
        if self._dealer is None and wait_ms:
            time.sleep(wait_ms / 1000)  # A poller without sockets doesn't wait.
            return
        self._read(wait_ms)
        is_late = self._dealer is not None and time.monotonic() >= self._due
        if is_late and self._session.phase is Phase.AWAY:
            self._end(f"no server answers at {self._address}")
        self._flush()
        self._log_state()

    def _read(self, wait_ms: int | None) -> None:
        """Wait for messages and events, at most so long, and apply them."""
        for source, _ in self._poller.poll(wait_ms):
            if self._dealer is None:
                break  # An event before this one has ended the connection.
            if source is self._monitor:
                self._read_event()
            else:
                self._receive()

    def _receive(self) -> bool:
        """Read and apply one message. Return False if there is none."""
        if self._dealer is None or (first := next_frame(self._dealer)) is None:
            return False
        self._apply(self._session.receive(receive_parts(self._dealer, first)))
        return True

    def _log_state(self) -> None:
        """Log the state of the connection, once for each trouble."""
        state = self._trouble or self._session.phase.value
        if state != self._logged_state:
            self._logged_state = state
            level = logging.WARNING if self._trouble else logging.INFO
            LOG.log(level, "%s: %s", self.name, self.state)

    def _read_event(self) -> None:
        """Process one event of the connection."""
        try:
            event = recv_monitor_message(self._monitor, zmq.NOBLOCK)["event"]
        except zmq.Again:
            return
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._session.connected()
        elif event == zmq.EVENT_DISCONNECTED:
            # The server's last words say why.
            while self._session.phase is not Phase.AWAY and self._receive():
                pass
            is_new = self._session.phase is Phase.AWAY
            self._end(self._trouble if is_new else "the connection to the server broke")
        elif event == zmq.EVENT_CLOSED:
            self._end(f"no server answers at {self._address}")
        elif event != zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL or not self._trouble:
            # Handshakes that fail for one reason may end with it or without any.
            self._trouble = _REFUSED_HANDSHAKES.get(event, self._trouble)

    def _end(self, cause: str) -> None:
        """Process the end of an attempt or a connection."""
        self._trouble = cause
        event = self._session.disconnected(cause)
        self._close_connection(linger_ms=0)
        self._apply(event)

    def _flush(self) -> None:
        outbox = self._session.outbox
        while outbox:
            parts = outbox.popleft()
            # If the connection is gone, its end will be reported.
            with contextlib.suppress(zmq.Again):
                if self._dealer is not None:
                    send_parts(self._dealer, parts)

    def _leave(self, reason: str) -> None:
        self._session.leave(reason)
        self._request, self._late_events = None, []  # They are of this session.
        self._flush()
        self._close_connection()

    # -- env ------------------------------------------------------------------------

    def _apply(self, event: Event | None) -> None:
        if self._is_at_work and event is not None:
            self._late_events.append(event)
        elif isinstance(event, Step | Reset):
            self._request, self._trouble = event, ""
            self._pause = _SECONDS_BETWEEN_ATTEMPTS[0]
        elif isinstance(event, Welcome):
            self._trouble = ""
            self.num_sessions += 1
            # ZeroMQ takes it for the next connection. In this one, the server's pings say when to
            # give up, if that is earlier.
            self._heartbeat = self._own_heartbeat or event.heartbeat
        elif isinstance(event, Refused):
            self._flush()
            self._close_connection()
            self._trouble = event.text
            if not event.retry:
                raise ClientRefused(
                    f"{self._address} refused the client {self.name!r}: {event.text}"
                )
        elif event is not None:
            self._request = None
            self._flush()
            self._close_connection()
            self._trouble = ""
            LOG.warning("%s: session over: %s", self.name, event.cause)
            self._asks_if_finished = True
            if self._is_hardware and type(self._env).stop is not BaseEnv.stop:
                stop(self._env)
            self._env.on_disconnect()

    def _execute(self, request: Step | Reset) -> None:
        self._asks_if_finished = True
        try:
            if isinstance(request, Reset):
                self._reset(request)
            else:
                self._step(request)
        except Exception as error:  # noqa: BLE001 - it goes to the trainer
            if self._is_hardware:
                stop(self._env)
            LOG.exception("%s: the env raised", self.name)
            self._session.fail(request.number, ErrorText.of(explained(error)))
        self._flush()
        late, self._late_events = self._late_events, []
        for event in late:
            self._apply(event)

    @contextlib.contextmanager
    def _at_work(self) -> Generator[None]:
        """Have a thread watch the session while hardware moves, and stop it if that is over."""
        if not self._is_hardware:
            yield
            return
        if self._end_watch is None:
            self._end_watch = watched(self._to_stop)
        try:
            self._is_at_work = True
            yield
        finally:
            with self._using_sockets:
                self._is_at_work = False

    def _to_stop(self) -> list[BaseEnv]:
        """Return the env if it is at work for a trainer that is gone."""
        with self._using_sockets:
            if not self._is_at_work:
                return []
            if self._session.phase is Phase.SERVING:
                self._read(0)
            return [] if self._session.phase is Phase.SERVING else [self._env]

    def _reset(self, request: Reset) -> None:
        began_ns = time.perf_counter_ns()
        with self._at_work():
            ret = self._env.reset(seed=request.seed, options=request.options)
        busy_ns = time.perf_counter_ns() - began_ns
        self._session.finish(request.number, one_result(self._env, "reset", ret), busy_ns)

    def _step(self, request: Step) -> None:
        began_ns = time.perf_counter_ns()
        with self._at_work():
            returned = self._env_step(self._input(request.action, request.extras))
        busy_ns = time.perf_counter_ns() - began_ns
        self.num_steps += 1
        if self._is_bare:
            observation, reward, terminated, truncated, info = returned
            outcome = ResultFields(observation, reward, terminated, truncated)
            self._session.answer(request.number, outcome, info, {}, busy_ns, time.time_ns())
        else:
            self._session.finish(request.number, one_result(self._env, "step", returned), busy_ns)


_REFUSED_HANDSHAKES: Final[dict[int, str]] = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "the server does not know this client's key",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "the server uses other security: keys on one side only?",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: "the handshake was not completed: the server is busy or "
    "gone, or one side has other keys or none",
}


def is_address(text: str) -> bool:
    """Return True for the whole address of a server: ``tcp://host:port``, IPv6 in brackets."""
    match = _ADDRESS.fullmatch(text)
    return match is not None and 0 < int(match[1]) <= _MAX_PORT


def _own_env(env: Any, name: str) -> BaseEnv:
    """Return a `BaseEnv` for what a client was given.

    Raises:
        ConfigError: it is awaitable.
    """
    if not isinstance(env, BaseEnv):
        make: Any = env if not isinstance(env, gym.Env) else lambda: env
        config = EnvConfig(name=name, backend="callable", task=make, placement="inline")
        env = env_of_callable(config)
    if is_awaitable(env):
        raise ConfigError(
            f"env {env.env_id!r} is awaitable (its step is `async def`), and a client steps its "
            "env in a plain loop; give it plain methods, or run it in a worker of the trainer"
        )
    return env


def _close(env: BaseEnv, *, is_hardware: bool) -> None:
    """Close `env`, hardware after it was stopped."""
    if is_hardware:
        stop_all([env])
    HELD.discard(env)
    env.close()


@contextlib.contextmanager
def _held(env: BaseEnv, *, is_hardware: bool) -> Generator[None]:
    """Hold hardware, until it is closed; close `env` if the client that owns it can't be made.

    Raises:
        ConfigError: its spaces can't be announced.
    """
    if is_hardware:
        HELD.add(env)
    try:
        yield
    except BaseException as error:
        _close(env, is_hardware=is_hardware)
        if isinstance(error, UnsupportedSpace | WireError):
            raise ConfigError(f"env {env.env_id!r} can't be a remote client: {error}") from None
        raise


def _checked_compression(given: Any) -> Literal["zstd"] | None:
    if given not in (None, "zstd"):
        raise ConfigError(f"compression should be 'zstd' or None, not {given!r}")
    return given


def _checked_heartbeat(heartbeat: float | None) -> float | None:
    if heartbeat is not None and not 0.1 <= heartbeat <= MAX_HEARTBEAT:
        raise ConfigError(f"heartbeat: should be 0.1 to {MAX_HEARTBEAT} seconds, not {heartbeat}")
    return heartbeat


def _address(hostname: str, port: int | None) -> str:
    """Return ``tcp://host:port``; an IPv6 host is in brackets."""
    if port is None and is_address(hostname):
        return hostname
    if "://" in hostname or port is None:
        raise ConfigError(
            f"RemoteEnvClient: {hostname!r} with port {port} is no address; give a host and a "
            "port, or tcp://127.0.0.1:5555 alone"
        )
    return f"tcp://{f'[{hostname}]' if ':' in hostname else hostname}:{port}"
