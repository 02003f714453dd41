"""`Awaiting`: a worker's awaitable envs, all at once, on an event loop of the worker's own.

The worker's channel wakes the loop. The worker says whose code runs, and that none does while all
envs wait: if it dies, the trainer knows which env is at fault. While envs have time limits, it also
says every now and then that its loop is alive: the trainer kills a worker whose loop an env blocks
for longer than the limit. Requests that only wait too long are cancelled here (see `AwaitedEnvs`).
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, cast

from rlightning_aio._core.hosts.awaiting.awaited_envs import AwaitedEnvs
from rlightning_aio._core.hosts.awaiting.event_loop import run_loop
from rlightning_aio._core.hosts.limits import limits_of

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, MutableSequence

    from rlightning_aio._core.hosts.messages import Completion, StartOrder
    from rlightning_aio._core.hosts.running.awaited_runner import AwaitedRunner
    from rlightning_aio._core.hosts.running.runner import EnvRunner
    from rlightning_aio.protocol.error_text import ErrorText


class Awaiting:
    """See the module.

    Args:
        order, first_slot: of the worker.
        runners: of its envs; the list changes when one takes the place of another.
        made: how often each was made, counted on here.
        report: takes the entries of requests whose results are all in their rows.
        post: sends a completion.
        enter: says that an env's code runs now, by an entry; 0: none does.

    Attributes:
        envs: execute requests.
    """

    def __init__(
        self,
        order: StartOrder,
        first_slot: int,
        runners: list[EnvRunner],
        made: MutableSequence[int] | memoryview[int],
        report: Callable[[int], None],
        post: Callable[[Completion], None],
        enter: Callable[[int], None],
    ) -> None:
        self._enter = enter
        self.envs = AwaitedEnvs(
            0,
            first_slot,
            order,
            made,
            post=post,
            done=report,
            enter=enter,
        )
        self._runners = cast("list[AwaitedRunner]", runners)
        self._beat_seconds = min(limits_of(order.config).values(), default=0.0) / 4

    def serve(
        self, channel: socket.socket, take_requests: Callable[[], bool]
    ) -> list[tuple[int, ErrorText]]:
        """Execute requests until there are no more, and close the envs.

        Args:
            channel: readable when there are requests.
            take_requests: submits them; False if there will be no more. If it raises, the trainer
                is gone: the envs come to a safe stop before they are closed.

        Returns what closing has raised, with the env's index.
        """
        return run_loop(self._serve(channel, take_requests))

    async def _serve(
        self, channel: socket.socket, take_requests: Callable[[], bool]
    ) -> list[tuple[int, ErrorText]]:
        loop = asyncio.get_running_loop()
        self.envs.adopt(self._runners)
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

        def beat() -> None:
            self._enter(0)
            loop.call_later(self._beat_seconds, beat)

        if self._beat_seconds:
            beat()
        loop.add_reader(channel, look)
        # uvloop has made it non-blocking; a reply that the socket can't hold waits for the trainer.
        channel.setblocking(True)
        look()
        try:
            await ended
        except BaseException:
            self.envs.disconnect()
            await self.envs.close()
            raise
        finally:
            loop.remove_reader(channel)
        return await self.envs.close()
