"""A client that dials: what it takes meanwhile, and what interrupts it."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
import zmq
from kit.counting import CountingEnv, served
from patience import HANG

from rlightning_aio import sync
from rlightning_aio.errors import BadAction, ConfigError
from rlightning_aio.remote import RemoteEnvClient

if TYPE_CHECKING:
    from collections.abc import Callable

ADD = "_add_socket"
"""Of pyzmq's contexts: what notes a new socket. No other moment is between the two."""


@pytest.mark.parametrize(
    ("owner", "name"), [(zmq, "Poller"), (zmq.Socket, "connect"), (RemoteEnvClient, "_flush")]
)
def test_an_interrupt_while_dialing_closes_what_is_open(
    owner: object, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The env is closed wherever a signal arrives between the first socket and the last."""
    real: Callable[..., object] = getattr(owner, name)

    def interrupted(*args: object, **kwargs: object) -> object:
        real(*args, **kwargs)
        raise KeyboardInterrupt

    env = CountingEnv()
    client = RemoteEnvClient(env, "127.0.0.1", 9)
    monkeypatch.setattr(owner, name, interrupted)
    with pytest.raises(KeyboardInterrupt), client:
        client.run()
    assert env.closed


def test_a_signal_while_a_socket_is_made_comes_after_that(monkeypatch: pytest.MonkeyPatch) -> None:
    """A context would wait for ever for a socket that it doesn't know yet."""
    real: Callable[..., object] = getattr(zmq.Context, ADD)

    def signalled(*args: object) -> object:
        os.kill(os.getpid(), signal.SIGINT)
        return real(*args)

    env = CountingEnv()
    client = RemoteEnvClient(env, "127.0.0.1", 9)
    monkeypatch.setattr(zmq.Context, ADD, signalled)
    with pytest.raises(KeyboardInterrupt), client:
        client.run()
    assert env.closed


def test_between_two_attempts_a_client_takes_no_time_of_a_core() -> None:
    """It sleeps. A server that is away may stay away for hours."""
    with RemoteEnvClient(CountingEnv(), "127.0.0.1", 1) as client:
        began = time.thread_time()
        with pytest.raises(TimeoutError):
            client.connect(timeout=1.0)
        assert time.thread_time() - began < 0.5


@pytest.mark.parametrize("made", ["env", "callable"])
def test_a_client_takes_a_gymnasium_env_or_a_callable(made: str) -> None:
    """As the task of an entry does; the env counts as hardware unless it is said that it isn't."""
    stops: list[str] = []

    class Robot(gym.Env[Any, Any]):
        observation_space = action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

        def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            return np.zeros(1, np.float32), {}

        def step(self, action: Any) -> Any:
            return action, 1.0, False, False, {}

        def stop(self) -> None:
            stops.append("stop")

    with sync.build_env_group(served()) as group:
        given: Any = Robot() if made == "env" else Robot
        with RemoteEnvClient(given, group["robots-0"].address, name="arm") as client:
            client._env.is_finish = lambda: len(stops) == 2  # noqa: SLF001
            thread = threading.Thread(target=client.run)
            thread.start()
            batch, _ = group.reset()
            batch, _ = group.step(batch.respond(action=np.full((1, 1), 0.5)))
            assert batch.observation.tolist() == [[0.5]]
            with pytest.raises(BadAction, match=r"holds 1\.5"):
                group.step(batch.respond(action=np.full((1, 1), 1.5)))
            assert stops == ["stop"]
            group.close()
            thread.join(HANG)
            assert stops == 3 * ["stop"], "the end of a session stops it, and that of run()"
        assert stops == 4 * ["stop"], "it is stopped before it is closed"


class Awaitable:
    observation_space = action_space = gym.spaces.Discrete(2)

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any: ...

    async def step(self, action: Any) -> Any: ...


class Old:
    """An env of Gym's old kind."""

    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self) -> int: ...

    def step(self, action: Any) -> Any: ...


class Unsupported(gym.Env[Any, Any]):
    observation_space = gym.spaces.Graph(gym.spaces.Discrete(2), None)
    action_space = gym.spaces.Discrete(2)
    num_closed = 0

    def close(self) -> None:
        Unsupported.num_closed += 1


ADDRESS = "127.0.0.1", 9
REFUSED: list[tuple[Any, Any, dict[str, Any], str]] = [
    (Awaitable, ADDRESS, {}, "is awaitable .* a client steps its env in a plain loop"),
    (Old, ADDRESS, {}, r"shimmy\.GymV21CompatibilityV0"),
    (Unsupported, ADDRESS, {}, "can't be a remote client"),
    *(
        (CountingEnv(), given, {}, r"give a host and a port, or tcp://127.0.0.1:5555")
        for given in (
            ("127.0.0.1",), ("tcp://127.0.0.1",), ("tcp://127.0.0.1:5555", 5555), ("ipc://x", 1),
        )
    ),
    *(
        (CountingEnv(), ADDRESS, {"heartbeat": h}, r"heartbeat: should be 0\.1 to 86400 seconds")
        for h in (0, 0.05, -1, 86401, math.inf, math.nan)
    ),
    (
        CountingEnv(), ADDRESS, {"compression": "jpeg"},
        "compression should be 'zstd' or None, not 'jpeg'",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("env", "address", "fields", "says"), REFUSED)
def test_what_can_not_be_a_client_is_refused(
    env: Any, address: Any, fields: dict[str, Any], says: str
) -> None:
    """Before it dials; an env that a callable has made is closed, as nobody else has it."""
    before = Unsupported.num_closed
    with pytest.raises(TypeError if env is Old else ConfigError, match=says):
        RemoteEnvClient(env, *address, **fields)
    assert Unsupported.num_closed - before == (env is Unsupported)
