"""Clients of every kind of env give the same results as local envs."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from kit.counting import ClientThread, look, served
from kit.driven import without_times
from patience import HANG
from remote.random_spaces import same, sampled

from rlightning_aio import (
    ENVS,
    BaseEnv,
    BatchedData,
    EnvRet,
    MultiAgentEnvRet,
    PolicyResponse,
    sync,
)
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from collections.abc import Iterator

DICT = spaces.Dict(
    picture=spaces.Box(0, 255, (4, 4, 3), np.uint8),
    inner=spaces.Tuple([spaces.Discrete(3), spaces.MultiBinary(2)]),
)
POSITION = spaces.Box(-1.0, 1.0, (2,), np.float32)


class _Sampling(BaseEnv):
    """Observations are samples of its space, by seed and step; every third step ends."""

    sub_envs = 1

    observations: spaces.Space[Any] = POSITION
    actions: spaces.Space[Any] = spaces.Discrete(3)
    finished = False

    def __init__(self, config: EnvConfig, worker_index: int = 0, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, worker_index, *args, **kwargs)
        self.seed = self.count = 0

    def get_observation_space(self) -> gym.Space[Any]:
        return self.observations

    def get_action_space(self) -> gym.Space[Any]:
        return self.actions

    def observation(self) -> Any:
        return sampled(self.observations, 1000 * self.seed + self.count)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        self.seed, self.count = seed or 0, 0
        return self.ret({"options": options or {}}, 0.0, ended=False)

    def step(self, policy_resp: PolicyResponse) -> Any:
        self.count += 1
        info = {"got": policy_resp.action, "extras": policy_resp.extras}
        return self.ret(info, 0.5 * self.count, ended=self.count % 3 == 0)

    def ret(self, info: dict[str, Any], reward: float, *, ended: bool) -> Any:
        return EnvRet(
            env_id=self.env_id,
            observation=self.observation(),
            last_reward=reward,
            last_terminated=ended,
            info=info,
            _extra={"count": self.count},
        )

    def is_finish(self) -> bool:
        return self.finished

    def on_disconnect(self) -> None:
        self.finished = True


class Plain(_Sampling):
    pass


class Structured(_Sampling):
    observations = DICT
    actions = spaces.Dict(arm=POSITION, grip=spaces.Discrete(2))


class Speaking(_Sampling):
    """A space without a fixed size."""

    observations = spaces.Dict(word=spaces.Text(5), at=POSITION)
    actions = spaces.Text(4)


class Chunked(_Sampling):
    """It accepts any action."""

    transforms_actions = True


class Vectorised(_Sampling):
    sub_envs = 2
    observations = batch_space(POSITION, 2)
    actions = batch_space(spaces.Discrete(3), 2)
    autoreset = "next_step"

    def __init__(self, config: EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.num_envs = 2

    def ret(self, info: dict[str, Any], reward: float, *, ended: bool) -> Any:
        ret = super().ret(info, reward, ended=ended)
        ret.last_reward = np.array([reward, -reward])
        ret.last_terminated = np.array([ended, False])
        ret.last_truncated = np.array([False, ended])
        return ret


class Agents(_Sampling):
    agents = ("left", "right")
    observations = spaces.Dict(left=POSITION, right=spaces.Discrete(4))
    actions = spaces.Dict(left=spaces.Discrete(2), right=POSITION)

    def ret(self, info: dict[str, Any], reward: float, *, ended: bool) -> Any:
        return MultiAgentEnvRet(
            env_id=self.env_id,
            observation=self.observation(),
            last_reward={"left": reward, "right": 2 * reward},
            last_terminated={"left": ended, "right": ended},
            last_truncated={"left": False, "right": False},
            info=info,
        )


KINDS = [Plain, Structured, Speaking, Chunked, Vectorised, Agents]


def actions_of(kind: type[_Sampling], step: int) -> Any:
    if kind is Chunked:
        return {"chunk": np.full((step + 1, 2), step, np.float32), "mode": "fast"}
    return sampled(kind.actions, step)


def trajectory(group: Any, kind: type[_Sampling]) -> Iterator[Any]:
    """Return all results of a seeded reset, eight steps with extras, and a reset with options."""
    batch, _ = group.reset(seed=7)
    yield batch.values()[0]
    for step in range(8):
        (env_id,) = batch.env_ids()
        response = PolicyResponse(env_id, actions_of(kind, step), log_prob=-0.5, step=step)
        group.step_async(BatchedData(batch.ids(), [response]))
        batch, _ = group.collect_async(deadline=HANG)
        yield batch.values()[0]
    batch, _ = group.reset(options={"where": "here"})
    yield batch.values()[0]


def described(ret: Any) -> dict[str, Any]:
    fields = ("observation", "last_reward", "last_terminated", "last_truncated")
    # Tuples arrive as lists in both cases.
    info = {name: value for name, value in ret.info.items() if name != "client"}
    return {name: getattr(ret, name) for name in fields} | {"info": info, "extra": ret._extra}


@pytest.mark.parametrize("kind", KINDS)
def test_a_client_gives_the_results_of_a_local_env(kind: type[_Sampling]) -> None:
    """Observations, rewards, flags, infos, extras and episodes; the responses reach the env."""
    name = f"sampling-{kind.__name__}"
    ENVS.register(name)(kind)
    local = {"name": "here", "backend": name, "task": "any", "placement": "inline"}
    with sync.build_env_group(local) as group:
        expected = [described(ret) for ret in trajectory(group, kind)]
        stats = group.get_env_stats()["here-0"]
    with sync.build_env_group(
        {"name": "there", "backend": "env_server", "num_envs": kind.sub_envs}
    ) as group:
        env = kind(EnvConfig(name="there", backend=name, task="any"))
        thread = ClientThread(group["there-0"].address, "client", env)
        found = [described(ret) for ret in trajectory(group, kind)]
        stats_of_client = group.get_env_stats()["there-0/0"]
        group.close()
        thread.join()
    assert without_times(stats_of_client) == without_times(stats)
    for one, other in zip(found, expected, strict=True):
        assert same(one, other)
    if kind is not Agents:
        assert stats["episodes"] > 0


MASK = {"reset_mask": np.array([True, False])}


@pytest.mark.parametrize("given", [{"seed": 5}, {"options": MASK}], ids=["seed", "mask"])
def test_a_reset_that_a_client_took_with_it_is_for_no_other(given: dict[str, Any]) -> None:
    """Once it was aborted; and what is lost with a mask begins as a whole in the next client."""
    begun, gate = list[Any](), Event()

    class Noting(Vectorised):
        def reset(self, **given: Any) -> Any:
            begun.append(given)
            if len(begun) == 2:
                gate.wait(HANG)
            return super().reset(**given)

    with sync.build_env_group({**served(), "num_envs": 2}) as group:
        address, config = group["robots-0"].address, EnvConfig(name="n", backend="n", task="n")
        first = ClientThread(address, "first", Noting(config), hardware=False)
        batch, _ = group.reset()
        group.reset_async(**given)
        while len(begun) < 2:
            look(group)
        if "seed" in given:
            group.abort()
            group.step_async(batch.respond(action=np.zeros((1, 2), int)))
        else:
            group._core.supervisor.hosts[0].kill(dump=False)  # noqa: SLF001
        gate.set()
        first.join()
        second = ClientThread(address, "second", Noting(config), hardware=False)
        group.collect_async(deadline=HANG)
    second.join()
    assert begun[2] == {"seed": None, "options": None}


class Braked(gym.Wrapper[Any, Any, Any, Any]):
    """Knows how to stop the robot, which does not."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.num_stops = 0

    def stop(self) -> None:
        self.num_stops += 1


class FourValues(gym.Env[Any, Any]):
    """Returns what Gym's envs did."""

    observation_space = action_space = spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return 0, {}

    def step(self, action: Any) -> Any:
        return 0, 0.0, False, {}


def test_a_robot_whose_wrapper_stops_it_says_what_a_step_returns(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Its step is refused, so that it stops; the words are those of a local env."""
    robot = Braked(FourValues())
    with sync.build_env_group(served()) as group:
        outer: Any = gym.wrappers.TimeLimit(robot, 9)
        client = ClientThread(group["robots-0"].address, "one", outer)
        batch, _ = group.reset()
        with pytest.raises(EnvRaised, match="GymV21CompatibilityV0"):
            group.step(batch.respond(action=[0]))
        assert robot.num_stops
        assert "one: the env raised" in caplog.text  # On the robot's computer, too.
        client.client._env.is_finish = lambda: True  # noqa: SLF001
    client.join()
