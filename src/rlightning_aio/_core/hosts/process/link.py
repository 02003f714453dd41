"""`Link`: the trainer's end of the rings and the channel that it shares with one worker.

Requests go into the shared rings, larger data into the channel (a socket pair).
Left out on purpose: the life of the worker (see `host`), and the effects of messages.
"""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

from rlightning_aio._core.hosts.completion_frames import completion_in
from rlightning_aio._core.hosts.messages import Closed, Reported
from rlightning_aio.protocol.frames import BELL, CHUNK_BYTES, Frame, FrameKind, FrameReader, encode
from rlightning_aio.protocol.rings import TrainerRings

if TYPE_CHECKING:
    import socket
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import WorkerPlace
    from rlightning_aio.protocol.error_text import ErrorText


class Link:
    """The connection to one worker; its replacement gets a new one.

    Args:
        place: the part of the arena that belongs to the worker.
        memory: that part; it is cleared.
        wiring: of the group.
        channel: non-blocking end of the trainer.

    Attributes:
        close_errors: what the envs raised when the worker closed; None before.
        traffic: see `base.Killable.traffic`.
    """

    def __init__(
        self, place: WorkerPlace, memory: memoryview, wiring: Wiring, channel: socket.socket
    ) -> None:
        self._rings = TrainerRings(memory, place.num_envs, wiring.bell, place.host_id)
        self._host_id = place.host_id
        self._completions = wiring.completions
        self._driver = wiring.driver
        self._socket: socket.socket | None = channel
        self._frames = FrameReader()
        self._outgoing = bytearray()
        self._frames_outgoing = 0
        self.close_errors: list[tuple[int, ErrorText]] | None = None
        self.traffic = 0
        self._all_rings = wiring.rings
        self._all_rings[place.host_id] = self._rings.ring(self.wake)
        self._driver.watch(self)

    def fileno(self) -> int:
        """Return the descriptor of the channel."""
        assert self._socket is not None
        return self._socket.fileno()

    def close(self) -> None:
        """Take the ring away, and close the channel; unread data is lost. To be called once."""
        self._all_rings[self._host_id] = None
        self._close_channel()

    def _close_channel(self) -> None:
        if self._socket is not None:
            self._driver.unwatch(self)
            self._socket.close()
            self._socket = None

    # -- requests -----------------------------------------------------------------

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[bytes] | None) -> None:
        if arguments is None:
            if self._rings.request(entries):
                self.wake()
            return
        frames = [
            encode(FrameKind.REQUEST, entry, packed)
            for entry, packed in zip(entries.tolist(), arguments, strict=True)
        ]
        self._frames_outgoing += len(frames)
        self._write(b"".join(frames))

    def wake(self) -> None:
        """Wake the sleeping worker: its ring has requests."""
        if self._socket is None or self._outgoing:
            self._write(BELL)
            return
        try:
            self._socket.send(BELL)  # Few enough bytes to be sent whole or not at all.
        except OSError:
            self._write(BELL)

    def send(self, kind: FrameKind, number: int = 0, payload: bytes = b"") -> None:
        """Send a frame, now or when the channel has room."""
        self._frames_outgoing += 1
        self._write(encode(kind, number, payload))

    def _write(self, data: bytes) -> None:
        if self._outgoing:
            self._outgoing += data
            return
        sent = self._write_some(data)
        if sent < len(data):
            self._outgoing += data[sent:]
            self._driver.watch_writable(self, True)
        elif self._frames_outgoing:
            self._all_written()

    def _write_some(self, data: bytes | bytearray) -> int:
        if self._socket is None:
            return len(data)
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0
        except (BrokenPipeError, ConnectionResetError):
            # The worker is gone; the fork server will report its exit.
            return len(data)
        except OSError as error:
            if error.errno not in (errno.ENOBUFS, errno.ENOMEM):
                raise
            return 0

    def on_writable(self) -> None:
        sent = self._write_some(self._outgoing)
        del self._outgoing[:sent]
        self.traffic += sent
        if not self._outgoing:
            self._driver.watch_writable(self, False)
            self._all_written()

    def _all_written(self) -> None:
        # Only now: a worker expects a counted frame to be complete.
        while self._frames_outgoing:
            self._frames_outgoing -= 1
            self._rings.count_frame()

    # -- replies ------------------------------------------------------------------

    def on_readable(self) -> None:
        """Read all frames. Reports come by `poll`, from the rings of all workers."""
        while self._socket is not None:
            try:
                data = self._socket.recv(CHUNK_BYTES)
            except BlockingIOError:
                return
            except ConnectionResetError:
                data = b""
            if not data:
                # The fork server keeps the other end open until it has handled the exit, and it
                # reports the cause. Until that is read, the ring takes further requests.
                self._close_channel()
                return
            self.traffic += len(data)
            if data == BELL and self._frames.is_empty:
                return
            for frame in self._frames.feed(data):
                self._rings.frame_seen()
                self._receive(frame)
            if len(data) < CHUNK_BYTES:
                return

    def stop(self, index: int, number: int) -> None:
        self._rings.stop(index, number)

    def poll(self) -> None:
        entries = self._rings.reports()
        if len(entries):
            # Frames that were sent before these reports come first.
            if self._rings.has_frame():
                self.on_readable()
            self._completions.append(Reported(self._host_id, entries))

    def catch_up(self) -> None:
        """Write pending data as far as possible, and read all replies."""
        if self._outgoing:
            self.on_writable()
        self.on_readable()
        self.poll()

    def _receive(self, frame: Frame) -> None:
        completion = completion_in(self._host_id, frame)
        if isinstance(completion, Closed):  # Posted when the worker has ended.
            self.close_errors = completion.errors
        else:
            self._completions.append(completion)

    # -- the state of the worker ------------------------------------------------------

    def current_request(self) -> tuple[int, int]:
        return self._rings.current()

    def last_requests(self) -> tuple[int, ...]:
        """Return entries that it may have been executing, as in `messages.Death`."""
        return (self._rings.current()[0], *self._rings.last_requests())
