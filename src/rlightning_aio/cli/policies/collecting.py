"""Parts of every command's loop over a group: responses to results, and resets."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio._core.group.api.aio import ServerHandle
from rlightning_aio.cli.option_files import naming_option
from rlightning_aio.cli.policies.policies import Policy, Responder
from rlightning_aio.cli.policies.sb3_policies import SB3Policy
from rlightning_aio.policies.random_actions import RandomPolicy
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Sequence
    from pathlib import Path

    import gymnasium as gym

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.batch import BatchedData

__all__ = [
    "Roster",
    "playing",
    "respond_to_all",
    "responder",
    "traced",
]

_REFRESH_SECONDS: Final = 0.2


class Roster:
    """Metadata of each env of a group, and of each client that has joined.

    Args:
        group: an initialised group.
    """

    def __init__(self, group: EnvGroup) -> None:
        self._known = {meta.env_id: meta for meta in group.metas}
        handles = (group[env_id] for env_id in group.env_ids)
        self.servers = [handle for handle in handles if isinstance(handle, ServerHandle)]

    def __call__(self, env_id: str) -> EnvMeta:
        """Return the metadata for an id, with defaults for a client that has left again."""
        if env_id not in self._known:
            for server in self.servers:
                self._known.update((meta.env_id, meta) for meta in server.metas)
        return self._known.get(env_id) or EnvMeta(
            env_id=env_id, observation_space=None, action_space=None
        )


def responder(
    group: EnvGroup, roster: Roster, policy: Policy | None, seed: int | None
) -> Responder:
    """Return a responder with `policy` or random actions, called once for each kind of space."""
    actions = group.get_action_spaces()

    def space_of(env_id: str) -> gym.Space[Any] | None:
        return roster(env_id).action_space

    if policy is None:
        return Responder(RandomPolicy(space_of, seed), space_of, separate=_differ(actions))
    separate = _differ(actions) or _differ(group.get_observation_spaces())
    return Responder(policy, space_of, separate=separate)


def _differ(spaces: Sequence[gym.Space[Any] | None]) -> bool:
    return any(space != spaces[0] for space in spaces[1:])


async def respond_to_all(group: EnvGroup, respond: Responder, batch: BatchedData) -> None:
    """Send a step to every env of `batch`."""
    with group.span("policy"):
        responses = await respond(batch)
    for response in responses:
        group.step_async(response)


@contextlib.asynccontextmanager
async def traced(group: EnvGroup, path: Path | None) -> AsyncGenerator[None]:
    """Record a timeline of `group` into a file, if one is named.

    Raises:
        ConfigError: the file can't be written; the message names ``--trace``.
    """
    if path is None:
        yield
        return
    trace = group.trace(path)
    trace.start()
    try:
        yield
    finally:
        with naming_option("--trace", path):
            trace.stop()


@contextlib.asynccontextmanager
async def playing(
    group: EnvGroup,
    policy: Policy | None,
    seed: int | None,
    trace: Path | None,
    draw: Callable[[], None],
) -> AsyncGenerator[Callable[[BatchedData], Any]]:
    """Start a group whose episodes are to be evaluated, and close it at the end.

    Yields what `evaluate` takes as a policy. It calls `draw` from time to time.
    """
    async with group, traced(group, trace):
        if isinstance(policy, SB3Policy):
            policy.check(group.metas)
        respond = responder(group, Roster(group), policy, seed)
        next_at = 0.0

        async def answer(batch: BatchedData) -> list[BatchedData]:
            nonlocal next_at
            if time.monotonic() >= next_at:
                next_at = time.monotonic() + _REFRESH_SECONDS
                draw()
                # If results are always ready, nothing else would let Ctrl-C take effect.
                await asyncio.sleep(0)
            with group.span("policy"):
                return await respond(batch)

        yield answer
