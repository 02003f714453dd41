"""What does an env server add to the network? Steps of clients, which are forked.

    python benchmarks/remote.py                             # all of it, under two minutes
    python benchmarks/remote.py --only "20 Hz" --seconds 60 --rounds 3

First 1 and 8 clients without work, beside bare ZMQ: a ROUTER and as many DEALERs that send each
other messages of the same sizes; with and without encryption. The time per step is with one client
a round trip, with eight the share of each while all are busy. Then the two cameras of one client:
as they are, compressed by the client, and as JPEG in the info, made by the env and read by the
trainer. Then 64 clients that end 20 steps a second, beside bare ZMQ again: their round trips are
from the end of a step to the next request, and memory is that of the trainer's process.
"""

from __future__ import annotations

import io
import multiprocessing as mp
import os
import signal
import socket
import statistics
import struct
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import zmq
from harness import Contender, Question, Target, busy_ns, main

from rlightning_aio import sync
from rlightning_aio.protocol.net.wire import ClientResult, Step, Writer
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.remote.keys import make_keys, read_client_keys, read_server_keys

if TYPE_CHECKING:
    from collections.abc import Callable

LOOPBACK = "tcp://127.0.0.1"
PERIOD = 1 / 20
NUM_PICTURES, QUALITY = 8, 90
TIME, CLIENT, TRAINER = "µs per step", "clients, CPU µs/step", "trainer, CPU µs/step"
KIB, TRIP, MEMORY = "KiB/step", "p99 of a round trip, ms", "memory, MiB"
REQUEST = Writer().write(Step(number=2**20), [bytes(6 * 4)])
RESULT = ClientResult(number=2**20, busy_ns=2**15, reward=0.0, terminated=False, truncated=False)
REPLY = Writer().write(RESULT, [bytes(17 * 8)])
"""Messages with the sizes of a step and of its result."""


class CheetahSized(gym.Env[Any, Any]):
    """Does nothing, with the spaces of HalfCheetah-v5."""

    observation_space: gym.Space[Any] = gym.spaces.Box(-np.inf, np.inf, (17,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
    observation = np.zeros(17)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        del seed, options
        return self.observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, info = self.reset(options=action)
        return observation, 0.0, False, False, info


class Paced(CheetahSized):
    """Ends 20 steps a second; a reward is the time since the step before, in seconds."""

    ended = 0.0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        del action
        now = time.monotonic()
        trip = now - (self.ended or now)
        # Clients don't begin all at once.
        time.sleep((os.getpid() * PERIOD / 64 - now) % PERIOD)
        self.ended = time.monotonic()
        return self.observation, trip, False, False, {}


class Cameras(CheetahSized):
    """Shows the same pictures of a falling humanoid by two cameras, one pair after the other."""

    def __init__(self, height: int, width: int, *, jpeg: bool) -> None:
        os.environ.setdefault("MUJOCO_GL", "egl")
        look: dict[str, Any] = {"height": height, "width": width, "render_mode": "rgb_array"}
        seen: list[list[Any]] = []
        for camera in (-1, 0):
            env = gym.make("Humanoid-v5", camera_id=camera, **look)
            env.reset(seed=0)
            pictures = [(env.step(np.ones(17)), env.render())[1] for _ in range(NUM_PICTURES)]
            seen.append([np.array(picture) for picture in pictures])
        self.jpeg, self.pictures = jpeg, cycle(zip(*seen, strict=True))
        if not jpeg:
            space = gym.spaces.Box(0, 255, (height, width, 3), np.uint8)
            self.observation_space = gym.spaces.Tuple([space, space])

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        del seed, options
        left, right = next(self.pictures)
        if self.jpeg:
            return self.observation, {"left": as_jpeg(left), "right": as_jpeg(right)}
        return (left, right), {}


def as_jpeg(picture: Any) -> Any:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=QUALITY)
    return np.frombuffer(file.getbuffer(), np.uint8)


def received_bytes() -> int:
    """Return how much has come over the TCP connections that this process has."""
    found = 0
    for descriptor in filter(Path.is_socket, Path("/proc/self/fd").iterdir()):
        with suppress(OSError), socket.socket(fileno=os.dup(int(descriptor.name))) as one:
            info = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 136)
            found += struct.unpack_from("Q", info, 128)[0]  # tcpi_bytes_received
    return found


