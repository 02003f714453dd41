"""`Link`: the trainer's end of what it shares with one worker, rings and channel.

Requests go into the shared rings, larger things into the channel (a socket pair).
Absent on purpose: the worker's life, which is `process`'s, and what anything means.
"""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

from rlightning_aio.hosts.arena import map_shared
from rlightning_aio.hosts.messages import (
    Attached,
    Built,
    ErrorText,
    NewSchema,
    NotBuilt,
    Raised,
    Reported,
    Result,
    Saved,
    Value,
)
from rlightning_aio.protocol.frames import BELL, CHUNK_BYTES, Frame, FrameKind, FrameReader, encode
from rlightning_aio.protocol.rings import TrainerRings, rings_size

if TYPE_CHECKING:
    import socket
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.hosts.base import Wiring
    from rlightning_aio.hosts.messages import WorkerPlace

__all__ = ["Link"]


class Link:
    """See the module. It lives as long as its worker; the next one gets another.

    Args:
        place: the worker's part of the arena.
        wiring: of the group.
        channel: our end, non-blocking.

    Attributes:
        close_errors: what the worker said when it closed; None before.
        traffic: see `base.Killable.traffic`.
    """

    def __init__(self, place: WorkerPlace, wiring: Wiring, channel: socket.socket) -> None:
        size = rings_size(place.num_envs)
        memory = map_shared(wiring.arena.descriptor, place.rings_offset, size)
        memory[:] = bytes(size)
        self._rings = TrainerRings(memory, place.num_envs, wiring.bell, place.host_id)
        self._host_id = place.host_id
        self._completions = wiring.completions
        self._watcher = wiring.watcher
        self._socket: socket.socket | None = channel
        self._frames = FrameReader()
        self._frames_received = 0
        self._outgoing = bytearray()
        self._frames_outgoing = 0
        self.close_errors: list[tuple[int, ErrorText]] | None = None
        self.traffic = 0
        self._watcher.watch(self)

    def fileno(self) -> int:
        """The channel."""
        assert self._socket is not None
        return self._socket.fileno()

    def hang_up(self) -> None:
        """Close the channel; what was not read is lost."""
        if self._socket is not None:
            self._watcher.unwatch(self)
            self._socket.close()
            self._socket = None

    # -- requests -----------------------------------------------------------------

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[bytes] | None) -> None:
        """See `base.Host.submit`."""
        if arguments is None:
            if self._rings.request(entries):
                self._write(BELL)
            return
        frames = [
            encode(FrameKind.REQUEST, entry, packed)
            for entry, packed in zip(entries.tolist(), arguments, strict=True)
        ]
        self._frames_outgoing += len(frames)
        self._write(b"".join(frames))

    def send(self, kind: FrameKind, number: int = 0, payload: bytes = b"") -> None:
        """Send a frame, as soon as the worker reads."""
        self._frames_outgoing += 1
        self._write(encode(kind, number, payload))

    def _write(self, data: bytes) -> None:
        if self._outgoing:
            self._outgoing += data
            return
        sent = self._write_some(data)
        if sent < len(data):
            self._outgoing += data[sent:]
            self._watcher.watch_writable(self, True)
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
            # The worker is gone; its end is announced by the fork server.
            return len(data)

    def on_writable(self) -> None:
        """See `base.Source.on_writable`."""
        sent = self._write_some(self._outgoing)
        del self._outgoing[:sent]
        self.traffic += sent
        if not self._outgoing:
            self._watcher.watch_writable(self, False)
            self._all_written()

    def _all_written(self) -> None:
        # Only now: a worker that is told of a frame expects to find all of it.
        while self._frames_outgoing:
            self._frames_outgoing -= 1
            self._rings.count_frame()

    # -- replies ------------------------------------------------------------------

    def on_readable(self) -> None:
        """See `base.Source.on_readable`. Who waits for reports polls for them, of all workers
        at once.
        """
        self.read_channel()

    def poll(self) -> None:
        """See `base.Polled.poll`."""
        entries = self._rings.reports()
        if len(entries):
            # What was sent before these reports comes before them.
            if self._rings.frames_from_worker() > self._frames_received:
                self.read_channel()
            self._completions.append(Reported(self._host_id, entries))

    def read_channel(self) -> None:
        """Read all frames there are."""
        while self._socket is not None:
            try:
                data = self._socket.recv(CHUNK_BYTES)
            except BlockingIOError:
                return
            except ConnectionResetError:
                data = b""
            if not data:
                # The fork server holds the other end until it has buried the worker, and
                # tells why it died; there is nothing more to hear from here.
                self.hang_up()
                return
            self.traffic += len(data)
            for frame in self._frames.feed(data):
                self._frames_received += 1
                self._receive(frame)
            if len(data) < CHUNK_BYTES:
                return

    def catch_up(self) -> None:
        """Write what waits, as far as it can go, and read all that there is."""
        if self._outgoing:
            self.on_writable()
        self.read_channel()
        self.poll()

    def _receive(self, frame: Frame) -> None:
        kind, number, payload = frame
        host_id, tell = self._host_id, self._completions.append
        if kind == FrameKind.RESULT:
            tell(Result(host_id, number, payload))
        elif kind == FrameKind.SAVED:
            tell(Saved(host_id, number >> 1, payload, bool(number & 1)))
        elif kind == FrameKind.INFO_SCHEMA:
            tell(NewSchema(host_id, number, pickle.loads(payload)))
        elif kind == FrameKind.ERROR:
            tell(Raised(host_id, number, pickle.loads(payload)))
        elif kind == FrameKind.START_ERROR:
            tell(NotBuilt(host_id, number, pickle.loads(payload)))
        elif kind == FrameKind.ATTACHED:
            tell(Attached(host_id))
        elif kind == FrameKind.CLOSED:
            self.close_errors = pickle.loads(payload)
        else:
            self._receive_object(kind, number, payload)

    def _receive_object(self, kind: int, number: int, payload: bytes) -> None:
        """Take in an object of the user's, whose class may be unknown here."""
        host_id, tell = self._host_id, self._completions.append
        value: Any
        try:
            value = pickle.loads(payload)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # What it is made by may raise anything.
            text = ErrorText.of(error)
            starts = kind == FrameKind.STARTED
            tell(NotBuilt(host_id, 0, text) if starts else Raised(host_id, number, text))
            return
        tell(Built(host_id, value) if kind == FrameKind.STARTED else Value(host_id, number, value))

    # -- the worker, as the rings show it ---------------------------------------------

    def executing(self) -> tuple[int, int]:
        """See `base.Killable.executing`."""
        return self._rings.current()

    def last_requests(self) -> tuple[int, ...]:
        """Entries, that first which it may be executing; see `messages.Death`."""
        return (self._rings.current()[0], *self._rings.last_requests())
