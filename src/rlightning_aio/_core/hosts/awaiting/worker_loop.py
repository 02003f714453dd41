"""Serves the awaitable envs of a worker, all at once, on an event loop of the worker's own.

The worker's channel wakes the loop. The worker says whose code runs, and that none does while all
envs wait: if it dies, the trainer knows which env is at fault. While envs have time limits, it also
says every now and then that its loop is alive: the trainer kills a worker whose loop an env blocks
for longer than the limit. Requests that only wait too long are cancelled here (see `AwaitedEnvs`).
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rlightning_aio._core.hosts.awaiting.event_loop import run_loop

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from rlightning_aio._core.hosts.awaiting.awaited_envs import AwaitedEnvs
    from rlightning_aio._core.hosts.running.awaited_runner import AwaitedRunner
    from rlightning_aio.protocol.error_text import ErrorText


def serve(
    envs: AwaitedEnvs,
    runners: list[AwaitedRunner],
    channel: socket.socket,
    take_requests: Callable[[], bool],
) -> list[tuple[int, ErrorText]]:
    """Execute requests until there are no more, and close the envs.

    Args:
        envs: execute requests.
        runners: of the envs; the list changes when one takes the place of another.
        channel: readable when there are requests.
        take_requests: submits them; False if there will be no more. If it raises, the trainer
            is gone: the envs come to a safe stop before they are closed.

    Returns what closing has raised, with the env's index.
    """
    return run_loop(_serve(envs, runners, channel, take_requests))


async def _serve(
    envs: AwaitedEnvs,
    runners: list[AwaitedRunner],
    channel: socket.socket,
    take_requests: Callable[[], bool],
) -> list[tuple[int, ErrorText]]:
    loop = asyncio.get_running_loop()
    envs.adopt(runners)
    ended: asyncio.Future[None] = loop.create_future()

    def look() -> None:
        try:
            if take_requests() or ended.done():
                return
        except BaseException as error:
            loop.remove_reader(channel)
            ended.set_exception(error)
        else:
            ended.set_result(None)

    loop.add_reader(channel, look)
    # uvloop has made it non-blocking; a reply that the socket can't hold waits for the trainer.
    channel.setblocking(True)
    look()
    try:
        await ended
    except BaseException:
        envs.disconnect()
        await envs.close()
        raise
    finally:
        loop.remove_reader(channel)
    return await envs.close()
