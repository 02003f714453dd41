"""`AttemptEpisode`: what an agent plays; it notes what the attempt's record has."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from rlightning_aio.batch.contents import summed_rewards
from rlightning_aio.errors import BadAction, EnvFault, RLightningError
from rlightning_aio.outcomes import Outcome
from rlightning_aio.trees import copied
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from rlightning_aio._core.group.api.aio import EnvEpisode
    from rlightning_aio.attempts.spec import EpisodeSpec
    from rlightning_aio.types import EnvRet, MultiAgentEnvRet

__all__ = ["AttemptEpisode", "AttemptInPlay"]


class AttemptEpisode:
    """One attempt at one task, as its agent sees it.

    Attributes:
        spec: the task.
        index: of the attempt, from 0, among those at the task.
        rewards: of the steps so far, each summed over agents.
        columns: what `step` was given so far; see `Attempt`.
        seconds: spent in the env so far.
        fault: how the newest step or call has failed; None if it has not.
        first: the observation after the reset.
    """

    first: Any = None

    def __init__(self, episode: EnvEpisode, spec: EpisodeSpec, index: int) -> None:
        self._episode = episode
        self._over = ""  # Why it can't be stepped.
        self.spec, self.index = spec, index
        self.rewards: list[float] = []
        self.columns: dict[str, list[Any]] = {}
        self.seconds = 0.0
        self.fault: Outcome | None = None

    @property
    def env_id(self) -> str:
        """Id of the env that plays it."""
        return self._episode.env.env_id

    @property
    def last(self) -> EnvRet | MultiAgentEnvRet:
        """The newest result; at first that of the reset."""
        return self._episode.last

    @property
    def is_over(self) -> bool:
        """The newest result has ended the episode."""
        return self._episode.is_over

    async def step(self, action: Any, **columns: Any) -> EnvRet | MultiAgentEnvRet:
        """Step the env, and wait for the result.

        Args:
            action: of the env's action space.
            columns: anything to be kept with the action (``tokens``, ``log_prob``, …): see
                `Attempt.columns`. The env gets it, too, as it does from a `PolicyResponse`.

        Raises:
            EpisodeLost: the env was replaced; the attempt has failed.
            EnvFault: the env has raised, or is gone.
            BadAction: the action doesn't fit; nothing was sent.
            RLightningError: the attempt is over.
        """
        self._check_open()
        result = await self._timed(
            self._episode.step(PolicyResponse(self.env_id, action, **columns))
        )
        steps = len(self.rewards)
        for name, value in {"action": action, **columns}.items():
            column = self.columns.setdefault(name, [])
            column += [None] * (steps - len(column))
            column.append(value)
        self.rewards.append(float(summed_rewards(result.last_reward).sum()))
        return result

    async def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call a method of the env, such as a tool; see `EnvEpisode.call`."""
        self._check_open()
        return await self._timed(self._episode.call(name, *args, **kwargs))

    def _check_open(self) -> None:
        if self._over:
            raise RLightningError(f"this attempt on env {self.env_id!r} {self._over}")

    async def _timed(self, answer: Any) -> Any:
        began = time.monotonic()
        try:
            found = await answer
        except EnvFault as fault:
            self.fault = fault.outcome
            raise
        except BadAction as error:
            self.fault = Outcome("agent_raised", "policy", str(error), self.env_id)
            raise
        finally:
            self.seconds += time.monotonic() - began
        self.fault = None
        return found


class AttemptInPlay(AttemptEpisode):
    """An attempt as what plays it sees it; its agent doesn't."""

    async def begin(self) -> None:
        """Reset the env; the agent comes after that.

        Raises:
            EnvFault: that has failed.
        """
        await self._timed(self._episode.__aenter__())
        self.fault = self._episode.lost  # Its worker may have died in the reset.
        self.first = copied(self.last.observation)  # Its env may change it, and its row will.

    async def leave(self) -> None:
        """End what is in flight; the env is idle after that."""
        await self._episode.__aexit__()

    def end(self, why: str) -> None:
        """Refuse further steps."""
        self._over = why
        for column in self.columns.values():
            column.extend([None] * (len(self.rewards) - len(column)))
