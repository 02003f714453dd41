"""`AttemptEpisode`: what an agent plays; it notes what the attempt's record has."""

from __future__ import annotations

import contextlib
import math
import time
from typing import TYPE_CHECKING, Any

from rlightning_aio.batch.parts import summed_rewards
from rlightning_aio.errors import BadAction, EnvFault, EnvRaised, RLightningError
from rlightning_aio.outcomes import Outcome
from rlightning_aio.protocol.entries import RENEW
from rlightning_aio.trees import copied
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from rlightning_aio._core.group.api.aio import EnvEpisode
    from rlightning_aio.attempts.clock import Clock
    from rlightning_aio.attempts.spec import EpisodeSpec
    from rlightning_aio.types import EnvRet, MultiAgentEnvRet


class AttemptEpisode:
    """One attempt at one task, as its agent sees it.

    Attributes:
        spec: the task.
        index: of the attempt, from 0, among those at the task.
        rewards: of the steps so far, each summed over agents.
        columns: what `step` was given so far; see `Attempt`.
        seconds: spent in the env so far.
        fault: how the newest step or call has failed; None if it has not.
        is_finished: by `finish`; `graded` is the reward that it was given.
        first: the observation after the reset.
    """

    first: Any = None

    def __init__(self, episode: EnvEpisode, spec: EpisodeSpec, index: int, clock: Clock) -> None:
        self._episode, self._clock = episode, clock
        self._queues = episode.queues
        self._began: float = self._clock.now()
        self._queued: float = 0.0
        self._asked_at: float | None = None  # What is in flight, by the clock.
        self._over = ""  # Why it can't be stepped.
        self.spec, self.index = spec, index
        self.rewards: list[float] = []
        self.columns: dict[str, list[Any]] = {}
        self.seconds = 0.0
        self.fault: Outcome | None = None
        self.is_finished = False
        self.graded: float | None = None

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
        """The newest result has ended the episode, or `finish` has."""
        return self.is_finished or self._episode.is_over

    def finish(self, reward: float | None = None) -> None:
        """End the attempt here: as truncated, unless its env has ended it.

        An agent that returns without it before the end is ``agent_stopped`` and has no reward.

        Args:
            reward: of the attempt, as the agent has graded it; None: what it has earned.

        Raises:
            ValueError: `reward` is not a finite number.
            RLightningError: the attempt is over, or was finished before.
        """
        self._check_open()
        if self.is_finished:
            raise RLightningError(
                f"the agent has finished this attempt on env {self.env_id!r} before"
            )
        if reward is not None and not _is_finite(reward):
            raise ValueError(f"the reward of an attempt must be a finite number, not {reward!r}")
        self.is_finished = True
        self.graded = None if reward is None else float(reward)

    async def step(self, action: Any, **columns: Any) -> EnvRet | MultiAgentEnvRet:
        """Step the env, and wait for the result.

        Args:
            action: of the env's action space.
            columns: anything to be kept with the action (``tokens``, ``log_prob``, …): see
                `Attempt.columns`. The env gets it, too, as it does from a `PolicyResponse`. Lists,
                dicts and arrays are copied, as the agent may write into them later.

        Raises:
            EnvRaised: its reward is None or not a finite number; the attempt has failed.
            EpisodeLost: the env was replaced; the attempt has failed.
            EnvFault: the env has raised, or is gone; the attempt has failed.
            BadAction: the action doesn't fit; nothing was sent.
            RLightningError: the attempt is over, as its episode is: look at `is_over`.
        """
        self._check_open()
        if self.is_over:
            raise RLightningError(
                f"this attempt on env {self.env_id!r} has ended after {len(self.rewards)} steps; "
                "an agent should look at `episode.is_over` before each step"
            )
        kept = copied({"action": action, **columns})
        response = PolicyResponse(self.env_id, action, **columns)
        try:
            result = await self._timed(self._episode.step(response))
        except EnvFault:
            self._over = "has failed: its env has raised an error in a step, or is gone"
            raise
        reward = float(summed_rewards(result.last_reward).sum())
        if not math.isfinite(reward):
            raise self._without_reward(reward)
        steps = len(self.rewards)
        for name, value in kept.items():
            column = self.columns.setdefault(name, [])
            column += [None] * (steps - len(column))
            column.append(value)
        self.rewards.append(reward)
        return result

    async def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call a method of the env, such as a tool; see `EnvEpisode.call`."""
        self._check_open()
        return await self._timed(self._episode.call(name, *args, **kwargs))

    def _without_reward(self, reward: float) -> EnvRaised:
        what = "returned no reward" if math.isnan(reward) else f"returned the reward {reward}"
        fault = EnvRaised(
            f"env {self.env_id!r} {what} in step {len(self.rewards) + 1}: its step should return "
            "a finite number; None and NaN are none",
            env_id=self.env_id,
        )
        fault.outcome = self.fault = Outcome("env_raised", "env", what, self.env_id)
        self._over = "has failed: its env has returned no reward"
        return fault

    def _check_open(self) -> None:
        if self._over:
            raise RLightningError(f"this attempt on env {self.env_id!r} {self._over}")

    async def _timed(self, answer: Any) -> Any:
        began = time.monotonic()
        self._asked_at = self._clock.now()
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
            self._queued += self._in_queue()
            self._asked_at = None
        self.fault = None
        return found

    def _in_queue(self) -> float:
        """Seconds that the request in flight has waited until its env executed it."""
        if self._asked_at is None or not self._queues:
            return 0.0
        inside = self._episode.seconds_in_env or 0.0
        return max(self._clock.now() - self._asked_at - inside, 0.0)


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

    @property
    def has_ended(self) -> bool:
        """The env has ended the episode."""
        return self._episode.is_over

    @property
    def earned(self) -> float:
        """The reward: that of `finish`, or else the sum of `rewards`."""
        return sum(self.rewards) if self.graded is None else self.graded

    def ran(self) -> float:
        """Seconds that it could run: not in a queue, nor while the loop was blocked."""
        return self._clock.now() - self._began - self._queued - self._in_queue()

    def now(self) -> float:
        """Seconds since any moment, without those for which the loop was blocked."""
        return self._clock.now()

    def note_wait(self, seconds: float) -> None:
        """Don't count seconds for which others kept its agent waiting."""
        self._queued += seconds

    @property
    def in_step(self) -> float:
        """Seconds that the env has spent on a step in flight; 0 without one."""
        if self._asked_at is None:
            return 0.0
        if self._queues:
            return self._episode.seconds_in_env or 0.0
        return self._clock.now() - self._asked_at

    async def leave(self) -> None:
        """End what is in flight; the env is idle after that."""
        await self._episode.__aexit__()

    async def renew(self) -> None:
        """Have an idle env rebuilt for its next reset, as one that has raised may be unusable.

        Hardware stays, and so do the envs of clients.
        """
        with contextlib.suppress(NotImplementedError, RLightningError):
            await self._episode.call(RENEW)  # Refused after a loss: it is rebuilt already.

    def end(self, why: str) -> None:
        """Refuse further steps."""
        self._over = why
        for column in self.columns.values():
            column.extend([None] * (len(self.rewards) - len(column)))


def _is_finite(reward: Any) -> bool:
    try:
        return math.isfinite(reward)
    except TypeError:
        return False
