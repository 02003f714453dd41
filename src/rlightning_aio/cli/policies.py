"""What decides on actions in commands: chance, or a policy of the user.

Here are the parts of every command's loop over a group: responses to results, and counts of steps.
"""

from __future__ import annotations

import importlib
import inspect
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

import numpy as np

from rlightning_aio._core.group.api.aio import ServerHandle
from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.data import parts_of
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.policies.answers import answers_of, check_policies, parts_by_policy, policies_of
from rlightning_aio.policies.predicting import PredictPolicy
from rlightning_aio.policies.random_actions import RandomPolicy

if TYPE_CHECKING:
    from types import TracebackType

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.cli.terminal import Progress

Policy: TypeAlias = Callable[[BatchedData], Any]

_PACKAGE: Final = str(Path(__file__).parents[1])


class PolicyRaised(RLightningError):
    """The user's policy raised an exception; the message has the traceback of its own code."""


def servers_announced(group: EnvGroup, progress: Progress) -> bool:
    """Say where the env_servers of a group listen; return True if it has any."""
    found = False
    hosts = [(host["entry"], env_id) for host in group.get_workers() for env_id in host["env_ids"]]
    ids = [entry + env_id.removeprefix(entry).partition("/")[0] for entry, env_id in hosts]
    for server_id in dict.fromkeys(ids):
        if isinstance(server := group[server_id], ServerHandle):
            found = True
            progress.say(f"{server_id} listens at {server.address}")
    return found


def load_policy(name: str) -> Policy | dict[str, Policy | None] | None:
    """Return the policy that ``module:name`` names. The working directory is on the path.

    Raises:
        ConfigError: it can't be imported, or is no policy.
    """
    module_name, colon, path = name.partition(":")
    if not (module_name and colon and path):
        raise ConfigError(f"--policy {name!r}: should look like my_policies:greedy")
    try:
        found: Any = importlib.import_module(module_name)
    except Exception as error:
        words = traceback.format_exception_only(error)[-1].strip()
        raise ConfigError(f"--policy {name!r}: importing {module_name} raised {words}") from error
    for part in path.split("."):
        if not hasattr(found, part):
            raise ConfigError(f"--policy {name!r}: {module_name} has no {path!r}")
        found = getattr(found, part)
    if isinstance(found, Mapping):
        named = cast("Mapping[str, Any]", found)
        return {
            entry: None if policy is None else _called(f"{name}[{entry!r}]", policy)
            for entry, policy in named.items()
        }
    return None if found is None else _called(name, found)


def _called(name: str, policy: Any) -> Policy:
    """Return a policy as a function of a batch."""
    if isinstance(policy, type):
        kind = policy.__name__
        raise ConfigError(f"--policy {name!r}: is the class {kind}; name an instance of it")
    if callable(policy):
        return cast("Policy", policy)
    if hasattr(policy, "predict"):
        return PredictPolicy(policy)
    kind = type(policy).__name__
    raise ConfigError(f"--policy {name!r}: is a {kind}, neither a callable nor with a predict()")


class Responder:
    """Makes the responses to a batch, with one call of each policy.

    Args:
        group: an initialised group.
        policy: called with a batch, or such by entry; None draws random actions.
        seed: of the random actions.

    Raises:
        ConfigError: an entry has no policy.
    """

    def __init__(
        self, group: EnvGroup, policy: Policy | dict[str, Policy | None] | None, seed: int | None
    ) -> None:
        self._space_of = {meta.env_id: meta.action_space for meta in group.metas}.get
        self._group = group
        by_chance = RandomPolicy(self._space_of, seed)
        self._policies = {name: one or by_chance for name, one in policies_of(policy).items()}
        try:
            check_policies((one["entry"] for one in group.get_workers()), self._policies)
        except ValueError as error:
            raise ConfigError(f"--policy: {error}") from error

    async def __call__(self, batch: BatchedData) -> list[BatchedData]:
        """Return batches of responses that together answer `batch`.

        Raises:
            PolicyRaised: the policy raised an exception that is none of this package.
        """
        found: list[BatchedData] = []
        with self._group.span("policy"):
            for name, part in parts_by_policy(batch, self._policies):
                found += await self._answers(self._policies[name], part)
        return found

    async def _answers(self, policy: Policy, batch: BatchedData) -> list[BatchedData]:
        try:
            answer = policy(batch)
            if inspect.isawaitable(answer):
                answer = await answer
        except RLightningError:
            raise  # Random actions can't be drawn, a policy's server is missing, and the like.
        except Exception as error:
            raise PolicyRaised(_raised(error)) from error
        return answers_of(batch, answer, self._space_of(batch.env_ids()[0]))


def _raised(error: Exception) -> str:
    """Return the error for an exception of a policy, with the traceback from its own code on."""
    trace: TracebackType | None = error.__traceback__
    while trace is not None and trace.tb_frame.f_code.co_filename.startswith(_PACKAGE):
        trace = trace.tb_next
    words = traceback.format_exception_only(error)[-1].strip()
    return "".join([f"the policy raised {words}\n", *traceback.format_tb(trace)]).rstrip()


async def respond_to_all(group: EnvGroup, respond: Responder, batch: BatchedData) -> None:
    """Send a step to every env of `batch`."""
    for response in await respond(batch):
        group.step_async(response)


def steps_in(batch: BatchedData) -> int:
    """Return the number of results that are no resets, sub-environments counted."""
    return sum(int(np.count_nonzero(~part.is_reset)) for part in parts_of(batch))
