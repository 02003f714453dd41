"""Simulated sockets, and what waits for them: `epoll`, and event loops.

They do what pairs of Unix sockets do. What is sent can be received at once, in order. A stream
takes as much as there is room for, so data may be cut anywhere, and a receiver may see the first
part before the rest is sent. When the last descriptor of one end is closed, the other end reads
what is left, then an error if the closed end had not read everything, then the end of the stream.
"""

from __future__ import annotations

import array
import asyncio
import errno
import itertools
import os
import select
import selectors
import socket
from collections import deque
from typing import TYPE_CHECKING, Any, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from simulator.world import World

__all__ = ["Epoll", "Loop", "SimulatedSocket", "Sockets", "run_in_process"]

T = TypeVar("T")

_FIRST_DESCRIPTOR: Final = 1 << 24
"""No real descriptor is as large."""
_WHOLE_BYTES: Final = 256
"""So few are sent whole or not at all."""

_close, _dup, _set_inheritable = os.close, os.dup, os.set_inheritable


class _End:
    """One end of a pair: what it has received, and who has it open."""

    def __init__(self, *, packets: bool) -> None:
        self.name = "the trainer"
        self.packets = packets
        self.received: Any = deque() if packets else bytearray()
        self.received_ns = 0
        self.descriptors = 0
        self.is_shut = self.is_reset = False
        self.holders: list[Any] = []
        self.peer: _End

    def wake(self) -> None:
        for holder in self.holders:
            holder.wake()

    def shut(self) -> None:
        """Send and receive nothing any more."""
        self.is_shut = True
        self.peer.is_reset = bool(self.received)
        self.peer.wake()
        self.wake()


