"""What every loop of the command line does with a group: answer its results, reset its envs."""

from __future__ import annotations

import contextlib
import warnings
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.cli.policies import Policy, RandomPolicy, Responder
from rlightning_aio.errors import ConfigError
from rlightning_aio.group.aio import ServerHandle
from rlightning_aio.group.trace import check_writable
from rlightning_aio.types import EnvMeta

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    import gymnasium as gym

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.group.aio import EnvGroup

__all__ = ["Roster", "check_trace", "resetting", "respond_to_all", "responder", "traced"]

_NO_LIMIT: Final = 2**62


class Roster:
    """What each env of a group is like; of clients, what they have said on joining.

    Args:
        group: initialised.
        metas: what its `init` returned.
    """

    def __init__(self, group: EnvGroup, metas: Sequence[EnvMeta]) -> None:
        self._known = {meta.env_id: meta for meta in metas}
        handles = (group[env_id] for env_id in group.env_ids)
        self.servers = [handle for handle in handles if isinstance(handle, ServerHandle)]

    def __call__(self, env_id: str) -> EnvMeta:
        """The env of that id. One that has joined and left unseen is taken for a plain one."""
        if env_id not in self._known:
            for server in self.servers:
                self._known.update((meta.env_id, meta) for meta in server.metas)
        return self._known.get(env_id) or EnvMeta(
            env_id=env_id, observation_space=None, action_space=None
        )


def responder(
    group: EnvGroup, roster: Roster, policy: Policy | None, seed: int | None
) -> Responder:
    """Answers the group's results with `policy`, or at random; one call for each kind of space."""
    actions = group.get_action_spaces()
    if policy is None:
        chosen = RandomPolicy(lambda env_id: roster(env_id).action_space, seed)
        return Responder(chosen, separate=_differ(actions))
    return Responder(policy, separate=_differ(actions) or _differ(group.get_observation_spaces()))


def _differ(spaces: Sequence[gym.Space[Any] | None]) -> bool:
    return any(space != spaces[0] for space in spaces[1:])


async def respond_to_all(group: EnvGroup, respond: Responder, batch: BatchedData) -> None:
    """Have every env of `batch` go on."""
    with group.span("policy"):
        responses = await respond(batch)
    for response in responses:
        group.step_async(response)


def check_trace(path: Path | None) -> None:
    """Find out, before anything is started, whether a timeline can be written.

    Raises:
        ConfigError: it can't, and why.
    """
    if path is not None:
        try:
            check_writable(path)
        except OSError as error:
            raise ConfigError(f"--trace: {error}") from error


def traced(group: EnvGroup, path: Path | None) -> AbstractAsyncContextManager[object]:
    """Records a timeline of `group` into a file, if one is named."""
    return contextlib.nullcontext() if path is None else group.trace(path)


@contextlib.contextmanager
def resetting(group: EnvGroup, configs: Sequence[EnvConfig]) -> Generator[None]:
    """Have finished episodes reset, at the configured step limits or at the simulator's own.

    `auto_reset` wants a limit of every entry. Where one has none, episodes of all entries
    end where their simulators end them, which know the limits that are configured.
    """
    limit = None if all(config.max_episode_steps for config in configs) else _NO_LIMIT
    with contextlib.ExitStack() as stack:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="auto_reset.*overrides")
            stack.enter_context(group.auto_reset(limit))
        yield
