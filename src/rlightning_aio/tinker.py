"""tinker-cookbook's `EnvGroupBuilder`, over a group of envs.

Rule: a rollout that fails raises, so that the cookbook's strategies (`RetryOnFailure`,
`MinViableGroup`) decide; the error has the `Outcome`. An env is taken when a rollout begins, and
not when it is made, so a retry, for which the cookbook makes a whole group, costs one env.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rlightning_aio.attempts.lending import Lending
from rlightning_aio.errors import EpisodeLost
from rlightning_aio.outcomes import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.attempts.episode import AttemptInPlay

__all__ = ["EnvGroups"]


class EnvGroups:
    """Makes builders, whose rollouts share the envs of a group and wait for one that is idle::

        groups = EnvGroups(group, encode, decode)
        builders = [groups.builder(seed=seed, size=8) for seed in range(100)]
        trajectories = await do_group_rollout(builders[0], policy, RetryOnFailure())

    Args:
        group: initialised; it belongs to the event loop on which the rollouts are played.
        encode: an observation as the model's input, and what ends the model's answer:
            ``(renderer.build_generation_prompt(messages), renderer.get_stop_sequences())``.
        decode: the model's tokens as an action, such as ``renderer.parse_response(tokens)[0]``.
        retries: how often a reset that has failed is tried again, on another env if one is idle.
    """

    def __init__(
        self,
        group: EnvGroup,
        encode: Callable[[Any], tuple[Any, Any]],
        decode: Callable[[list[int]], Any],
        *,
        retries: int = 0,
    ) -> None:
        self._lending, self._coding = Lending(group, retries), (encode, decode)

    def builder(
        self, seed: int | None = None, options: dict[str, Any] | None = None, size: int = 8
    ) -> Any:
        """Return an `EnvGroupBuilder`: `size` rollouts with the same seed and options.

        It lives in this process: the cookbook's executors of other processes can't have it.
        """
        interface: Any = import_module("tinker_cookbook.rl.types")
        kind = type("GroupBuilder", (_Builder, interface.EnvGroupBuilder), {})
        made = kind()
        made.envs = lambda: [_Env(self._lending, self._coding, seed, options) for _ in range(size)]
        return made


class _Builder:
    """The cookbook makes envs, plays them, and cleans up, in this order, whatever happens."""

    envs: Callable[[], list[_Env]]
    made: tuple[_Env, ...] = ()

    async def make_envs(self) -> list[_Env]:
        made = self.envs()
        self.made += (*made,)
        return made

    async def cleanup(self) -> None:
        made, self.made = self.made, ()
        for env in made:
            await env.end()


class _Env:
    """A rollout, as an `Env`."""

    def __init__(self, lending: Lending, coding: Any, seed: Any, options: Any) -> None:
        self._lending, self._seed, self._options = lending, seed, options
        self._encode, self._decode = coding
        self._episode: AttemptInPlay | None = None

    async def initial_observation(self) -> tuple[Any, Any]:
        found = await self._lending.begin(self._seed, self._options)
        if isinstance(found, Outcome):
            error = EpisodeLost(found.cause, env_id=found.env_id)
            error.outcome = found
            raise error
        self._episode = found
        return self._encode(found.first)

    async def step(self, action: list[int], *, extra: Any = None) -> Any:
        del extra
        if (episode := self._episode) is None:
            raise RuntimeError("a rollout begins with initial_observation()")
        try:
            result = await episode.step(self._decode(action))
        except BaseException:  # Cancelled by a time limit of the cookbook, too.
            await self.end()
            raise
        observation, stop = self._encode(result.observation)
        if episode.is_over:
            await self.end()
        make: Any = import_module("tinker_cookbook.rl.types").StepResult
        return make(
            reward=episode.rewards[-1],
            episode_done=episode.is_over,
            next_observation=observation,
            next_stop_condition=stop,
        )

    async def end(self) -> None:
        """Return the env."""
        if self._episode is not None:
            episode, self._episode = self._episode, None
            await self._lending.end(episode)
