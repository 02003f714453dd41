"""A process host: data from the rings, the channel, and the fork server."""

from __future__ import annotations

import errno
import signal
from collections import deque
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock, patch

import numpy as np
import pytest
from protocol.memory_of_rings import unused

from rlightning_aio._core.hosts.arena import Arena
from rlightning_aio._core.hosts.base import Wiring
from rlightning_aio._core.hosts.completion_frames import frame_of
from rlightning_aio._core.hosts.messages import (
    Death,
    Died,
    NewSchema,
    Reported,
    Result,
    StartOrder,
)
from rlightning_aio._core.hosts.process.host import ForkServerHandle, ProcessHost, _surroundings
from rlightning_aio.config import EnvConfig
from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.frames import BELL, FrameKind, FrameReader, encode
from rlightning_aio.protocol.info import InfoSchema
from rlightning_aio.protocol.rings import (
    TrainerBell,
    WorkerBell,
    WorkerRings,
    bell_size,
    rings_size,
)

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterator

    from rlightning_aio._core.hosts.process.fork_messages import Fork

pytestmark = pytest.mark.usefixtures("implementation")

CONFIG = EnvConfig(name="two", backend="gymnasium", task="CartPole-v1", num_workers=2)
SCHEMA = InfoSchema.of({"x": 1.5})


class StandIn(ForkServerHandle):
    """Starts nothing, and records orders."""

    def note_used(self, host: Any, close_seconds: float) -> None: ...

    def __init__(self) -> None:
        self.orders: list[Fork] = []
        self.channels: list[socket.socket] = []
        self.killed: list[bool] = []

    def on_readable(self) -> None: ...

    def fork(self, host: ProcessHost, channel: socket.socket, arena: Arena, order: Fork) -> None:
        self.orders.append(order)
        self.channels.append(channel)

    def kill(self, host: ProcessHost, *, dump: bool) -> None:
        self.killed.append(dump)


class Scene:
    """A host of two envs, its driver, and the worker's ends of rings and channel."""

    def __init__(self) -> None:
        self.completions: Any = deque()
        self.rings_of_group: list[Any] = [None]
        self.arena = Arena()
        self.bell_offset = self.arena.append(bell_size(1))
        memory = self.arena.map(self.bell_offset, bell_size(1))
        self.bell = TrainerBell(memory, 1)
        self.fork_server = StandIn()
        self.watched: list[Any] = []
        self.writable: set[Any] = set()
        wiring = Wiring(
            completions=self.completions,
            driver=self,
            arena=self.arena,
            bell=self.bell,
            bell_offset=self.bell_offset,
            rings=self.rings_of_group,
            num_hosts=1,
            configs=[CONFIG],
            objection=lambda meta: None,
            busy_since=lambda slot: None,
            resources={(ForkServerHandle, *_surroundings(CONFIG)): self.fork_server},
        )
        order = StartOrder(CONFIG, None, (0, 1), (None, None), spins=False)
        self.host = ProcessHost(0, 0, order, wiring)
        self.rung = 0

    # -- a driver

    def watch(self, source: Any) -> None:
        self.watched.append(source)

    def unwatch(self, source: Any) -> None:
        self.watched.remove(source)
        self.writable.discard(source)

    def watch_writable(self, source: Any, wanted: bool) -> None:
        (self.writable.add if wanted else self.writable.discard)(source)

    def wake(self) -> None: ...

    # -- a worker

    def start(self) -> None:
        self.host.start()
        place = self.fork_server.orders[-1].place
        bell_memory = self.arena.map(place.bell_offset, bell_size(1))
        size = rings_size(place.num_envs)
        memory = self.arena.map(place.rings_offset, size)
        self.rings = WorkerRings(memory, place.num_envs, WorkerBell(bell_memory, 1, place.host_id))
        self.frames = FrameReader()

    @property
    def channel(self) -> socket.socket:
        return self.fork_server.channels[-1]

    def send(self, kind: FrameKind, number: int = 0, payload: bytes = b"") -> None:
        self.channel.send(encode(kind, number, payload))
        self.rings.count_frame()

    def serve(self, *in_rows: int) -> None:
        """Execute waiting requests; report those of `in_rows`, by default all."""
        is_in_row = lambda one: not in_rows or one in in_rows  # noqa: E731
        side, fence = self.rings.side, self.rings.fence
        kernel.serve(side, is_in_row, unused, self.ring, unused, [], 0, fence)

    def ring(self) -> None:
        self.rung += 1
        self.channel.send(BELL)

    def received(self) -> list[Any]:
        """Return the frames from the trainer."""
        return self.frames.feed(self.channel.recv(1 << 20))

    # -- the trainer

    def read(self) -> None:
        """Read as the driver does when the channel is readable, then poll as waiters do."""
        for source in list(self.watched):
            source.on_readable()
        self.host.poll()

    def posted(self) -> list[Any]:
        """Return new completions; entries of reports as lists."""
        found = [
            ("reported", one.entries.tolist()) if isinstance(one, Reported) else one
            for one in self.completions
        ]
        self.completions.clear()
        return found

    def close(self) -> None:
        self.host.release()
        assert not self.watched
        for channel in self.fork_server.channels:
            channel.close()
        self.arena.close()
        # Mapped parts keep the arena, too.
        self.bell.release()
        vars(self).pop("rings", None)


