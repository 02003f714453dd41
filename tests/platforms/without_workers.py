"""Everything that needs no worker process, on any system: `without_workers.py [NAME ...]`.

Each function is one scenario, and raises if anything is wrong. CI runs this program on macOS;
`test_macos.py` runs it on Linux without what macOS lacks.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import math
import sys
import threading
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import gymnasium
import numpy as np
from envs.misbehaving_openenv import Misbehaving
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.attempts import AttemptEpisode, EpisodeSpec, play
from rlightning_aio.cli.app import app
from rlightning_aio.collecting import Collector
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.errors import ConfigError
from rlightning_aio.evaluation import evaluate
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.vector import make_vec


def poles(number: int) -> dict[str, Any]:
    return {
        "name": "pole",
        "backend": "gymnasium",
        "task": "CartPole-v1",
        "num_workers": number,
        "placement": "inline",
    }


class Waiting:
    """An awaitable env."""

    observation_space = spaces.Box(0, 100, (1,), np.float32)
    action_space = spaces.Discrete(2)

    async def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.count = 0
        return np.zeros(1, np.float32), {}

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(0.001)
        self.count += 1
        return np.full(1, self.count, np.float32), 1.0, self.count >= 5, False, {}


class Leaving(GymnasiumEnv):
    """A client's env; the client ends with its server."""

    _is_over = False

    def on_disconnect(self) -> None:
        self._is_over = True

    def is_finish(self) -> bool:
        return self._is_over


def inline() -> None:
    """Observations are those of Gymnasium's envs, with the synchronous group and the other."""
    with sync.build_env_group(poles(3)) as group:
        batch, _ = group.reset(seed=0)
        expected = [gymnasium.make("CartPole-v1").reset(seed=k)[0] for k in range(3)]
        assert np.array_equal(batch.observation, expected)
        group.step_async(batch.respond(action=np.zeros(3, int)))
        assert len(group.collect_async(min_results=3)[0]) == 3

    async def on_the_loop() -> None:
        async with rl.build_env_group(poles(3)) as group:
            batch, _ = await group.reset(seed=0)
            assert np.array_equal(batch.observation, expected)
            batch, _ = await group.step(batch.respond(action=np.zeros(3, int)))
            assert batch.reward.sum() == 3
            state = await group.snapshot()
            batch, _ = await group.restore(state)

    rl.run(on_the_loop())
    asyncio.run(on_the_loop())


def loop() -> None:
    """Awaitable envs wait together, and one that takes too long is rebuilt."""

    class Stuck(Waiting):
        async def step(self, action: Any) -> Any:
            await asyncio.sleep(math.inf)

    async def main() -> None:
        async with rl.build_env_group(Waiting, num_workers=50, placement="loop") as group:
            batch, _ = await group.reset(seed=0)
            with group.auto_reset(math.inf):
                for _ in range(20):
                    group.step_async(batch.respond(action=np.zeros(len(batch), int)))
                    batch, _ = await group.collect_async(min_results=10)
        async with rl.build_env_group(Stuck, placement="loop", step_timeout=0.05) as group:
            batch, _ = await group.reset(seed=0)
            batch, _ = await group.step(batch.respond(action=np.zeros(1, int)))
            assert batch.truncated.all()

    rl.run(main())
    asyncio.run(main())


def mujoco() -> None:
    """A batch of MuJoCo's envs gives what Gymnasium's own envs give."""
    envs = make_vec("HalfCheetah-v5", 4)
    bare = SyncVectorEnv([lambda: gymnasium.make("HalfCheetah-v5")] * 4)
    assert np.array_equal(envs.reset(seed=0)[0], bare.reset(seed=0)[0])
    actions = np.zeros(envs.action_space.shape, np.float32)
    for _ in range(20):
        assert np.array_equal(envs.step(actions)[0], bare.step(actions)[0])
    envs.close()
    bare.close()

    async def main() -> None:
        async with rl.build_env_group("HalfCheetah-v5", num_envs=4, placement="inline") as group:
            batch, _ = await group.reset(seed=0)
            for _ in range(20):
                group.step_async(batch.respond(action=np.zeros((1, 4, 6), np.float32)))
                batch, _ = await group.collect_async(min_results=1)

    rl.run(main())


