"""`SwitchingEnv`: a Gymnasium environment that a reset switches to another task."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["SwitchingEnv"]


class SwitchingEnv(gym.Env[Any, Any]):
    """Holds the simulator of one task, and makes that of another when a reset names it.

    The info of each reset has the name as ``task``. Other options are passed on.

    Args:
        make: makes the simulator of a task.
        task: the first task.
        observation_space: of all tasks; None for that of the first, which the others must have.
    """

    switches_task = True

    def __init__(
        self,
        make: Callable[[str], gym.Env[Any, Any]],
        task: str,
        observation_space: gym.Space[Any] | None = None,
    ) -> None:
        self._make, self.task = make, task
        self.env = make(task)
        self._differs = observation_space is not None
        self.observation_space = observation_space or self.env.observation_space
        self.action_space = self.env.action_space
        self.metadata = self.env.metadata
        self.render_mode = self.env.render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of ``options["task"]``, or of the current task."""
        rest = {**(options or {})}
        task = rest.pop("task", self.task)
        if task != self.task:
            self._switch(task)
        observation, info = self.env.reset(seed=seed, options=rest or None)
        return observation, {**info, "task": task}

    def _switch(self, task: str) -> None:
        env = self._make(task)
        same = self._differs or env.observation_space == self.observation_space
        if not same or env.action_space != self.action_space:
            env.close()
            raise ValueError(
                f"task {task!r} has other spaces than {self.task!r}, so one env can't switch "
                f"between them: {env.observation_space}, {env.action_space}"
            )
        self.env.close()
        self.env, self.task = env, task

    def step(self, action: Any) -> Any:
        return self.env.step(action)

    def render(self) -> Any:
        return self.env.render()

    def close(self) -> None:
        self.env.close()