@dataclass
class _Clients(Contender):
    """Some processes that dial in.

    Whoever inherits has `dial`, which runs a client in its process, `listen`, which returns a port,
    `begin`, which sends the first requests to all clients, and `call`, which runs one turn and
    returns the rewards of its steps.

    Attributes:
        num_clients: so many.
        encrypted: with CURVE keys.
        env: makes the env of each.
    """

    name: str
    num_clients: int = 1
    encrypted: bool = False
    env: Callable[[], CheetahSized] = CheetahSized

    def setup(self) -> None:
        self._keys = tempfile.TemporaryDirectory()
        make_keys(self._keys.name, [f"c{k}" for k in range(self.num_clients)])
        # They have all modules, and no socket of the trainer's: it listens after that.
        context, (port_of, port_to) = mp.get_context("fork"), os.pipe()
        self._processes = [
            context.Process(target=self._start, args=(port_of, f"c{k}"))
            for k in range(self.num_clients)
        ]
        for process in self._processes:
            process.start()
        os.write(port_to, self.listen().to_bytes(2) * self.num_clients)
        self.begin()
        os.close(port_of)
        os.close(port_to)

    def keys(self, whose: str) -> str | None:
        return str(Path(self._keys.name) / whose) if self.encrypted else None

    def _start(self, port_of: int, name: str) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        os.closerange(3, port_of)  # Whoever waits for the end of this contender is to see it.
        env = self.env()
        self.dial(env, int.from_bytes(os.read(port_of, 2)), self.keys(name), name)

    def round(self, seconds: float) -> dict[str, float]:
        clock = time.perf_counter_ns
        until = clock() + int(seconds * 1e8)
        while clock() < until:
            self.call()
        pids, own = [process.pid for process in self._processes if process.pid], [os.getpid()]
        came, of_clients, of_trainer = received_bytes(), busy_ns(pids), busy_ns(own)
        times, rewards = list[float](), list[float]()
        now = clock()
        until = now + int(seconds * 9e8)
        while now < until:
            rewards += (found := self.call())
            ended = clock()
            times.append((ended - now) / len(found))
            now = ended
        steps = len(rewards)
        return {
            TIME: statistics.median(times) / 1e3,
            TRAINER: (busy_ns(own) - of_trainer) / 1e3 / steps,
            CLIENT: (busy_ns(pids) - of_clients) / 1e3 / steps,
            KIB: (received_bytes() - came) / 1024 / steps,
            TRIP: 1e3 * float(np.quantile(rewards, 0.99)),
            MEMORY: int(Path("/proc/self/statm").read_text().split()[1]) / 256,  # In pages.
        }

    def teardown(self) -> None:
        for process in self._processes:
            process.kill()
            process.join()
        self._keys.cleanup()


@dataclass
class Echo(_Clients):
    """Bare ZMQ."""

    def dial(self, env: CheetahSized, port: int, keys: str | None, name: str) -> None:
        del name
        with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
            if keys is not None:
                own = read_client_keys(keys)
                dealer.curve_serverkey = own.server
                dealer.curve_publickey, dealer.curve_secretkey = own.public, own.secret
            dealer.connect(f"{LOOPBACK}:{port}")
            while True:
                reward = struct.pack("d", env.step(None)[1])
                dealer.send_multipart([REPLY[0], reward + REPLY[1][8:]])
                dealer.recv_multipart()

    def listen(self) -> int:
        self._context = zmq.Context()
        self._router = self._context.socket(zmq.ROUTER)
        if (keys := self.keys("server")) is not None:
            self._router.curve_server = True
            self._router.curve_secretkey = read_server_keys(keys).secret
        return self._router.bind_to_random_port(LOOPBACK)

    def begin(self) -> None:
        waiting = [self._router.recv_multipart() for _ in range(self.num_clients)]
        # One fewer than there are: each call answers the one that comes, and sends it on.
        for route, *_ in waiting[1:]:
            self._router.send_multipart([route, *REQUEST])
        self._came = waiting[0]

    def call(self) -> list[float]:
        self._router.send_multipart([self._came[0], *REQUEST])
        self._came = self._router.recv_multipart()
        return [*struct.unpack_from("d", self._came[-1])]

    def teardown(self) -> None:
        super().teardown()
        self._context.destroy(linger=0)