def remote() -> None:
    """Clients connect, are stepped on both drivers, and leave."""

    def serve(address: str) -> None:
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        env = Leaving(EnvConfig(name="env", backend="gymnasium", task="CartPole-v1"))
        with RemoteEnvClient(env, host, int(port), name="one") as client:
            client.run()

    server = {"name": "server", "backend": "env_server", "env_kwargs": {"min_clients": 1}}
    with sync.build_env_group(server) as group:
        thread = threading.Thread(target=serve, args=[group["server-0"].address])
        thread.start()
        batch, _ = group.reset(seed=0)
        for _ in range(5):
            batch, _ = group.step(batch.respond(action=[0] * len(batch)))
        assert batch.reward.sum() == 1
    thread.join()

    async def main() -> None:
        async with asyncio.TaskGroup() as clients, rl.build_env_group(server) as group:
            clients.create_task(asyncio.to_thread(serve, group["server-0"].address))
            batch, _ = await group.reset(seed=0)
            for _ in range(5):
                batch, _ = await group.step(batch.respond(action=[0] * len(batch)))
            assert batch.reward.sum() == 1

    rl.run(main())
    asyncio.run(main())


def openenv() -> None:
    """Sessions of an OpenEnv server."""

    async def main() -> None:
        async with Misbehaving(capacity=4) as server:
            entry = {"backend": "openenv", "task": server.url, "placement": "loop"}
            async with rl.build_env_group({"name": "o", "num_workers": 4, **entry}) as group:
                batch, _ = await group.reset()
                for step in range(5):
                    numbers = [{"number": 10 * step + k} for k in range(len(batch))]
                    batch, _ = await group.step(batch.respond(action=numbers))
                assert len(batch) == 4

    asyncio.run(main())


def collector() -> None:
    """A rollout of transitions."""
    with sync.build_env_group(poles(4)) as group:
        collect = Collector(group, lambda batch: np.zeros(len(batch), int), num_transitions=64)
        assert len(collect.collect().action) >= 64


def evaluation() -> None:
    """A fixed number of episodes for each env, and a queue of episodes."""
    with sync.build_env_group(poles(2)) as group:
        found = evaluate(group, None, episodes=2, seed=0)
        assert found.total_reward is not None
        assert found.total_reward.count == 4


def attempts() -> None:
    """Several attempts at each task, on the event loop and inline."""

    async def agent(episode: AttemptEpisode) -> None:
        while not episode.is_over:
            await episode.step(0)

    async def main() -> None:
        tasks = [EpisodeSpec("", seed) for seed in range(4)]
        for group in (
            rl.build_env_group(Waiting, num_workers=4, placement="loop"),
            rl.build_env_group(poles(4)),
        ):
            async with group:
                async for found in play(group, tasks, agent, size=2):
                    assert found.is_complete

    rl.run(main())


def command_line() -> None:
    """Commands play, evaluate, check and measure envs in this process."""
    config = str(Path(__file__).parents[2] / "configs" / "cartpole.yaml")
    entry = (config, "envs.0.placement=inline", "envs.0.num_workers=4")
    for words in (
        ("rollout", *entry, "--steps", "200"),
        ("eval", *entry, "--episodes", "2", "--seed", "0"),
        ("check", *entry),
        ("bench", *entry, "--seconds", "0.02", "--rounds", "1"),
    ):
        with contextlib.redirect_stdout(io.StringIO()) as output:
            code = app(list(words), standalone_mode=False)
        assert not code, (words, output.getvalue())


def worker_processes() -> None:
    """They need Linux: one error says so, and what works instead."""
    for build in (
        lambda: rl.build_env_group("CartPole-v1"),
        lambda: sync.build_env_group("HalfCheetah-v5", num_workers=2),
        lambda: make_vec("CartPole-v1", 2, "async"),
    ):
        try:
            build()
        except ConfigError as error:
            text = str(error)
            assert all(name in text for name in ("Linux", "inline", "loop", "env_server")), text
        else:
            assert sys.platform == "linux", "nothing was refused"


SCENARIOS = (
    inline,
    loop,
    mujoco,
    remote,
    openenv,
    collector,
    evaluation,
    attempts,
    command_line,
    worker_processes,
)


def main() -> None:
    names = sys.argv[1:] or [scenario.__name__ for scenario in SCENARIOS]
    for scenario in SCENARIOS:
        if scenario.__name__ in names:
            scenario()
            sys.stdout.write(f"{scenario.__name__}: works\n")


if __name__ == "__main__":
    main()
