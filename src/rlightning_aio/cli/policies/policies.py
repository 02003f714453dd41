"""Sources of actions: random sampling, a callable that the user names, or a policy server.

A policy is a callable or coroutine function that takes a `BatchedData` of results and returns
actions (``[n, *action]``, in the order of the results), or a batch of responses made with
`BatchedData.respond`. Sampling works on whole columns, so its cost hardly grows with the batch.
"""

from __future__ import annotations

import importlib
import inspect
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.batch import BatchedData
from rlightning_aio.cli.policies.masks import allowed_action, can_be_masked, has_masks
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.protocol.columns import index, stacked

if TYPE_CHECKING:
    import contextlib
    from types import TracebackType

    from numpy.typing import NDArray

__all__ = [
    "Policy",
    "PolicyRaised",
    "RandomPolicy",
    "Responder",
    "load_policy",
    "sampler_of",
    "served_policy",
]

Policy: TypeAlias = Callable[[BatchedData], Any]
Sampler: TypeAlias = Callable[[int], Any]

_UNBOUNDED_SCALE = 0.1
"""Standard deviation for unbounded spaces. Their actions are usually in units of a joint's range,
and larger ones would throw a robot about."""
_PACKAGE: Final = str(Path(__file__).parents[2])
_CLIENTS: Final = {"openpi": "OpenPiPolicy", "vla-eval": "VlaEvalPolicy"}
"""Clients of policy servers, by the scheme of the address."""


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

    The client is closed by `stack`.

    Raises:
        ConfigError: it is no such address, or a package is missing.
    """
    scheme, _, place = name.partition("://")
    if scheme not in _CLIENTS:
        raise ConfigError(f"--policy {name}: should begin with openpi:// or vla-eval://")
    try:
        clients: Any = importlib.import_module("rlightning_aio.policy_servers")
        client = getattr(clients, _CLIENTS[scheme])(f"ws://{place}")
    except (ImportError, ConfigError) as error:
        raise ConfigError(f"--policy {name}: {error}") from error
    return stack.enter_context(client)


class Responder:
    """Makes the responses to a batch, with one call of the policy if results can be stacked.

    Args:
        policy: as the module's docstring describes.
        separate: call it once for each config entry, because their spaces differ.
    """

    def __init__(self, policy: Policy, *, separate: bool) -> None:
        self._policy = policy
        self._separate = separate

    async def __call__(self, batch: BatchedData) -> list[BatchedData]:
        """Return batches of responses that together answer `batch`.

        Raises:
            PolicyRaised: the policy raised an exception that is none of this package.
        """
        parts = list(batch.by_entry().values()) if self._separate else [batch]
        return [await self._respond(part) for part in parts]

    async def _respond(self, batch: BatchedData) -> BatchedData:
        try:
            answer = self._policy(batch)
            if inspect.isawaitable(answer):
                answer = await answer
        except RLightningError:
            raise  # Random actions can't be drawn, a policy server is missing, and the like.
        except Exception as error:
            raise PolicyRaised(_raised(error)) from error
        return answer if isinstance(answer, BatchedData) else batch.respond(action=answer)


def _raised(error: Exception) -> str:
    """Return the error for an exception of a policy, with the traceback from its own code on."""
    trace: TracebackType | None = error.__traceback__
    while trace is not None and trace.tb_frame.f_code.co_filename.startswith(_PACKAGE):
        trace = trace.tb_next
    words = traceback.format_exception_only(error)[-1].strip()
    return "".join([f"the policy raised {words}\n", *traceback.format_tb(trace)]).rstrip()


class RandomPolicy:
    """Samples actions from the envs' spaces.

    Bounded numbers are uniform, unbounded ones normal with a small spread. Envs whose first
    result has an ``action_mask`` (see `masks`) get discrete actions that it allows, or any if it
    allows none. One generator serves all envs in the order of their results.

    Args:
        space_of: a function that returns the action space for an env id; called at the env's
            first result.
        seed: the seed of the generator; None draws one.
    """

    def __init__(self, space_of: Callable[[str], gym.Space[Any] | None], seed: int | None) -> None:
        self._space_of = space_of
        self._rng = np.random.default_rng(seed)
        self._kinds: list[tuple[gym.Space[Any], Sampler]] = []
        self._samplers: dict[str, Sampler] = {}
        self._masked: dict[str, gym.Space[Any]] = {}
        """Action spaces of envs whose results have masks."""

    def __call__(self, batch: BatchedData) -> Any:
        """Return actions for a batch: columns if its envs share one action space, else a list."""
        env_ids = batch.env_ids()
        samplers = [
            self._samplers.get(id_) or self._meet(id_, batch, row)
            for row, id_ in enumerate(env_ids)
        ]
        first = samplers[0]
        if samplers.count(first) < len(samplers):
            actions = [index(sampler(1), 0) for sampler in samplers]
        else:
            actions = first(len(samplers))
        return self._allowed(env_ids, actions, batch) if self._masked else actions

    def _allowed(self, env_ids: list[str], actions: Any, batch: BatchedData) -> Any:
        """Return `actions` in the same form, with allowed ones in place of forbidden ones."""
        listed = isinstance(actions, list)
        chosen = [actions[k] if listed else index(actions, k) for k in range(len(env_ids))]
        for row, (env_id, result) in enumerate(zip(env_ids, batch.values(), strict=True)):
            if (space := self._masked.get(env_id)) is not None:
                chosen[row] = allowed_action(space, chosen[row], result, self._rng)
        return chosen if listed else stacked(chosen)

    def _meet(self, env_id: str, batch: BatchedData, row: int) -> Sampler:
        space = self._space_of(env_id)
        if space is None:
            raise ConfigError(f"env {env_id!r} reports no action space; give a --policy")
        sampler = next((sampler for known, sampler in self._kinds if known == space), None)
        if sampler is None:
            sampler = sampler_of(space, self._rng)
            self._kinds.append((space, sampler))
        self._samplers[env_id] = sampler
        # Other infos are not read: they may hold objects that can't be unpickled here.
        if can_be_masked(space) and has_masks(batch.values()[row]):
            self._masked[env_id] = space
        return sampler


def sampler_of(space: gym.Space[Any], rng: np.random.Generator) -> Sampler:
    """Return a function that makes n actions of `space`, as columns."""
    columns = _columns(space, rng)
    if columns is not None:
        return columns
    space.seed(int(rng.integers(2**31)))
    return lambda n: [space.sample() for _ in range(n)]


def _columns(space: gym.Space[Any], rng: np.random.Generator) -> Sampler | None:
    """Return a function that makes columns, or None for spaces whose values can't be stacked."""
    # Gymnasium's spaces are generic over a dtype that is usually left out.
    spaces: Any = gym.spaces
    known = cast("Any", space)
    if isinstance(space, spaces.Box):
        return _box(known, rng)
    if isinstance(space, spaces.Discrete):
        return _integers(known.start, known.start + known.n - 1, known, rng)
    if isinstance(space, spaces.MultiDiscrete):
        return _integers(known.start, known.start + known.nvec - 1, known, rng)
    if isinstance(space, spaces.MultiBinary):
        return _integers(0, 1, known, rng)
    if isinstance(space, spaces.Dict):
        return _mapping({key: _columns(inner, rng) for key, inner in known.spaces.items()})
    if isinstance(space, spaces.Tuple):
        parts = _mapping(dict(enumerate(_columns(inner, rng) for inner in known.spaces)))
        return parts and (lambda n: tuple(parts(n).values()))
    return None


