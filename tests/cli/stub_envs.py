"""Envs that count, fail, die and hang on demand; a config registers them by importing this."""

from __future__ import annotations

import atexit
import math
import os
import subprocess
import threading
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from kit.scripted import Awaitable, Counts

import rlightning_aio as rl
from rlightning_aio.spaces import Anything


@rl.ENVS.register("stub")
class Stub(rl.BaseEnv):
    """Observes its number of steps; ends after ``episode_length`` of them, reward 1 each."""

    steps: ClassVar[int] = 0
    """Executed in this process by all stubs together, one for each sub-environment."""

    def __init__(self, config: rl.EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.options = config.env_kwargs
        self.count = 0

    def _batched(self, space: gym.Space[Any]) -> gym.Space[Any]:
        return gym.vector.utils.batch_space(space, self.num_envs) if self.num_envs > 1 else space

    def get_observation_space(self) -> gym.Space[Any]:
        shape = (self.options.get("observation_size", 1),)
        return self._batched(gym.spaces.Box(-np.inf, np.inf, shape, np.float32))

    def get_action_space(self) -> gym.Space[Any]:
        return self._batched(gym.spaces.Discrete(self.options.get("actions", 2)))

    def _ret(self, **fields: Any) -> rl.EnvRet:
        space = self.get_observation_space()
        observation = np.full(space.shape, self.count, np.float32)
        heads = {"last_reward": 0.0, "last_terminated": False, "last_truncated": False, **fields}
        if self.num_envs > 1:
            heads = {name: np.full(self.num_envs, value) for name, value in heads.items()}
        return rl.EnvRet(env_id=self.env_id, observation=observation, **heads)

    def reset(self, *, seed: Any = None, options: Any = None) -> rl.EnvRet:
        self.count = 0
        return self._ret()

    def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        self.count += 1
        Stub.steps += self.num_envs
        ended = self.count >= self.options.get("episode_length", 10)
        return self._ret(last_reward=1.0, last_terminated=ended)


@rl.ENVS.register("nan")
class NotANumber(Stub):
    """Has rewards that are none."""

    def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        found = super().step(policy_resp)
        return found.model_copy(update={"last_reward": found.last_reward * math.nan})


@rl.ENVS.register("raising")
class Raising(Stub):
    """Raises in its third step."""

    def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        if self.count == 2:
            raise ZeroDivisionError("the floor is missing")
        return super().step(policy_resp)


@rl.ENVS.register("dying")
class Dying(Stub):
    """Its process ends with ``status``, or by that signal, in its third step."""

    def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        if self.count == 2:
            status = self.options.get("status", 7)
            if status < 0:
                os.kill(os.getpid(), -status)
            os._exit(status)
        return super().step(policy_resp)


@rl.ENVS.register("unbuildable")
class Unbuildable(Stub):
    """Can't be built."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        raise FileNotFoundError("no such robot")


@rl.ENVS.register("stuck")
class Stuck(Stub):
    """Hangs when it is built or in its third step, after writing its process id to a file.

    ``env_kwargs``: `where`, ``init`` or ``step``; `only` in that placement.
    """

    def __init__(self, config: rl.EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self._hang_in("init")

    def _hang_in(self, place: str) -> None:
        here = self.config.placement
        if (place, here) == (self.options["where"], self.options.get("only", here)):
            Path(self.options["pid_file"]).write_text(str(os.getpid()))
            threading.Event().wait()

    def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        if self.count == 2:
            self._hang_in("step")
        return super().step(policy_resp)


@rl.ENVS.register("worker_only")
class WorkerOnly(Stub):
    """Refuses to be built in the process of the command."""

    def __init__(self, config: rl.EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        if config.placement == "inline":
            raise OSError("needs a process of its own")


@rl.ENVS.register("unclosable")
class Unclosable(Stub):
    """Fails while it is closed."""

    def close(self) -> None:
        raise RuntimeError("the lid is stuck")


@rl.ENVS.register("talkative")
class Talkative(Stub):
    """Prints in every possible way, until its process ends."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        print("made")  # noqa: T201
        atexit.register(print, "gone")

    def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        if self.count == 0:
            print("stepped")  # noqa: T201
            os.write(1, b"stepped in C\n")
            subprocess.run(["echo", "stepped elsewhere"], check=True)
        return super().step(policy_resp)

    def close(self) -> None:
        print("closed")  # noqa: T201


@rl.ENVS.register("finishing")
class Finishing(Stub):
    """Finishes after ``wanted_steps``; creates a file when it is closed."""

    def __init__(self, config: rl.EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.total = 0

    def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        self.total += 1
        return super().step(policy_resp)

    def is_finish(self) -> bool:
        return self.total >= self.options["wanted_steps"]

    def close(self) -> None:
        Path(self.options["closed_file"]).touch()


class Talk:
    """Its actions are anything, so that only a policy can choose them."""

    observation_space = action_space = Anything()

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return "hello", {}

    async def step(self, action: Any) -> Any:
        raise AssertionError


class Plays(Counts):
    """Episodes have five steps, whatever is done."""

    action_space = gym.spaces.Discrete(2)
    length = 5


class Casting(Plays):
    """Returns observations whose dtypes are not those of their space, except one."""

    observation_space = gym.spaces.Dict(
        {
            "pose": gym.spaces.Box(-1, 1, (2,)),
            "goal": gym.spaces.Box(-1, 1, (2,)),
            "count": gym.spaces.Box(0, 99, (1,), np.int32),
            "list": gym.spaces.Box(-1, 1, (2,)),
            "number": gym.spaces.Discrete(9),
            "both": gym.spaces.Tuple([gym.spaces.Discrete(9), gym.spaces.Box(-1, 1, (2,))]),
        }
    )

    def observed(self) -> Any:
        return {
            "pose": np.full(2, 0.1),
            "goal": np.full(2, 0.5, np.float32),
            "count": np.full(1, self.steps),
            "list": [0.5, 0.5],
            "number": 3,
            "both": (3, np.zeros(2)),
        }


class AwaitedCasting(Awaitable):
    """The same, awaited."""

    def __init__(self) -> None:
        super().__init__(Casting)


class Beyond(Plays):
    """Counts its steps, although its space ends at 1."""

    observation_space = gym.spaces.Box(0, 1, (1,))

    def observed(self) -> Any:
        return np.full(1, min(self.steps, 2), np.float32)


class Exclusive(Plays):
    """Only one of them may be open."""

    observation_space = gym.spaces.Discrete(9)

    def __init__(self, folder: str) -> None:
        super().__init__()
        self._lock = Path(folder, "lock")
        self._lock.mkdir()

    def observed(self) -> Any:
        return self.steps

    def close(self) -> None:
        self._lock.rmdir()


class Masked(Plays):
    """Allows one action at a time, and refuses all others."""

    def __init__(self, where: str = "info", render_mode: str | None = None) -> None:
        super().__init__()
        self.render_mode = render_mode
        self.action_space = gym.spaces.Discrete(4, start=1)
        mask = gym.spaces.MultiBinary(4)
        number = gym.spaces.Discrete(9)
        self._in_info = where == "info"
        self.observation_space = (
            number if self._in_info else gym.spaces.Dict({"n": number, "action_mask": mask})
        )

    def _mask(self) -> Any:
        return np.eye(4, dtype=np.int8)[self.steps % 4]

    def does(self, action: Any) -> float:
        assert action == 1 + self.steps % 4, "a forbidden action"
        return 1.0

    def observed(self) -> Any:
        return self.steps if self._in_info else {"n": self.steps, "action_mask": self._mask()}

    def told(self) -> dict[str, Any]:
        return {"action_mask": self._mask()} if self._in_info else {}


gym.register("cli/Masked-v0", Masked)


class Leaky(Plays):
    """Keeps 4 MB of each episode."""

    observation_space = gym.spaces.Box(0, 1, (2,))
    kept: ClassVar[list[Any]] = []

    def does(self, action: Any) -> float:
        return 1.0

    def observed(self) -> Any:
        if not self.steps:
            self.kept.append(np.ones(4_000_000, np.uint8))
        return self.np_random.random(2, np.float32)


class Careless(Plays):
    """Draws from a generator that nobody seeds, forgets files, and divides by zero."""

    observation_space = gym.spaces.Box(0, 1, (2,))
    files: ClassVar[list[Any]] = []

    def does(self, action: Any) -> float:
        return math.nan

    def observed(self) -> Any:
        if not self.steps:
            self.files.append(Path(__file__).open())  # noqa: SIM115
        return np.random.default_rng().random(2, np.float32)