@pytest.fixture
def scene() -> Iterator[Scene]:
    scene = Scene()
    yield scene
    scene.close()


@pytest.fixture
def started(scene: Scene) -> Scene:
    scene.start()
    return scene


def step(number: int, slot: int) -> int:
    return entry(number, slot, Operation.STEP)


def steps(number: int) -> np.ndarray:
    return np.array([step(number, slot) for slot in range(2)])


# -- rings and channel


def test_a_bell_that_is_read_with_a_frame_can_be_armed_again(started: Scene) -> None:
    """The next one arrives even if the trainer read this one together with a frame."""
    scene, bell = started, started.bell
    for number in (1, 2, 3):
        scene.host.submit(steps(number))
        bell.arm(bell.goal(2), at_last=False)
        assert bell.unread() == 0
        scene.serve()
        assert scene.rung == number
        scene.send(*frame_of(NewSchema(0, number, SCHEMA)))
        # The channel did not wake the trainer, but something else.
        scene.host.poll()
        assert scene.posted() == [
            NewSchema(0, number, SCHEMA),
            ("reported", steps(number).tolist()),
        ]
        assert bell.unread() == 0


def test_data_that_the_channel_has_no_room_for_is_written_later(started: Scene) -> None:
    """The order stays, and a frame is counted only when all of it is written."""
    started.received()
    started.rings.frame_seen()
    large = bytes(3 << 20)
    started.host.submit(steps(1), [large, b"small"])
    (host,) = started.writable
    assert not started.rings.has_frame()
    found: list[Any] = []
    while len(found) < 2:
        found += started.received()
        if started.writable:
            host.on_writable()
    assert [(f.number, len(f.payload)) for f in found] == [
        (step(1, 0), len(large)),
        (step(1, 1), 5),
    ]
    assert not started.writable
    for _ in range(2):
        assert started.rings.has_frame()
        started.rings.frame_seen()
    assert not started.rings.has_frame()


@pytest.mark.parametrize("code", [errno.ENOBUFS, errno.ENOMEM])
def test_data_that_the_system_has_no_memory_for_is_written_later(started: Scene, code: int) -> None:
    """A call that has numbered its requests can't take them back."""
    started.received()
    host: Any = started.host
    broken = Mock(send=Mock(side_effect=OSError(code, "no memory")))
    with patch.object(host, "_socket", broken):
        started.host.submit(steps(1), [b"first", b"second"])
    assert started.writable == {host}
    host.on_writable()
    assert [frame.payload for frame in started.received()] == [b"first", b"second"]


