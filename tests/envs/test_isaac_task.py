"""Isaac Lab's launch order and overrides, tested without Isaac Lab."""

from __future__ import annotations

import importlib.util
import math
import re
import sys
import threading
import tomllib
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators import isaac_task
from rlightning_aio.errors import ConfigError

ROOT = Path(__file__).parents[2]
CONFIG = EnvConfig(
    name="isaac", backend="isaac_manager_based", task="stub_package::Cfg", num_envs=3,
    env_kwargs={"device": "cuda:1", "launcher": {"enable_cameras": True}},
)  # fmt: skip


class Cfg:
    """Has the fields of every Isaac Lab configuration."""

    def __init__(self) -> None:
        self.sim = SimpleNamespace(device="cuda:0", dt=0.01)
        self.scene = SimpleNamespace(num_envs=1)
        self.decimation = 2
        self.episode_length_s = 5.0
        self.seed: int | None = None


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Replace an installed Isaac Lab 2.3, and record calls in order."""
    events: list[Any] = []

    def app_launcher(**kwargs: Any) -> object:
        events.append(("launch", kwargs))
        return object()

    class Watched(ModuleType):
        def __getattr__(self, name: str) -> Any:
            events.append(("use", self.__name__))
            raise AttributeError(name)

    app = ModuleType("isaaclab.app")
    app.AppLauncher = app_launcher  # type: ignore[attr-defined]
    package = ModuleType("stub_package")
    package.Cfg = Cfg  # type: ignore[attr-defined]
    package.Env = lambda cfg: cfg  # type: ignore[attr-defined]
    package_root = ModuleType("isaaclab")
    package_root.__spec__ = ModuleSpec("isaaclab", None)
    for name, module in {
        "isaaclab": package_root,
        "isaaclab.app": app,
        "isaaclab_tasks": Watched("isaaclab_tasks"),
        "isaaclab_tasks.utils": Watched("isaaclab_tasks.utils"),
        "stub_package": package,
    }.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(isaac_task, "_launched", [])
    return events


def test_isaac_lab_2_launches_its_app_first(events: list[Any]) -> None:
    """Without `launch_simulation` the app starts once, with the entry's arguments."""
    for _ in range(2):
        cfg = isaac_task.make_simulator("isaac-0", CONFIG, "stub_package::Env")
        assert (cfg.sim.device, cfg.scene.num_envs) == ("cuda:1", 3)
    launch = ("launch", {"headless": True, "enable_cameras": True, "device": "cuda:1"})
    assert events[0] == launch
    assert ("use", "isaaclab_tasks.utils") in events
    assert events.count(launch) == 1


def test_isaac_lab_2_needs_the_main_thread(events: list[Any]) -> None:
    """Isaac Sim can't start in another thread; the message says what to do."""
    raised: list[Exception] = []

    def build() -> None:
        try:
            isaac_task.make_simulator("isaac-0", CONFIG, "stub_package::Env")
        except ConfigError as error:
            raised.append(error)

    thread = threading.Thread(target=build)
    thread.start()
    thread.join()
    assert "main thread only; use placement: process" in str(raised[0])
    assert events == []


@pytest.mark.parametrize("steps", [1, 7, 50, 333, 1000])
def test_the_step_limit_survives_the_simulators_rounding(events: list[Any], steps: int) -> None:
    """`max_episode_steps` becomes a length in seconds that rounds up to the same number
    of steps.
    """
    config = CONFIG.model_copy(update={"max_episode_steps": steps})
    cfg = isaac_task.make_simulator("isaac-0", config, "stub_package::Env")
    assert math.ceil(cfg.episode_length_s / (cfg.decimation * cfg.sim.dt)) == steps


@pytest.mark.parametrize(
    ("given", "worker_index", "taken"), [(7, 0, 7), (7, 2, 13), (None, 2, None), (-1, 2, -1)]
)
def test_each_env_of_an_entry_is_built_with_its_own_seed(
    events: list[Any], given: int | None, worker_index: int, taken: int | None
) -> None:
    """Seeds count sub-environments, as those of resets; without a seed, or with Isaac Lab's value
    for any seed, nothing is counted.
    """
    env_kwargs = {**CONFIG.env_kwargs, "overrides": {"seed": given}}
    config = CONFIG.model_copy(update={"env_kwargs": env_kwargs})
    cfg = isaac_task.make_simulator("isaac-0", config, "stub_package::Env", worker_index)
    assert cfg.seed == taken


def test_a_python_without_isaac_lab_is_named() -> None:
    """The message has the Python, the field that chooses another one, and the command of the extra
    that makes such a Python.
    """
    if importlib.util.find_spec("isaaclab"):
        pytest.skip("Isaac Lab is here")
    with pytest.raises(ConfigError, match=rf"isaac-0: {sys.executable} has no Isaac Lab") as raised:
        isaac_task.make_simulator("isaac-0", CONFIG, None)
    assert str(raised.value).endswith(
        "interpreter to the Python of an environment made by: pip install 'rlightning-aio[isaac]' "
        "&& pip install --ignore-requires-python --no-deps isaaclab==3.0.0"
    )


def test_the_extra_has_the_packages_for_terrains_and_assets() -> None:
    """Isaac Lab is installed without its dependencies, so the extra lists them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extra = project["optional-dependencies"]["isaac"]
    names = {re.split(r"[\[=>]", line)[0] for line in extra}
    assert {"omniverseclient", "scipy", "trimesh"} <= names
    pinned = (ROOT / "tests/simulators/isaac.txt").read_text().splitlines()
    assert names <= {re.split(r"[\[=]", line)[0] for line in pinned}
