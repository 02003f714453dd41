"""What every loop of the command line does with a group: answer its results, reset its envs."""

from __future__ import annotations

import contextlib
import warnings
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.cli.policies import Policy, RandomPolicy, Responder

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    import gymnasium as gym

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.group.aio import EnvGroup

__all__ = ["resetting", "respond_to_all", "responder"]

_NO_LIMIT: Final = 2**62


def responder(group: EnvGroup, policy: Policy | None, seed: int | None) -> Responder:
    """Answers the group's results with `policy`, or at random; one call for each kind of space."""
    actions = group.get_action_spaces()
    if policy is None:
        chosen = RandomPolicy(group.env_ids, actions, seed)
        return Responder(chosen, separate=_differ(actions))
    return Responder(policy, separate=_differ(actions) or _differ(group.get_observation_spaces()))


def _differ(spaces: Sequence[gym.Space[Any] | None]) -> bool:
    return any(space != spaces[0] for space in spaces[1:])


def respond_to_all(group: EnvGroup, respond: Responder, batch: BatchedData) -> None:
    """Have every env of `batch` go on."""
    for response in respond(batch):
        group.step_async(response)


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