def _mapping(samplers: dict[Any, Sampler | None]) -> Sampler | None:
    found = {key: sampler for key, sampler in samplers.items() if sampler is not None}
    if len(found) < len(samplers):
        return None
    return lambda n: {key: sampler(n) for key, sampler in found.items()}


def _integers(low: Any, high: Any, space: gym.Space[Any], rng: np.random.Generator) -> Sampler:
    """Return a function that draws integers from `low` to `high`, both included."""
    shape, dtype = space.shape or (), space.dtype
    return lambda n: rng.integers(low, high, (n, *shape), dtype=dtype, endpoint=True)


def _box(space: Any, rng: np.random.Generator) -> Sampler:
    if np.issubdtype(space.dtype, np.integer):
        return _integers(space.low, space.high, space, rng)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    shape, dtype = space.shape, space.dtype
    with np.errstate(over="ignore"):
        span = high - low
    if np.isfinite(span).all():
        return lambda n: (low + span * rng.random((n, *shape))).astype(dtype)
    return lambda n: _partly_bounded(low, high, span, rng, (n, *shape)).astype(dtype)


def _partly_bounded(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    span: NDArray[np.float64],
    rng: np.random.Generator,
    shape: tuple[int, ...],
) -> NDArray[np.float64]:
    """Draw uniformly between two bounds, and normally around 0 or away from a single bound."""
    both = np.isfinite(span)
    uniform = np.where(both, low, 0.0) + np.where(both, span, 0.0) * rng.random(shape)
    normal = rng.normal(0.0, _UNBOUNDED_SCALE, shape)
    normal = np.where(np.isfinite(low), low + abs(normal), normal)
    normal = np.where(~np.isfinite(low) & np.isfinite(high), high - abs(normal), normal)
    return np.where(both, uniform, normal)
