"""Envs for tests; workers import this module by name.

Gymnasium envs: `Tree-v0` has observations and actions of every space that fits in rows, `Words-v0`
observations of spaces that don't. Each observation is a new sample, so seeds matter. The other envs
are registered backends.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rlightning_aio import ENVS, BaseEnv, EnvRet, MultiAgentEnvRet, PolicyResponse
from rlightning_aio.envs.base import result_of, sub_env_seeds
from rlightning_aio.envs.fast_path import BareStep, FastPath

TREE = spaces.Dict(
    place=spaces.Box(-1, 1, (3,), np.float32),
    image=spaces.Box(0, 255, (4, 5, 3), np.uint8),
    inner=spaces.Dict(count=spaces.Discrete(1000), bits=spaces.MultiBinary(4)),
    pair=spaces.Tuple([spaces.MultiDiscrete([3, 5]), spaces.Box(-9, 9, (), np.float64)]),
)
WORDS = spaces.Dict(
    text=spaces.Text(8),
    items=spaces.Sequence(spaces.Box(0, 1, (2,), np.float64)),
    graph=spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3)),
    place=spaces.Box(-1, 1, (2,), np.float64),
)
MOVES = spaces.Dict(
    push=spaces.Box(-1, 1, (2,), np.float32),
    hands=spaces.Tuple([spaces.MultiBinary(3), spaces.MultiDiscrete([2, 4])]),
    jump=spaces.Discrete(2),
)


class DrawnEnv(gym.Env[Any, Any]):
    """Observations are samples of its space; each step ends the episode with a chance of 4 %."""

    def __init__(self, observation_space: Any, action_space: Any) -> None:
        self.observation_space = deepcopy(observation_space)  # The space holds a generator.
        self.action_space = action_space
        self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {"seed": seed, "options": options}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action in self.action_space, action
        self.steps += 1
        chance = self.np_random.random()
        info = {"chance": chance, "steps": self.steps}
        return self.observation_space.sample(), chance, chance < 0.04, False, info


def tree() -> DrawnEnv:
    return DrawnEnv(TREE, MOVES)


def words() -> DrawnEnv:
    return DrawnEnv(WORDS, spaces.Discrete(3))


gym.register("Tree-v0", entry_point=tree)
gym.register("Words-v0", entry_point=words)


# -- subclasses of BaseEnv


@ENVS.register("probe")
class Probe(BaseEnv):
    """Observes its history: [index in its entry, episodes, steps, seed].

    An action is [effect, a number that is returned as the reward].
    """

    DO_NOTHING, END, TRUNCATE, RAISE = range(4)

    def __init__(
        self, config: Any, worker_index: int = 0, preprocess_fn: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(config, worker_index, preprocess_fn, **kwargs)
        self.episodes = 0
        self.steps = 0
        self.seed = -1
        self.offloaded = False
        self.env = ProbedSimulator()
        if config.env_kwargs.get("fails") == worker_index:
            raise RuntimeError("no simulator here")

    def get_observation_space(self) -> gym.Space[Any]:
        return spaces.Box(-np.inf, np.inf, (4,), np.float64)

    def get_action_space(self) -> gym.Space[Any]:
        return spaces.Box(-100, 100, self.config.env_kwargs.get("action_shape", (2,)), np.float64)

    def _result(self, **fields: Any) -> EnvRet:
        observation = np.array([self.worker_index, self.episodes, self.steps, self.seed], float)
        return EnvRet(env_id=self.env_id, observation=observation, **fields)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        self.episodes += 1
        self.steps = 0
        self.seed = -1 if seed is None else int(seed)  # type: ignore[arg-type]
        return self._result(info={} if options is None else {"options": options})

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        action = self._preprocess_fn(policy_resp)
        what, reward = int(action[0]), float(action[1])
        if what == self.RAISE:
            raise OddError(7, where="step")
        self.steps += 1
        return self._result(
            last_reward=reward,
            last_terminated=what == self.END,
            last_truncated=what == self.TRUNCATE,
            info={"extras": policy_resp.extras} if policy_resp.extras else {},
            _extra={"steps": self.steps},
        )

    def double(self, value: Any, *, times: int = 2) -> Any:
        return value * times

    def offload(self) -> None:
        self.offloaded = True

    def reload(self) -> None:
        self.offloaded = False


class OddError(Exception):
    """An exception that can't be rebuilt from its message alone."""

    def __init__(self, code: int, *, where: str) -> None:
        super().__init__(code, where)


