"""Workers log as the trainer's program does, and say what is wrong with their Python."""

from __future__ import annotations

import asyncio
import importlib
import importlib.metadata
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from patience import HANG

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio._core.hosts.process import fork_server

PROGRAM = """
import logging

import gymnasium as gym

from rlightning_aio import sync

log = logging.getLogger("own.env")


class Logging(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        for level in (logging.DEBUG, logging.INFO, logging.WARNING):
            log.log(level, "%s of the env", logging.getLevelName(level))
        logging.getLogger("quiet").warning("not wanted")
        return 0, {}


SETTINGS
with sync.build_env_group(Logging, name="e", num_workers=2) as group:
    group.reset()
"""


@pytest.mark.parametrize(
    ("settings", "lines"),
    [
        ("logging.getLogger('quiet').disabled = True", None),
        (
            "logging.basicConfig(level='INFO', format='%(name)s|%(message)s')",
            ["own.env|[e-0] INFO of the env", "own.env|[e-0] WARNING of the env"],
        ),
        (
            "logging.basicConfig(level='INFO', style='{', format='{processName}|{message}')",
            ["e-0|INFO of the env", "e-0|WARNING of the env"],
        ),
        ("logging.basicConfig(level='ERROR')", []),
        ("logging.basicConfig(level='DEBUG'); logging.disable(logging.WARNING)", []),
    ],
)
def test_workers_log_like_the_program(settings: str, lines: list[str] | None) -> None:
    """At its levels and in its format, with their name; a program without any has Python's way."""
    settings += "\nlogging.getLogger('quiet').setLevel(logging.CRITICAL)"
    program = PROGRAM.replace("SETTINGS", settings)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=HANG, check=False
    )
    assert done.returncode == 0, done.stderr
    found = [line for line in done.stderr.splitlines() if "of the env" in line]
    if lines is None:
        assert found == ["WARNING of the env"] * 2
    else:
        assert [line for line in found if "e-1" not in line] == lines
        assert len(found) == 2 * len(lines)
        assert "not wanted" not in done.stderr


def test_an_old_gymnasium_is_named_with_the_version_that_is_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ahead of the error that it causes; an interpreter of an entry may have one."""

    def imported(name: str) -> Any:
        raise ImportError("cannot import name 'AutoresetMode'")

    monkeypatch.setattr(importlib, "import_module", imported)
    trainer: Any = None
    monkeypatch.setattr(fork_server, "_watch_trainer", lambda *_: None)
    for version, words in (("0.29.1", "has gymnasium 0.29.1, and workers need 1.2"), ("1.3.0", "")):
        monkeypatch.setattr(importlib.metadata, "version", lambda _, found=version: found)
        error = fork_server._import(trainer, -1, ())  # noqa: SLF001
        assert error is not None
        assert error.partition("Traceback")[0].removeprefix(f"{sys.executable} ").startswith(words)
        assert "AutoresetMode" in error
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    (needed,) = [one for one in project["project"]["dependencies"] if one.startswith("gymnasium")]
    assert needed.endswith(">=" + ".".join(map(str, fork_server.GYMNASIUM)))


class Looping:
    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return type(asyncio.get_running_loop()).__module__.partition(".")[0], {}

    async def step(self, action: Any) -> Any:
        raise NotImplementedError


@pytest.mark.parametrize(("value", "module"), [("0", "asyncio"), ("1", "uvloop")])
def test_workers_of_awaitable_envs_can_do_without_uvloop(value: str, module: str) -> None:
    """Some libraries, such as nest_asyncio, can't do with it."""
    entry = rl.EnvConfig(name="e", task=Looping, env_vars={"RLIGHTNING_AIO_UVLOOP": value})
    with sync.build_env_group(entry) as group:
        assert group.reset()[0].observation == [module]
