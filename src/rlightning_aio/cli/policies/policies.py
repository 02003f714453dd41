"""Sources of actions: a callable that the user names, or a policy server.

A policy is a callable or coroutine function that takes a `BatchedData` of results; what it returns,
`answers_of` says.
"""

from __future__ import annotations

import importlib
import inspect
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.policies.answers import answers_of
from rlightning_aio.registry import plugins

if TYPE_CHECKING:
    import contextlib
    from types import TracebackType

    import gymnasium as gym

__all__ = [
    "Policy",
    "PolicyRaised",
    "Responder",
    "load_policy",
    "served_policy",
]

Policy: TypeAlias = Callable[[BatchedData], Any]

_PACKAGE: Final = str(Path(__file__).parents[2])


class PolicyRaised(RLightningError):
    """The user's policy raised an exception; the message has the traceback of its own code."""


def load_policy(name: str) -> Policy:
    """Return the callable that ``module:callable`` names; the working directory is on the path.

    Raises:
        ConfigError: it can't be imported, or is not callable.
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
    if not callable(found):
        raise ConfigError(f"--policy {name!r}: is a {type(found).__name__}, not a callable")
    return found


def served_policy(name: str, stack: contextlib.ExitStack) -> Policy:
    """Return a client of the policy server at an address, as ``openpi://localhost:8000``.

    The scheme is the name of an entry point. The client is closed by `stack`.

    Raises:
        ConfigError: it is no such address, or a package is missing.
    """
    scheme, _, place = name.partition("://")
    found = plugins("policies").select(name=scheme)
    if not found:
        known = " or ".join(f"{kind}://" for kind in sorted(plugins("policies").names))
        raise ConfigError(f"--policy {name}: should begin with {known}")
    try:
        client = found[scheme].load()(f"ws://{place}")
    except (ImportError, ConfigError) as error:
        raise ConfigError(f"--policy {name}: {error}") from error
    return stack.enter_context(client)


class Responder:
    """Makes the responses to a batch, with one call of the policy if results can be stacked.

    Args:
        policy: as the module's docstring describes.
        space_of: returns the action space for an env id.
        separate: call it once for each config entry, because their spaces differ.
    """

    def __init__(
        self,
        policy: Policy,
        space_of: Callable[[str], gym.Space[Any] | None],
        *,
        separate: bool,
    ) -> None:
        self._policy, self._space_of = policy, space_of
        self._separate = separate

    async def __call__(self, batch: BatchedData) -> list[BatchedData]:
        """Return batches of responses that together answer `batch`.

        Raises:
            PolicyRaised: the policy raised an exception that is none of this package.
        """
        parts = list(batch.by_entry().values()) if self._separate else [batch]
        found: list[BatchedData] = []
        for part in parts:
            found += await self._respond(part)
        return found

    async def _respond(self, batch: BatchedData) -> list[BatchedData]:
        try:
            answer = self._policy(batch)
            if inspect.isawaitable(answer):
                answer = await answer
        except RLightningError:
            raise  # Random actions can't be drawn, a policy server is missing, and the like.
        except Exception as error:
            raise PolicyRaised(_raised(error)) from error
        return answers_of(batch, answer, lambda: self._space_of(batch.env_ids()[0]))


def _raised(error: Exception) -> str:
    """Return the error for an exception of a policy, with the traceback from its own code on."""
    trace: TracebackType | None = error.__traceback__
    while trace is not None and trace.tb_frame.f_code.co_filename.startswith(_PACKAGE):
        trace = trace.tb_next
    words = traceback.format_exception_only(error)[-1].strip()
    return "".join([f"the policy raised {words}\n", *traceback.format_tb(trace)]).rstrip()