class Sockets:
    """All simulated sockets of a world, and the real descriptors of its processes."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._numbers = itertools.count(_FIRST_DESCRIPTOR)
        self.by_number: dict[int, Any] = {}
        self._real: set[int] = set()
        self.stream_room = world.rng.choice((512, 4096, 65536, 212_992))
        self.packet_room = world.rng.choice((2, 10, 200))

    def pair(
        self, family: int = socket.AF_UNIX, kind: int = socket.SOCK_STREAM, proto: int = 0
    ) -> tuple[SimulatedSocket, SimulatedSocket]:
        """See `socket.socketpair`."""
        del family, proto
        if self._world.refuses():
            raise OSError(errno.EMFILE, "too many open files")
        packets = kind == socket.SOCK_SEQPACKET
        ends = _End(packets=packets), _End(packets=packets)
        ends[0].peer, ends[1].peer = ends[1], ends[0]
        return self.open(ends[0]), self.open(ends[1])

    def open(self, end: _End) -> SimulatedSocket:
        """Make another descriptor of an end."""
        made = SimulatedSocket(self._world, end)
        made.number = self.adopt(made)
        return made

    def adopt(self, source: Any) -> int:
        """Give something that can be waited for a descriptor."""
        number = next(self._numbers)
        self.by_number[number] = source
        return number

    def duplicate(self, descriptor: int) -> int:
        """See `os.dup`."""
        if descriptor >= _FIRST_DESCRIPTOR:
            return self.open(self.by_number[descriptor].end).fileno()
        made = _dup(descriptor)
        self._real.add(made)
        return made

    def close_descriptor(self, descriptor: int) -> None:
        """See `os.close`."""
        running = self._world.running
        if running is not None:
            running.descriptors.discard(descriptor)
        if descriptor >= _FIRST_DESCRIPTOR:
            self.by_number.pop(descriptor).close()
            return
        self._real.discard(descriptor)
        _close(descriptor)

    @staticmethod
    def set_inheritable(descriptor: int, inheritable: bool) -> None:
        """See `os.set_inheritable`."""
        if descriptor < _FIRST_DESCRIPTOR:
            _set_inheritable(descriptor, inheritable)

    def close(self) -> None:
        """Close all real descriptors."""
        for descriptor in self._real:
            _close(descriptor)
        self._real.clear()


class WakeUp:
    """See `descriptors.WakeUp`. Nothing happens in between, as its owner holds a lock."""

    def __init__(self, sockets: Sockets) -> None:
        self._sockets = sockets
        self._is_set = False
        self._number = sockets.adopt(self)

    def fileno(self) -> int:
        return self._number

    def set(self) -> None:
        self._is_set = True

    def clear(self) -> None:
        assert self._is_set
        self._is_set = False

    def close(self) -> None:
        self._sockets.by_number.pop(self._number)

    def is_readable(self) -> bool:
        return self._is_set

    def is_writable(self) -> bool:
        return True

    def is_hung_up(self) -> bool:
        return False


class SimulatedSocket:
    """A descriptor of an end; see `socket.socket`."""

    def __init__(self, world: World, end: _End) -> None:
        self.end = end
        self.number = -1
        self._world = world
        self._is_blocking = True
        end.descriptors += 1

    def fileno(self) -> int:
        return self.number

    def setblocking(self, is_blocking: bool) -> None:
        self._is_blocking = is_blocking

    def close(self) -> None:
        number, self.number = self.number, -1
        if number < 0:
            return
        self._world.sockets.by_number.pop(number, None)
        end = self.end
        end.descriptors -= 1
        if end.descriptors:
            return
        if not end.is_shut:
            end.shut()
        if end.packets:  # Descriptors on the way to it are closed.
            for _, passed in end.received:
                for descriptor in passed:
                    self._world.sockets.close_descriptor(descriptor)

    def shutdown(self, how: int) -> None:
        del how
        self.end.shut()

    # -- readiness ----------------------------------------------------------------

    def is_readable(self) -> bool:
        end = self.end
        return bool(end.received) or end.is_reset or end.is_shut or end.peer.is_shut

    def room(self) -> int:
        """How much it can send now: bytes, or packets."""
        sockets, received = self._world.sockets, self.end.peer.received
        return (sockets.packet_room if self.end.packets else sockets.stream_room) - len(received)

    def is_writable(self) -> bool:
        return self.end.is_shut or self.end.peer.is_shut or self.room() > 0

    def is_hung_up(self) -> bool:
        return self.end.peer.is_shut

    def _wait(self, ready: Callable[[], bool], flags: int) -> None:
        if ready():
            return
        if flags & socket.MSG_DONTWAIT or not self._is_blocking:
            raise BlockingIOError(errno.EAGAIN, "it would block")
        self._world.wait_for(ready, None)

    # -- data ---------------------------------------------------------------------

    def send(self, data: Any, flags: int = 0) -> int:
        """Send a part of `data`; the receiver may get that in two parts."""
        world, end = self._world, self.end
        world.point()
        self._wait(self.is_writable, flags)
        if end.is_shut or end.peer.is_shut:
            raise BrokenPipeError(errno.EPIPE, "the other end is closed")
        if end.packets:
            self._deliver((bytes(data), []))
            return len(data)
        size = len(data) if len(data) <= _WHOLE_BYTES else min(len(data), self.room())
        first = size
        if size > _WHOLE_BYTES and world.rng.random() < 0.2:
            first = world.rng.randrange(1, size)
            self._deliver(data[:first])
            world.point(interruptible=False)
            if end.peer.is_shut:
                return size
            self._deliver(data[first:size])
        else:
            self._deliver(data[:size])
        world.point()
        return size

    def sendall(self, data: Any) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[self.send(rest) :]

    def sendmsg(self, buffers: Sequence[bytes], ancillary: Any = (), flags: int = 0) -> int:
        world, end = self._world, self.end
        world.point()
        self._wait(self.is_writable, flags)
        if end.is_shut or end.peer.is_shut:
            raise BrokenPipeError(errno.EPIPE, "the other end is closed")
        passed = [number for _, _, numbers in ancillary for number in numbers]
        data = b"".join(buffers)
        self._deliver((data, [world.sockets.duplicate(number) for number in passed]))
        return len(data)

    def _deliver(self, data: Any) -> None:
        end = self.end
        if end.packets:
            end.peer.received.append(data)
            self._world.note("{} sends {} a packet", end.name, end.peer.name)
        else:
            end.peer.received += data
            self._world.note("{} sends {} {} bytes", end.name, end.peer.name, len(data))
        end.peer.received_ns = self._world.now_ns
        end.peer.wake()

    def recv(self, size: int, flags: int = 0) -> bytes:
        """Receive what is there."""
        end = self.end
        self._world.point()
        self._wait(self.is_readable, flags)
        if not end.received:
            return self._nothing()
        data = bytes(end.received[:size])
        del end.received[:size]
        end.peer.wake()
        return data

    def _nothing(self) -> bytes:
        if self.end.is_reset:
            self.end.is_reset = False
            raise ConnectionResetError(errno.ECONNRESET, "the other end is closed")
        return b""

    def recvmsg(self, size: int, ancillary_size: int = 0, flags: int = 0) -> Any:
        del size, ancillary_size
        end = self.end
        self._world.point()
        self._wait(self.is_readable, flags)
        if not end.received:
            return self._nothing(), [], 0, None
        data, numbers = end.received.popleft()
        end.peer.wake()
        rights = array.array("i", numbers).tobytes()
        passed = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, rights)] if numbers else []
        return data, passed, 0, None


# -- what waits -----------------------------------------------------------------------


class Epoll:
    """See `select.epoll`."""

    def __init__(self, world: World) -> None:
        self.closed = False
        self._world = world
        self._masks: dict[int, int] = {}

    def register(self, descriptor: int, mask: int) -> None:
        if descriptor in self._masks:
            raise FileExistsError(errno.EEXIST, "it is registered")
        self._masks[descriptor] = mask

    def modify(self, descriptor: int, mask: int) -> None:
        if descriptor not in self._masks:
            raise FileNotFoundError(errno.ENOENT, "it is not registered")
        self._masks[descriptor] = mask

    def unregister(self, descriptor: int) -> None:
        if self._masks.pop(descriptor, None) is None:
            raise FileNotFoundError(errno.ENOENT, "it is not registered")

    def close(self) -> None:
        self.closed = True

    def poll(self, timeout: float | None = None) -> list[tuple[int, int]]:
        if self.closed:
            raise ValueError("I/O operation on closed epoll object")
        seconds = None if timeout is None or timeout < 0 else timeout
        self._world.point()
        return self._world.wait_for(self._ready, seconds)

    def _ready(self) -> list[tuple[int, int]]:
        if self.closed:
            raise OSError(errno.EBADF, "it was closed")
        found = [
            (descriptor, events)
            for descriptor, mask in self._masks.items()
            if (events := _events(self._world.sockets.by_number.get(descriptor), mask))
        ]
        if len(found) > 1:
            self._world.rng.shuffle(found)
        return found


def _events(one: Any, mask: int) -> int:
    if one is None:  # It was closed.
        return 0
    events = 0
    if mask & select.EPOLLIN and one.is_readable():
        events |= select.EPOLLIN
    if mask & select.EPOLLOUT and one.is_writable():
        events |= select.EPOLLOUT
    if one.is_hung_up():
        events |= select.EPOLLHUP
    return events


class _Selector(selectors._BaseSelectorImpl):  # pyright: ignore[reportPrivateUsage]
    """The selector of a `Loop`."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self._world = world
        self.has_other_work: Callable[[], bool]

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self._world.point()
        self._world.wait_for(lambda: self._ready() or self.has_other_work(), timeout)
        return self._ready()

    def _ready(self) -> list[tuple[selectors.SelectorKey, int]]:
        found: list[tuple[selectors.SelectorKey, int]] = []
        for descriptor, key in self.get_map().items():
            one = self._world.sockets.by_number.get(descriptor)
            events = 0
            if one is not None and key.events & selectors.EVENT_READ and one.is_readable():
                events |= selectors.EVENT_READ
            if one is not None and key.events & selectors.EVENT_WRITE and one.is_writable():
                events |= selectors.EVENT_WRITE
            if events:
                found.append((key, events))
        if len(found) > 1:
            self._world.rng.shuffle(found)
        return found


class Loop(asyncio.SelectorEventLoop):
    """An event loop of the trainer, or of a process of a world."""

    def __init__(self, world: World) -> None:
        selector = _Selector(world)
        selector.has_other_work = lambda: bool(self._ready)
        super().__init__(selector)

    # A handler of a signal runs while it selects, which ends when there is work.
    def _make_self_pipe(self) -> None: ...

    def _close_self_pipe(self) -> None: ...

    def _write_to_self(self) -> None: ...


def run_in_process(world: World, main: Coroutine[Any, Any, T]) -> T:
    """Run `main` on an event loop of a simulated process, which handles no signals."""
    loop = Loop(world)
    try:
        return loop.run_until_complete(main)
    finally:
        loop.close()
