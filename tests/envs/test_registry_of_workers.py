"""What the program has changed in Gymnasium's registry holds in workers, too."""

from __future__ import annotations

import copy
import sys
import threading
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import WrapperSpec
from kit.scripted import Counts

import rlightning_aio.sync as rl
from rlightning_aio.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

ID = "Pendulum-v1"
LIMIT = 3


class Told(Counts):
    """Not Gymnasium's pendulum."""

    observation_space = action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def __init__(self, *, told: str = "nothing") -> None:
        self.words = told

    def told(self) -> dict[str, Any]:
        return {"told": self.words}


@pytest.fixture(autouse=True)
def registry() -> Iterator[None]:
    before = copy.deepcopy(gym.registry)
    yield
    gym.registry.clear()
    gym.registry.update(before)


def _spec() -> Any:
    return gym.registry[ID]


def _change_limit() -> None:
    _spec().max_episode_steps = LIMIT


def _change_class() -> None:
    spec = _spec()
    spec.entry_point, spec.max_episode_steps, spec.kwargs = Told, LIMIT, {"told": "class"}


def _register_anew() -> None:
    with pytest.warns(UserWarning, match="Overriding environment"):
        gym.register(ID, "envs.test_registry_of_workers:Told", max_episode_steps=LIMIT)


def _add_wrapper() -> None:
    wrapper = WrapperSpec("TimeLimit", "gymnasium.wrappers:TimeLimit", {"max_episode_steps": LIMIT})
    _spec().additional_wrappers = (wrapper,)


CHANGES = [_change_limit, _change_class, _register_anew, _add_wrapper]


def first_end(act: Callable[[], tuple[Any, Any]]) -> int:
    """The number of the step that ends an episode."""
    for step in range(1, 300):
        terminated, truncated = act()
        if np.any(terminated) or np.any(truncated):
            return step
    raise AssertionError("no end")


@pytest.mark.parametrize("change", CHANGES)
def test_groups_have_the_task_as_the_program_has_it(change: Callable[[], None]) -> None:
    change()
    for fields in (
        {"backend": "gymnasium", "task": ID, "num_workers": 2},
        {"backend": "gymnasium", "task": ID, "num_envs": 2},
        {"backend": "callable", "task": lambda: gym.make(ID)},
    ):
        with rl.build_env_group({"name": "e", **fields}) as group:
            batches = [group.reset(seed=1)[0]]

            def act(group: Any = group, batches: Any = batches) -> tuple[Any, Any]:
                actions = np.zeros_like(batches[-1].observation[..., :1])
                batches.append(group.step(batches[-1].respond(action=actions))[0])
                return batches[-1].terminated, batches[-1].truncated

            assert first_end(act) == LIMIT


def test_a_module_that_a_worker_imports_does_not_undo_what_the_program_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But what an env's own code registers counts, and ids that the program doesn't know."""
    lines = [
        f"gym.register('{name}-v0', 'envs.test_registry_of_workers:Told', kwargs={{'told': 'old'}})"
        for name in ("Changed", "Unchanged")
    ]
    (tmp_path / "registers_tasks.py").write_text("\n".join(["import gymnasium as gym", *lines]))
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    __import__("registers_tasks")
    gym.registry["Changed-v0"].kwargs["told"] = "new"

    def imports(name: str) -> Any:
        __import__("registers_tasks")
        return gym.make(name)

    def registers() -> Any:
        register: Any = gym.register
        register("Changed-v0", Told, kwargs={"told": "own"})
        return gym.make("Changed-v0")

    makers: Any = [lambda: imports("Changed-v0"), lambda: imports("Unchanged-v0"), registers]
    envs = VectorEnv(makers)
    _, infos = envs.reset()
    assert list(infos["told"]) == ["new", "old", "own"]
    envs.close()
    entry = {"name": "e", "backend": "gymnasium", "task": "registers_tasks:Changed-v0"}
    for fields in ({}, {"imports": ["registers_tasks"], "task": "Changed-v0"}):
        with rl.build_env_group({**entry, **fields}) as group:
            assert group.reset()[0].info("told") == ["new"]
    del sys.modules["registers_tasks"]


def test_workers_import_a_task_of_the_program_when_they_make_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trainer that has imported a simulator has all its tasks; other workers don't need it."""
    (tmp_path / "a_simulator.py").write_text(
        "import gymnasium as gym\n"
        "def make(**kwargs): return gym.make('Pendulum-v1', **kwargs)\n"
        f"gym.register('Simulated-v0', make, max_episode_steps={LIMIT})\n"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    __import__("a_simulator")

    def told(name: str | None) -> Any:
        """The env of a task, and whether its simulator was imported before it was made."""
        env = Told(told=str("a_simulator" in sys.modules))
        if name is not None:
            env.words += f" {gym.make(name).spec.max_episode_steps}"  # type: ignore[union-attr]
        return env

    envs = VectorEnv([lambda: told(None), lambda: told("Simulated-v0")])
    assert list(envs.reset()[1]["told"]) == ["False", f"False {LIMIT}"]
    envs.close()
    del sys.modules["a_simulator"]


def test_envs_of_a_worker_have_the_same_class_of_the_program() -> None:
    """A class may hold what its envs share. Another task may hold what no worker can have."""

    class Numbered(Told):
        made = 0

        def __init__(self) -> None:
            type(self).made += 1
            super().__init__(told=str(self.made))

    gym.register("Numbered-v0", Numbered)
    gym.register("Locked-v0", Told, kwargs={"lock": threading.Lock()})
    envs = VectorEnv([lambda: gym.make("Numbered-v0")] * 2, max_concurrency=1)
    assert list(envs.reset()[1]["told"]) == ["1", "2"]
    envs.close()
