"""Measures each place that steps envs itself in a process of its own, which an env may end.

Rule: this process asks, the child answers each question with a value or an error; both are pickles,
each behind its size. The child ends when its stdin does. Groups whose envs are all in workers are
measured by this process.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import os
import pickle
import sys
import warnings
from asyncio.subprocess import PIPE
from typing import TYPE_CHECKING, Any, BinaryIO, Final, TextIO

import rlightning_aio
from rlightning_aio._core.hosts.process.fork_server import die_with_parent
from rlightning_aio._core.hosts.process.host import ending
from rlightning_aio._core.hosts.standard_streams import stdout_set_aside
from rlightning_aio.cli import show_warning
from rlightning_aio.cli.bench.baselines import Baseline, opened_baseline
from rlightning_aio.cli.bench.measuring import opened_group, raise_if_all_failed
from rlightning_aio.cli.bench.settings import Setting
from rlightning_aio.cli.policies.policies import load_policy
from rlightning_aio.cli.terminal import in_words
from rlightning_aio.errors import ConfigError, RLightningError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Sequence
    from pathlib import Path

    from rlightning_aio.cli.bench.measuring import (
        Costs,
        Limits,
        Measurable,
        Place,
        Round,
        Rule,
        Stands,
    )

__all__ = ["main", "opened"]

_PROGRAM: Final = """
import sys
sys.path[:] = sys.argv[1:]
from rlightning_aio.cli.bench.apart import main
main()
"""
_SIZE: Final = 8
_CLOSE_SECONDS: Final = 2.0
"""Time for a child to close its envs, after which it is killed."""


@contextlib.asynccontextmanager
async def opened(
    places: Sequence[Place], policy: str | None = None, seed: int = 0
) -> AsyncGenerator[Stands]:
    """Open all places. Yield them, and an error for each that could not start.

    Raises:
        RLightningError: no place could start.
    """
    async with contextlib.AsyncExitStack() as stack:
        found: Stands = {}
        for place in places:
            open_place = _opened_in_child if place.steps_here else _opened_here
            try:
                found[place] = await stack.enter_async_context(open_place(place, policy, seed))
            except RLightningError as error:
                found[place] = error
        raise_if_all_failed(found)
        yield found


@contextlib.asynccontextmanager
async def _opened_here(place: Place, policy: str | None, seed: int) -> AsyncGenerator[Measurable]:
    for config in place.configs:
        for module in config.imports:
            importlib.import_module(module)  # A child has not loaded the config itself.
    if isinstance(place, Setting):
        chosen = None if policy is None else load_policy(policy)
        async with opened_group(place, chosen, seed) as stand:
            yield stand
    else:
        assert isinstance(place, Baseline)
        with opened_baseline(place, seed) as stand:
            yield stand


# -- this process -------------------------------------------------------------------------


class _Child:
    """A `Measurable` in a child process."""

    costs: Costs

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    async def ask(self, *question: Any) -> Any:
        """Return the child's answer.

        Raises:
            RLightningError: the answer is an error, or the child has ended.
        """
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None
        assert answers is not None
        try:
            requests.write(_framed(question))
            answer = await _received(answers)
        except (EOFError, ConnectionError):
            end = ending(await self._process.wait())
            raise RLightningError(f"the process that stepped the envs {end}") from None
        if isinstance(answer, RLightningError):
            raise answer
        return answer

    async def measure(self, rule: Rule, limits: Limits, trace: Path | None = None) -> Round:
        """Measure once, after a few steps that warm the caches."""
        return await self.ask(rule, limits, trace)

    async def close(self) -> None:
        """End the process; its envs are closed if they don't take too long."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            async with asyncio.timeout(_CLOSE_SECONDS):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()


@contextlib.asynccontextmanager
async def _opened_in_child(place: Place, policy: str | None, seed: int) -> AsyncGenerator[_Child]:
    words = (sys.executable, "-c", _PROGRAM, *sys.path)
    # In a session of its own, because Ctrl-C is not for it.
    process = await asyncio.create_subprocess_exec(
        *words, stdin=PIPE, stdout=PIPE, start_new_session=True
    )
    child = _Child(process)
    try:
        child.costs = await child.ask(place, policy, seed)
        yield child
    finally:
        await child.close()


# -- the child ----------------------------------------------------------------------------


def main() -> None:
    """Answer the questions that arrive on stdin, on stdout; the program of a child."""
    die_with_parent()
    warnings.showwarning = show_warning
    answers = stdout_set_aside()
    requests = os.fdopen(os.dup(0), "rb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # What envs read.
    rlightning_aio.run(_serve(requests, answers))


async def _serve(requests: BinaryIO, answers: TextIO) -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), requests
    )
    place, policy, seed = await _received(reader)
    async with contextlib.AsyncExitStack() as stack:
        opening = stack.enter_async_context(_opened_here(place, policy, seed))
        stand = await _tried(opening)
        _send(answers, stand if isinstance(stand, RLightningError) else stand.costs)
        with contextlib.suppress(EOFError):
            while not isinstance(stand, RLightningError):
                rule, limits, trace = await _received(reader)
                _send(answers, await _tried(stand.measure(rule, limits, trace)))


async def _tried(call: Awaitable[Any]) -> Any:
    """Return the value or the error of a call, as an error of this package that has only text."""
    try:
        return await call
    except ConfigError as error:
        return ConfigError(str(error))
    except RLightningError as error:
        return RLightningError(in_words(error))
    except Exception as error:  # noqa: BLE001  # It is the simulator's code.
        return RLightningError(f"{type(error).__name__}: {error}")


# -- both ---------------------------------------------------------------------------------


def _framed(value: Any) -> bytes:
    data = pickle.dumps(value)
    return len(data).to_bytes(_SIZE) + data


def _send(stream: TextIO, value: Any) -> None:
    stream.buffer.write(_framed(value))
    stream.flush()


async def _received(reader: asyncio.StreamReader) -> Any:
    size = int.from_bytes(await reader.readexactly(_SIZE))
    return pickle.loads(await reader.readexactly(size))
