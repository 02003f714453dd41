"""Envs of OpenEnv, served by its own `create_app` or stepped directly, by its own Python.

Usage: openenv_server.py serve KIND PORT SESSIONS
       openenv_server.py direct KIND SESSIONS EPISODES

`echo` is the env of OpenEnv's own template, and `dice` has a seed and a time limit. `direct` prints
what each session's episodes return, as JSON.
"""

# It runs in a Python of its own, with packages that are not here.
# pyright: basic, reportMissingImports=false

from __future__ import annotations

import json
import random
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import openenv
import uvicorn
from openenv.core.env_server import create_app
from openenv.core.env_server.interfaces import Environment
from openenv.core.env_server.serialization import deserialize_action
from openenv.core.env_server.types import Action, Observation, State
from openenv_actions import STEPS, action_of, seed_of


class Move(Action):
    move: int = 0


class Rolled(Observation):
    total: int = 0
    roll: float = 0.0


class Dice(Environment):
    """Adds moves up; ends at ten, or is truncated after six steps."""

    SUPPORTS_CONCURRENT_SESSIONS = True

    def __init__(self) -> None:
        super().__init__()
        self._state = State()

    def _rolled(self, **fields: Any) -> Rolled:
        return Rolled(total=self.total, roll=self.random.random(), **fields)

    def reset(
        self, seed: int | None = None, episode_id: str | None = None, start: int = 0, **kwargs: Any
    ) -> Rolled:
        self.random, self.total = random.Random(seed), start
        self._state = State(episode_id=episode_id, step_count=0)
        return self._rolled(metadata={"seed": seed})

    def step(self, action: Move, timeout_s: float | None = None, **kwargs: Any) -> Rolled:
        self.total += action.move
        self._state.step_count += 1
        late = self._state.step_count >= 6
        done = late or self.total >= 10
        return self._rolled(reward=float(action.move), done=done, metadata={"late": late})

    @property
    def state(self) -> State:
        return self._state


def echo() -> tuple[Any, Any, Any]:
    """The env that `openenv init echo_env` makes."""
    folder = Path(tempfile.mkdtemp()) / "echo_env"
    assert openenv.__file__ is not None
    template = Path(openenv.__file__).parent / "cli/templates/openenv_env"
    shutil.copytree(template, folder, ignore=shutil.ignore_patterns("__pycache__"))
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        text = path.read_text()
        for mark, value in (("CLASS_NAME", "Echo"), ("TITLE_NAME", "Echo"), ("NAME", "echo")):
            text = text.replace(f"__ENV_{mark}__", value)
        path.write_text(text)
        path.rename(path.with_name(path.name.replace("__ENV_NAME__", "echo")))
    sys.path.insert(0, str(folder))
    from models import EchoAction, EchoObservation
    from server.echo_environment import EchoEnvironment

    shutil.rmtree(folder.parent)
    return EchoEnvironment, EchoAction, EchoObservation


def classes(kind: str) -> tuple[Any, Any, Any]:
    """The classes of the env, of its actions and of its observations."""
    return echo() if kind == "echo" else (Dice, Move, Rolled)


def direct(kind: str, sessions: int, episodes: int) -> list[Any]:
    """Return rows of observation, reward, done and metadata: of each session, each episode."""
    env_cls, action_cls, _ = classes(kind)
    envs = [env_cls() for _ in range(sessions)]
    return [
        [_episode(kind, env, action_cls, k, episode) for episode in range(episodes)]
        for k, env in enumerate(envs)
    ]


def _episode(kind: str, env: Any, action_cls: Any, k: int, episode: int) -> list[Any]:
    rows = [_row(env.reset(seed=seed_of(k, episode)))]
    while len(rows) <= STEPS and not rows[-1][2]:
        action = action_of(kind, k, episode, len(rows) - 1)
        rows.append(_row(env.step(deserialize_action(action, action_cls))))
    return rows


def _row(observation: Observation) -> list[Any]:
    fields = observation.model_dump(mode="json")
    reward, done, metadata = (fields.pop(name) for name in ("reward", "done", "metadata"))
    return [fields, float(reward or 0), done, metadata]


if __name__ == "__main__":
    what, kind, *numbers = sys.argv[1:]
    if what == "serve":
        app = create_app(*classes(kind), env_name=kind, max_concurrent_envs=int(numbers[1]))
        uvicorn.run(app, host="127.0.0.1", port=int(numbers[0]), log_level="warning")
    else:
        print(json.dumps(direct(kind, *map(int, numbers))))  # noqa: T201
