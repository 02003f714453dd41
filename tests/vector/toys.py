"""Envs with results that identify their origin."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from kit.scripted import Scripted


class Toy(gym.Env[Any, Any]):
    """Ends at random, by its own generator; reports many infos."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 7}
    action_space = spaces.Discrete(3)
    observation_space = spaces.Dict(
        place=spaces.Box(-10, 10, (2,), np.float64), kind=spaces.Discrete(4), name=spaces.Text(9)
    )
    render_mode = "rgb_array"
    speed = 1.0

    def _observed(self) -> Any:
        return {"place": self.place.copy(), "kind": self.count % 4, "name": f"n{self.count}"}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1, 1, 2)
        self.count = 0
        return self._observed(), {"begun": True, "options": str(options)}

    def step(self, action: Any) -> Any:
        self.count += 1
        self.place = np.clip(self.place + (action - 1) * self.speed, -10, 10)
        draw = self.np_random.random()
        info = {"count": self.count, "draw": draw, "ends": {"near": draw < 0.4}}
        if self.count % 2:
            info["odd"] = np.array([self.count, action])
        return self._observed(), float(draw), bool(draw < 0.2), bool(draw > 0.9), info

    def render(self) -> Any:
        return np.full((2, 2, 3), self.count, np.uint8)

    def double(self, value: float, *, plus: float = 0.0) -> float:
        return 2 * value + plus


class Counted(Scripted):
    """Observes [episode, step]; action 1 ends the episode."""

    observation_space = spaces.Box(-1, 99, (2,), np.float64)

    def observed(self) -> Any:
        return np.array([self.resets, self.steps], np.float64)

    def told(self) -> dict[str, Any]:
        return {"count": self.steps} if self.steps else {"begun": self.resets}


class Wrapped(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper with an attribute of its own."""

    own = "the wrapper's"


def toy() -> gym.Env[Any, Any]:
    return Wrapped(Toy())


def assert_alike(found: Any, expected: Any, where: str = "") -> None:
    """Equal in structure, type, dtype, shape and value; the order of keys doesn't matter."""
    # Not at the top: workers, which import this module, don't compare anything.
    from rlightning_aio.vector.lazy_infos import LazyColumns

    found, expected = (
        dict(each) if isinstance(each, LazyColumns) else each for each in (found, expected)
    )
    assert type(found) is type(expected), where
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), where
        for key in expected:
            assert_alike(found[key], expected[key], f"{where}/{key}")
    elif isinstance(expected, tuple | list):
        assert len(found) == len(expected), where
        for k, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_alike(one, other, f"{where}/{k}")
    elif isinstance(expected, np.ndarray):
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape), where
        if expected.dtype == object:
            assert_alike(list(found), list(expected), where)
        else:
            same = found.tobytes() == expected.tobytes()
            assert same, f"{where}: {found}, not {expected}"
    else:
        assert found == expected, where