@dataclass
class Ours(_Clients):
    """A synchronous group, whose clients have a time limit.

    Attributes:
        pictures: ``raw``, ``zstd``, which compresses them at the client, or ``JPEG``, which the
            env makes and the trainer reads.
    """

    pictures: str = ""

    @property
    def requires(self) -> tuple[str, ...]:
        more = {"zstd": ["zstandard"], "JPEG": ["PIL"]}
        return ("rlightning_aio", *more.get(self.pictures, []))

    def dial(self, env: CheetahSized, port: int, keys: str | None, name: str) -> None:
        compression = "zstd" if self.pictures == "zstd" else None
        given: dict[str, Any] = {"keys": keys, "name": name, "compression": compression}
        with RemoteEnvClient(env, "127.0.0.1", port, hardware=False, **given) as client:
            client.run()

    def listen(self) -> int:
        kwargs = {"clients": self.num_clients, "keys": self.keys("server")}
        self._group = sync.build_env_group(
            {"name": "remote", "backend": "env_server", "step_timeout": 60, "env_kwargs": kwargs}
        )
        self._group.init()
        return int(self._group["remote-0"].address.rpartition(":")[2])

    def begin(self) -> None:
        self._batch, _ = self._group.reset()

    def call(self) -> list[float]:
        action = np.zeros((len(self._batch), 6), np.float32)
        self._group.step_async(self._batch.respond(action=action))
        self._batch, _ = self._group.collect_async()
        _ = self._batch.observation
        if self.pictures == "JPEG":
            from PIL import Image

            for info in self._batch.info():
                for name in ("left", "right"):
                    np.asarray(Image.open(io.BytesIO(info[name])))
        return self._batch.reward.tolist()

    def teardown(self) -> None:
        self._group.close()
        super().teardown()


def name(what: str, clients: int, encrypted: bool) -> str:
    return f"{what}, {clients} client{'s' * (clients > 1)}{', CURVE' * encrypted}"


OURS, BARE = "rlightning_aio", "bare pyzmq echo"
QUESTIONS = (
    Question(
        name="remote",
        title="A step of env clients without work",
        unit=TIME,
        columns=(TIME, TRAINER, CLIENT),
        contenders=[
            kind(name(what, clients, encrypted), clients, encrypted)
            for clients, encrypted in ((1, False), (1, True), (8, False), (8, True))
            for what, kind in ((OURS, Ours), (BARE, Echo))
        ],
        targets=[
            Target(name(OURS, 1, encrypted), name(BARE, 1, encrypted), 1.5, at_most=True)
            for encrypted in (False, True)
        ],
        rounds=5,
        seconds=0.6,
    ),
    Question(
        name="images",
        title="Pictures of a client",
        unit=KIB,
        columns=(KIB, CLIENT, TRAINER),
        contenders=[
            Ours(
                f"2 of {width} x {height}, {kind}",
                env=partial(Cameras, height, width, jpeg=kind == "JPEG"),
                pictures=kind,
            )
            for height, width in ((224, 224), (480, 640))
            for kind in ("raw", "zstd", "JPEG")
        ],
    ),
    Question(
        name="paced",
        title="Clients at their own pace",
        unit=TRAINER,
        columns=(TRAINER, TRIP, MEMORY),
        contenders=[
            Ours(f"{OURS}, 64 clients, 20 Hz", 64, env=Paced),
            Echo(f"{BARE}, 64 clients, 20 Hz", 64, env=Paced),
        ],
    ),
)

if __name__ == "__main__":
    main(QUESTIONS, __doc__)
