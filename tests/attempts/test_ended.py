"""A run that is told to end closes its envs."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import rlightning_aio as rl
from rlightning_aio.attempts import EpisodeSpec, play


class Sandbox:
    """Has a file until it is closed, which takes a while."""

    def __init__(self, folder: str, seconds: float) -> None:
        self.file, self.seconds = Path(folder, f"{time.monotonic_ns()}"), seconds
        self.file.touch()

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return "", {}

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(3600)

    async def close(self) -> None:
        await asyncio.sleep(self.seconds)
        self.file.unlink()


async def agent(episode: Any) -> None:
    os.write(1, b"plays\n")
    await episode.step("go")


async def run(folder: str, placement: str, seconds: float) -> None:
    sandbox = {"folder": folder, "seconds": seconds}
    async with rl.build_env_group(
        Sandbox, name="box", num_workers=4, placement=placement, env_kwargs=sandbox
    ) as group:
        async for _ in play(group, [EpisodeSpec("", k) for k in range(9)], agent):
            pass


def ended(folder: Path, placement: str, seconds: float, *signals: int) -> tuple[int, str]:
    """Send signals to a run, each after it has written a line; return how it ended."""
    command = [sys.executable, "-m", "attempts.test_ended", str(folder), placement, str(seconds)]
    surroundings = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=surroundings, **pipes) as process:
        for number in signals:
            assert process.stdout is not None
            assert process.stdout.readline()
            process.send_signal(number)
            time.sleep(0.5)
        errors = process.communicate()[1]
    return process.returncode, errors


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("placement", ["loop", "process"])
def test_sandboxes_are_deleted(tmp_path: Path, placement: str, number: int) -> None:
    code, errors = ended(tmp_path, placement, 1.0, number)
    assert code != 0
    assert "KeyboardInterrupt" in errors
    assert [*tmp_path.iterdir()] == []


def test_a_second_interrupt_says_what_is_left(tmp_path: Path) -> None:
    _, errors = ended(tmp_path, "loop", 3600.0, signal.SIGINT, signal.SIGINT)
    assert "these envs were not closed: box-0, box-1, box-2, box-3" in errors


def test_envs_in_threads_do_not_wait_for_one_another() -> None:
    """All of them meet in their threads, however few cores there are."""
    together = threading.Barrier(100)

    async def main() -> None:
        await asyncio.gather(*(asyncio.to_thread(together.wait, 60) for _ in range(100)))

    rl.run(main())


def test_a_loop_that_is_left_says_nothing(caplog: pytest.LogCaptureFixture) -> None:
    """By `break`, without `aclosing`, while attempts play and fail."""

    class Away:
        async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            if seed:
                raise OSError("the service is away")
            return "", {}

        async def step(self, action: Any) -> Any:
            return "", 1.0, True, False, {}

    async def main() -> None:
        async with rl.build_env_group(Away, num_workers=8, placement="loop") as group:
            async for attempts in play(group, [EpisodeSpec("", k) for k in range(99)], agent, 2):
                assert attempts.spec.seed == 0
                break

    rl.run(main())
    gc.collect()
    # Warnings are of a slow machine.
    said = [one for one in caplog.records if (one.name, one.levelname) == ("asyncio", "ERROR")]
    assert not [one.getMessage() for one in said]


if __name__ == "__main__":
    rl.run(run(sys.argv[1], sys.argv[2], float(sys.argv[3])))