class ProbedSimulator(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper around an env; each of them has its own label."""

    def __init__(self) -> None:
        inner = DrawnEnv(spaces.Discrete(2), spaces.Discrete(2))
        inner.label = "inner"  # type: ignore[attr-defined]
        inner.depth = 2  # type: ignore[attr-defined]
        inner.render = lambda: np.full((2, 2, 3), 7, np.uint8)  # type: ignore[method-assign]
        inner.weigh = lambda factor: 3 * factor  # type: ignore[attr-defined]
        super().__init__(gym.Wrapper(inner))
        self.label = "outer"

    def stack(self) -> str:
        return "wrapped"


@ENVS.register("chunked")
class Chunked(Probe):
    """Takes a list of any number of actions, or a dict with one; the reward is their sum."""

    transforms_actions = True

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        action = policy_resp.action
        chunk = action["chunk"] if isinstance(action, dict) else action
        self.steps += len(chunk)
        return self._result(last_reward=float(np.sum(chunk)), info={"type": type(action).__name__})


@ENVS.register("fresh")
class Fresh(FastPath, BaseEnv):
    """Returns observations of the task's space without keeping references to them.

    A step returns ``gives`` of its ``env_kwargs``, or a sample of the space.
    """

    SPACES: ClassVar[dict[str, gym.Space[Any]]] = {
        "number": spaces.Discrete(5),
        "array": spaces.Box(-1, 1, (3,), np.float32),
        "words": spaces.Text(8),
        "tree": TREE,
        "lines": spaces.Sequence(spaces.Box(-9, 9, (2,), np.float64)),
        "titled count": spaces.Dict(title=spaces.Text(8), value=spaces.MultiDiscrete([9])),
        "titled value": spaces.Dict(title=spaces.Text(8), value=spaces.Box(-9, 9, (1,))),
        "value of two titles": spaces.Dict(
            title=spaces.Tuple([spaces.Text(8), spaces.Text(8)]),
            value=spaces.Box(-9, 9, (1,), np.float64),
        ),
        "further keys": spaces.Dict(title=spaces.Text(8), more=spaces.Box(-9, 9, (1,))),
    }

    fresh_results = True

    def get_observation_space(self) -> gym.Space[Any]:
        return self.SPACES[self.config.task]

    def get_action_space(self) -> gym.Space[Any]:
        return spaces.Discrete(2)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        self.space = deepcopy(self.get_observation_space())
        self.space.seed(3)
        return EnvRet(env_id=self.env_id, observation=self.space.sample())

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        # Its awaitable twin has no bare step.
        return result_of(self.env_id, Fresh.bare_step(self)(policy_resp.action))

    def bare_step(self) -> BareStep:
        def step(action: Any) -> Any:
            given = self.config.env_kwargs.get("gives")
            self.given = self.space.sample() if given is None else np.array(given)
            return self.given, 1.0, False, False, {}

        return step


@ENVS.register("stale")
class Stale(Fresh):
    """Overwrites the results of its own `step` later."""

    def bare_step(self) -> Any:
        return None

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        if not hasattr(self, "running"):
            self.running = np.zeros(3, np.float32)
        self.running += 0.25
        return EnvRet(env_id=self.env_id, observation=self.running)


@ENVS.register("batched")
class Batched(BaseEnv):
    """Three sub-environments that count; the first axis of every value counts them."""

    def get_observation_space(self) -> gym.Space[Any]:
        return spaces.Box(-np.inf, np.inf, (self.num_envs, 2), np.float64)

    def get_action_space(self) -> gym.Space[Any]:
        return spaces.MultiDiscrete([9] * self.num_envs)

    def _observation(self) -> Any:
        return np.stack([self.seeds, self.counts], axis=1).astype(float)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        self.seeds = np.array(sub_env_seeds(self, 0 if seed is None else seed))
        self.counts = np.zeros(self.num_envs, int)
        return EnvRet(env_id=self.env_id, observation=self._observation())

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        self.counts += policy_resp.action
        return EnvRet(
            env_id=self.env_id,
            observation=self._observation(),
            last_reward=self.counts.astype(np.float32),
            last_terminated=self.counts >= 9,
            last_truncated=np.zeros(self.num_envs, bool),
        )


@ENVS.register("crowd")
class Crowd(BaseEnv):
    """Two agents with different spaces; "tall" ends one step before "small"."""

    agents = ("tall", "small")

    def get_observation_space(self) -> gym.Space[Any]:
        return spaces.Dict(tall=spaces.Box(-9, 9, (3,)), small=spaces.Discrete(9))

    def get_action_space(self) -> gym.Space[Any]:
        return spaces.Dict(tall=spaces.Box(-1, 1, (1,)), small=spaces.Discrete(2))

    def _result(self, reward: dict[str, float]) -> MultiAgentEnvRet:
        return MultiAgentEnvRet(
            env_id=self.env_id,
            observation={"tall": np.full(3, self.steps, np.float32), "small": self.steps},
            last_reward=reward,
            last_terminated={"tall": self.steps >= 2, "small": self.steps >= 3},
            last_truncated={"tall": False, "small": False},
        )

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> MultiAgentEnvRet:
        self.steps = 0
        return self._result({"tall": 0.0, "small": 0.0})

    def step(self, policy_resp: PolicyResponse) -> MultiAgentEnvRet:
        self.steps += 1
        action = policy_resp.action
        return self._result({"tall": float(action["tall"][0]), "small": float(action["small"])})


@ENVS.register("reusing")
class Reusing(BaseEnv):
    """Returns the same objects each time, changed in place."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.observation: Any = {"array": np.zeros(3), "items": (np.zeros(2),)}
        self.info = {"array": np.zeros(3), "nested": {"list": [0]}}

    def get_observation_space(self) -> gym.Space[Any]:
        array = spaces.Box(-9, 9, (3,), np.float64)
        items = spaces.Box(-9, 9, (2,), np.float64)
        return spaces.Dict(array=array, items=spaces.Sequence(items))

    def get_action_space(self) -> gym.Space[Any]:
        return spaces.Discrete(2)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        return EnvRet(env_id=self.env_id, observation=self.observation, info=self.info)

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        self.observation["array"] += 1
        self.observation["items"][0][:] += 1
        self.info["array"] += 1
        self.info["nested"]["list"][0] += 1
        return EnvRet(env_id=self.env_id, observation=self.observation, info=self.info)
