"""The fork server and the trainer's handle on it, with all kinds of interpreters."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from patience import HANG

from rlightning_aio._core.hosts.arena import Arena
from rlightning_aio._core.hosts.messages import Death, WorkerPlace
from rlightning_aio._core.hosts.process import fork_server
from rlightning_aio._core.hosts.process.fork_messages import Exited, Fork
from rlightning_aio._core.hosts.process.host import ForkServerHandle

if TYPE_CHECKING:
    from pathlib import Path


class Asker:
    """A host that records why its fork server ended; and a watcher."""

    host_id = 0
    why = ""

    def on_end(self, death: Death) -> None:
        self.why = death.cause.removeprefix("ended with its fork server: ")

    def watch(self, source: Any) -> None: ...

    def unwatch(self, source: Any) -> None: ...

    def watch_writable(self, source: Any, wanted: bool) -> None: ...


def lost(interpreter: str) -> str:
    """Return the reason why a fork server ended, as a trainer gets it that reads late."""
    asker: Any = Asker()
    server = ForkServerHandle(interpreter, {}, ("gymnasium",), asker)
    channel, worker = socket.socketpair()
    arena = Arena()
    server.fork(asker, worker, arena, Fork(WorkerPlace(0, 1, 0, 1, 0, 0)))
    assert server._server is not None
    os.waitid(os.P_PID, server._server.process.pid, os.WEXITED | os.WNOWAIT)
    server.on_readable()
    channel.close()
    arena.close()
    return asker.why


def script(path: Path, text: str) -> str:
    path.write_text(text)
    path.chmod(0o755)
    return str(path)


def test_missing_packages_are_reported_to_a_trainer_that_reads_late(tmp_path: Path) -> None:
    """The fork server has ended by then, with unread orders; the reason comes before its exit."""
    bare = script(tmp_path / "bare", f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')
    why = lost(bare)
    assert why.startswith("Traceback")
    assert "ModuleNotFoundError: No module named" in why.splitlines()[-1]


def test_an_old_interpreter_is_reported_with_its_version(tmp_path: Path) -> None:
    """It supports no new options, and can't import our code."""
    old = script(
        tmp_path / "old",
        f"#!{sys.executable}\n"
        "import sys\n"
        "assert sys.argv[1] == '-c', 'unknown option'\n"
        "code = sys.argv[2]\n"
        "sys.argv[:3] = ['-c']\n"
        "sys.version_info = (3, 9, 2, 'final', 0)\n"
        "exec(code)\n",
    )
    assert lost(old) == (
        f"its interpreter {sys.executable} is Python 3.9.2, and workers need Python 3.11 or later"
    )


@pytest.mark.parametrize(("program", "code"), [("true", 0), ("false", 1)])
def test_a_program_that_is_no_interpreter_is_reported_with_its_exit_code(
    program: str, code: int
) -> None:
    """It leaves no zombie."""
    assert lost(f"/bin/{program}") == (
        f"it exited with code {code} while it was importing gymnasium; is /bin/{program} a Python "
        "with the packages that workers need?"
    )


def test_an_exit_is_reported_even_if_another_process_continues_to_write(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The worker started it; it fills the stderr of the worker faster than that is read."""
    reader, writer = os.pipe()
    os.set_blocking(reader, False)
    os.write(writer, b"x" * 50_000 + b"last words")
    reads: list[int] = []
    read = os.read

    def read_what_is_refilled(descriptor: int, most: int) -> bytes:
        data = read(descriptor, most)
        reads.append(len(data))
        assert len(reads) < 100, "it reads for ever"
        os.write(writer, b"y" * len(data))
        return data

    monkeypatch.setattr(os, "read", read_what_is_refilled)
    sent: list[Any] = []
    pid = os.posix_spawn("/bin/false", ["false"], {})
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    server: Any = object.__new__(fork_server._ForkServer)
    server._poll, server._left = select.poll(), set()
    monkeypatch.setattr(fork_server, "kill_below", lambda *_, **__: None)  # It isn't one.
    server._trainer = type("Trainer", (), {"send": sent.append})
    channel = os.open(os.devnull, os.O_RDONLY)
    server._children = {pid: fork_server._Child(7, pid, [fork_server._Output(reader, 2)], channel)}
    server._handle_exits()
    os.close(writer)
    (exited,) = sent
    assert isinstance(exited, Exited)
    assert (exited.host_id, exited.exit_code) == (7, 1)
    assert exited.stderr_tail.endswith("last words")


PRINTING = """
import os, sys
import gymnasium as gym
from rlightning_aio import sync


class Printing(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        print("a line of reset")
        return 0, {}

    def step(self, action):
        print("to stdout")
        print("to stderr", file=sys.stderr)
        if action:
            os.kill(os.getpid(), 9)
        return 0, 0.0, False, False, {}


with sync.build_env_group(Printing) as group:
    batch, _ = group.reset(seed=0)
    for action in (0, 1):
        batch, _ = group.step(batch.respond(action=[action]))
"""


def test_what_an_env_prints_goes_to_stdout(tmp_path: Path) -> None:
    """At once, so that the last lines of a worker that is killed are there, too."""
    (tmp_path / "printing.py").write_text(PRINTING)
    command = [sys.executable, tmp_path / "printing.py"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines() == ["a line of reset", *["to stdout"] * 2, "a line of reset"]
    assert ended.stderr.count("to stderr\n") >= 2


def test_a_program_with_one_output_shows_lines_in_their_order(tmp_path: Path) -> None:
    """As on a terminal, where stdout and stderr are the same."""
    (tmp_path / "printing.py").write_text(PRINTING)
    with (tmp_path / "output").open("w") as output:
        command = [sys.executable, tmp_path / "printing.py"]
        subprocess.run(command, stdout=output, stderr=output, check=True, timeout=HANG)
    lines = (tmp_path / "output").read_text().splitlines()
    assert lines[:3] == ["a line of reset", "to stdout", "to stderr"]
