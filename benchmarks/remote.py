"""What does an env server add to the network? Steps of 1 and of 8 clients without work.

It is compared with bare ZMQ: a ROUTER and as many DEALERs in other processes that send each other
messages of the same sizes without reading them; with and without encryption. The figure is the time
per step: with one client a round trip, with eight the share of each while all are busy.
"""

from __future__ import annotations

import multiprocessing as mp
import signal
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import zmq
from harness import Contender, Question, Target, main

from rlightning_aio import sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.protocol.net.wire import ClientResult, Step, Writer
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.remote.keys import make_keys, read_client_keys, read_server_keys

TASK = "benchmarks/CheetahSized-v0"
WARM_UP_CALLS = 100
LOOPBACK = "tcp://127.0.0.1"


class CheetahSized(gym.Env[Any, Any]):
    """Does nothing, with the spaces of HalfCheetah-v5."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (17,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
    idle = np.zeros(17)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        del seed, options
        return self.idle, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        del action
        return self.idle, 0.0, False, False, {}


gym.register(TASK, CheetahSized, disable_env_checker=True, order_enforce=False)


def request() -> list[bytes]:
    """Return a message with the size of a step."""
    return Writer().write(Step(number=2**20), [bytes(6 * 4)])


def reply() -> list[bytes]:
    """Return a message with the size of a result."""
    result = ClientResult(
        number=2**20, busy_ns=2**15, reward=0.0, terminated=False, truncated=False
    )
    return Writer().write(result, [bytes(17 * 8)])


@dataclass
class _Clients(Contender):
    """Some processes that dial in.

    Attributes:
        num_clients: so many.
        encrypted: with CURVE keys.
    """

    name: str
    num_clients: int
    encrypted: bool

    def setup(self) -> None:
        self._keys = tempfile.TemporaryDirectory()
        make_keys(self._keys.name, [f"c{k}" for k in range(self.num_clients)])
        self._processes: list[Any] = []
        self.listen()

    def keys(self, whose: str) -> str | None:
        return str(Path(self._keys.name) / whose) if self.encrypted else None

    def dial(self, target: Any, port: int) -> None:
        context = mp.get_context("spawn")
        for k in range(self.num_clients):
            args = (port, self.keys(f"c{k}"), f"c{k}")
            self._processes.append(context.Process(target=target, args=args))
            self._processes[-1].start()

    def listen(self) -> None:
        raise NotImplementedError

    def call(self) -> int:
        """Run one turn; return the number of its steps."""
        raise NotImplementedError

    def round(self, seconds: float) -> float:
        return us_per_step(self.call, seconds)

    def teardown(self) -> None:
        for process in self._processes:
            process.kill()
            process.join()
        self._keys.cleanup()


def us_per_step(call: Any, seconds: float) -> float:
    clock = time.perf_counter_ns
    for _ in range(WARM_UP_CALLS):
        call()
    times: list[float] = []
    began = now = clock()
    until = began + int(seconds * 1e9)
    while now < until:
        steps = call()
        ended = clock()
        times.append((ended - now) / steps)
        now = ended
    return statistics.median(times) / 1e3


def _echo(port: int, keys: str | None, name: str) -> None:
    del name
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        if keys is not None:
            own = read_client_keys(keys)
            dealer.curve_serverkey = own.server
            dealer.curve_publickey, dealer.curve_secretkey = own.public, own.secret
        dealer.connect(f"{LOOPBACK}:{port}")
        parts = reply()
        dealer.send_multipart(parts)
        while True:
            dealer.recv_multipart()
            dealer.send_multipart(parts)


@dataclass
class Echo(_Clients):
    """Bare ZMQ."""

    def listen(self) -> None:
        self._context = zmq.Context()
        self._router = self._context.socket(zmq.ROUTER)
        if (keys := self.keys("server")) is not None:
            self._router.curve_server = True
            self._router.curve_secretkey = read_server_keys(keys).secret
        self.dial(_echo, self._router.bind_to_random_port(LOOPBACK))
        self._parts = request()
        waiting = [self._router.recv_multipart()[0] for _ in range(self.num_clients)]
        # One fewer than there are: each call answers the one that comes, and sends it on.
        for route in waiting[1:]:
            self._router.send_multipart([route, *self._parts])
        self._route = waiting[0]

    def call(self) -> int:
        self._router.send_multipart([self._route, *self._parts])
        self._route = self._router.recv_multipart()[0]
        return 1

    def teardown(self) -> None:
        super().teardown()
        self._context.destroy(linger=0)


def _serve(port: int, keys: str | None, name: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    env = GymnasiumEnv(EnvConfig(name="env", backend="gymnasium", task=TASK))
    with RemoteEnvClient(env, "127.0.0.1", port, keys=keys, name=name) as client:
        client.run()


@dataclass
class Ours(_Clients):
    """A synchronous group, whose clients have a time limit."""

    @property
    def requires(self) -> tuple[str, ...]:
        return ("rlightning_aio",)

    def listen(self) -> None:
        kwargs = {"clients": self.num_clients, "keys": self.keys("server")}
        self._group = sync.build_env_group(
            {"name": "remote", "backend": "env_server", "step_timeout": 60, "env_kwargs": kwargs}
        )
        self._group.init()
        self.dial(_serve, int(self._group["remote-0"].address.rpartition(":")[2]))
        self._batch, _ = self._group.reset()

    def call(self) -> int:
        action = np.zeros((len(self._batch), 6), np.float32)
        self._group.step_async(self._batch.respond(action=action))
        self._batch, _ = self._group.collect_async()
        return len(self._batch)

    def teardown(self) -> None:
        self._group.close()
        super().teardown()


def name(what: str, clients: int, encrypted: bool) -> str:
    return f"{what}, {clients} client{'s' * (clients > 1)}{', CURVE' * encrypted}"


OURS, BARE = "rlightning_aio", "bare pyzmq echo"
SETTINGS = [(1, False), (1, True), (8, False), (8, True)]

QUESTION = Question(
    name="remote",
    title="A step of env clients without work",
    unit="µs per step",
    contenders=[
        kind(name(what, clients, encrypted), clients, encrypted)
        for clients, encrypted in SETTINGS
        for what, kind in ((OURS, Ours), (BARE, Echo))
    ],
    targets=[
        Target(name(OURS, 1, encrypted), name(BARE, 1, encrypted), 1.5, at_most=True)
        for encrypted in (False, True)
    ],
    seconds=1.0,
)

if __name__ == "__main__":
    main(QUESTION, __doc__)