def test_catching_up_reads_everything_and_returns_whether_anything_moved(started: Scene) -> None:
    """It reads part of a frame, the rest of it, and a report, before they wake the trainer."""
    frame = encode(FrameKind.RESULT, step(1, 0), b"out of band")
    started.host.submit(steps(1))
    traffic = started.host.traffic
    assert not started.host.catch_up()
    started.channel.send(frame[:20])
    assert started.host.catch_up()
    assert started.host.traffic != traffic
    assert not started.host.catch_up()
    started.serve(step(1, 1))
    started.channel.send(frame[20:])
    started.rings.count_frame()
    assert started.host.catch_up()
    assert started.posted() == [
        Result(0, step(1, 0), b"out of band"),
        ("reported", [step(1, 1)]),
    ]
    assert not started.host.catch_up()


def test_catching_up_writes_pending_data(started: Scene) -> None:
    """It writes as far as the worker reads."""
    started.received()
    started.host.submit(steps(1)[:1], [bytes(3 << 20)])
    assert not started.host.catch_up()
    traffic = started.host.traffic
    started.received()
    assert started.host.catch_up()
    assert started.host.traffic != traffic
    assert not started.host.catch_up()


# -- life


def test_a_death_is_posted_once_with_its_possible_last_requests(started: Scene) -> None:
    """Earlier messages of the worker come first; all unanswered requests are among the last."""
    started.host.submit(steps(1))
    started.serve()
    started.host.submit(steps(2))
    started.send(*frame_of(NewSchema(0, 1, SCHEMA)))
    started.rings.begin(step(2, 1), 5)
    assert started.host.current_request() == (step(2, 1), 5)
    started.channel.close()
    started.read()
    started.host.on_exit(-signal.SIGSEGV, "last words")
    schema, reported, died = started.posted()
    assert schema == NewSchema(0, 1, SCHEMA)
    assert reported == ("reported", steps(1).tolist())
    assert isinstance(died, Died)
    assert died.death.cause == "was killed by SIGSEGV"
    assert (died.death.exit_code, died.death.stderr_tail) == (-signal.SIGSEGV, "last words")
    assert died.death.requests == (step(2, 1), *steps(1).tolist(), *steps(2).tolist())
    started.host.on_exit(0, "")
    started.host.on_end(Death("ended with its fork server: it ended"))
    assert started.posted() == []
    assert not started.watched
    assert started.host.current_request() == (0, 0)
    # Requests to a dead worker are dropped without an error.
    started.host.submit(steps(3))
    started.host.poll()
    assert started.posted() == []


def test_the_ring_of_a_dead_worker_takes_requests_until_its_death_is_posted(started: Scene) -> None:
    """The group puts them there as long as it knows of no death."""
    started.channel.close()
    started.read()
    assert not started.watched
    (ring,) = started.rings_of_group
    started.host.submit(steps(1))
    ring.wake()
    started.host.on_exit(3, "")
    assert started.rings_of_group == [None]
    (died,) = started.posted()
    assert set(steps(1).tolist()) <= set(died.death.requests)


def test_a_replacement_has_a_new_channel(started: Scene) -> None:
    """Reports and frames of the former worker are dropped, and counts are correct."""
    bell, old = started.bell, started.channel
    started.host.submit(steps(1))
    started.serve(step(1, 0))
    started.host.on_exit(1, "")
    started.posted()
    started.host.submit(steps(2))
    started.start()
    assert started.rings.requests() == []
    assert bell.unread() == 0
    with pytest.raises(BrokenPipeError):
        old.send(encode(FrameKind.RESULT, step(1, 1), b"late"))
    started.host.submit(steps(3))
    bell.arm(bell.goal(2), at_last=False)
    started.serve()
    assert started.rung == 1
    started.read()
    assert started.posted() == [("reported", steps(3).tolist())]
