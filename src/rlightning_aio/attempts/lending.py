"""`Lending`: the envs of a group, for attempts that a trainer's own loop plays."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, TypeVar

from rlightning_aio._core.group.api.aio import build_env_group
from rlightning_aio.attempts.episode import AttemptInPlay
from rlightning_aio.attempts.players import Players
from rlightning_aio.attempts.rules import Rules, tries_again
from rlightning_aio.attempts.spec import EpisodeSpec
from rlightning_aio.errors import EnvFault, RLightningError
from rlightning_aio.loop_thread import LoopThread
from rlightning_aio.outcomes import Outcome

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.config import EnvConfig

__all__ = ["Lending", "LendingThread"]

T = TypeVar("T")


class Lending:
    """An attempt gets the env that was idle for longest, until it is returned.

    Args:
        group: initialised. Each of its envs can play each attempt.
        retries: how often a reset that has failed is tried again, by the rule of `Rules`.
    """

    def __init__(self, group: EnvGroup, retries: int) -> None:
        self._group, self._rules, self._players = group, Rules(retries=retries), Players(group)
        self._idle = asyncio.Queue[str]()
        self._lent = set[AttemptInPlay]()
        for env_id in group.env_ids:
            self._idle.put_nowait(env_id)

    @property
    def idle(self) -> int:
        """Number of envs that are idle."""
        return self._idle.qsize()

    async def begin(
        self,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
        *,
        waits: bool = True,
    ) -> AttemptInPlay | Outcome:
        """Wait for an idle env and reset it; return the outcome of the last try if all failed.

        Args:
            seed: of the reset.
            options: of the reset.
            waits: False for a caller who returns no env meanwhile: it isn't tried again if none is
                idle, because the env that has failed is gone.

        Raises:
            RLightningError: no env of the group is left.
        """
        failures: list[Outcome] = []
        spec = EpisodeSpec("", seed, None)  # Before an env is taken, as a seed may be refused.
        while True:
            env_id = await self._idle.get()
            if not env_id:
                self._idle.put_nowait("")
                raise RLightningError("no env of this group is left that could play")
            playing = self._group.episode(env_id, seed, options)
            episode = AttemptInPlay(playing, spec, 0)
            self._lent.add(episode)
            try:
                with contextlib.suppress(EnvFault):
                    await episode.begin()
            except BaseException:
                await self.end(episode)
                raise
            if episode.fault is None:
                return episode
            await self.end(episode)
            is_vain = not (waits or self.idle)
            if is_vain or not tries_again(self._rules, episode.fault, failures):
                return episode.fault
            failures.append(episode.fault)

    async def end(self, episode: AttemptInPlay) -> None:
        """Take the env back, unless that was done, or its worker is gone for good."""
        if episode in self._lent:
            self._lent.remove(episode)
            episode.end("is over")
            # However often this is cancelled, the env comes back.
            await asyncio.shield(asyncio.ensure_future(self._take_back(episode)))

    async def _take_back(self, episode: AttemptInPlay) -> None:
        await episode.leave()
        if episode.env_id in self._players.refresh():
            self._idle.put_nowait(episode.env_id)
        elif not self._lent and not self.idle:
            self._idle.put_nowait("")  # Whoever waits is to know that none will come.

    async def end_all(self) -> None:
        """Take all envs back."""
        await asyncio.gather(*map(self.end, list(self._lent)))


class LendingThread:
    """A group on an event loop of its own, and its `Lending`, for trainers without one.

    Args:
        name: of the thread.
        retries: see `Lending`.
    """

    def __init__(self, name: str, retries: int) -> None:
        self._thread, self._retries = LoopThread(name), retries
        self._begun = deque[tuple[Any, Future[AttemptInPlay | Outcome]]]()

    def open(self, config: EnvConfig) -> None:
        """Start the envs."""
        self._group, self._lending = self.run(self._open(config))

    def close(self) -> None:
        """Close the envs, whatever they do."""
        self.run(self._group.close())
        self._thread.close()

    def run(self, answer: Coroutine[Any, Any, T]) -> T:
        """Wait for something on the group's loop."""
        return self._thread.submit(answer).result()

    def metrics(self) -> dict[str, float]:
        """See `EnvGroup.metrics`."""

        async def found() -> dict[str, float]:
            return self._group.metrics()

        return self.run(found())

    def begin_all(self, options: list[dict[str, Any]]) -> None:
        """Take all envs back, and begin to reset as many as there will be calls of `begin`."""
        while self._begun:  # Of a batch that was interrupted.
            self._begun.popleft()[1].result()
        self.run(self._lending.end_all())
        self._begun.extend((one, self._thread.submit(self._begin(one))) for one in options)

    def begin(self, options: dict[str, Any]) -> AttemptInPlay | Outcome:
        """Reset an idle env, or wait for that, if it has begun; see `Lending.begin`.

        Raises:
            RLightningError: no env is idle.
        """
        if self._begun:
            begun, episode = self._begun[0]
            if begun.keys() == options.keys() and all(begun[k] is options[k] for k in begun):
                self._begun.popleft()
                return episode.result()
        return self.run(self._begin(options))

    def end(self, episode: AttemptInPlay) -> None:
        """See `Lending.end`."""
        self.run(self._lending.end(episode))

    async def _open(self, config: EnvConfig) -> tuple[EnvGroup, Lending]:
        group = build_env_group(config)
        await group.init()
        return group, Lending(group, self._retries)

    async def _begin(self, options: dict[str, Any]) -> AttemptInPlay | Outcome:
        if not self._lending.idle:
            raise RLightningError(f"none of {len(self._group)} envs is idle; raise num_envs")
        return await self._lending.begin(options=options, waits=False)
