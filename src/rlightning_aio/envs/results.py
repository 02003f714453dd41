"""What an env is stepped with, and what it returns, for all who run one.

Rule: a worker, an inline host, a client of an env_server and the contract step an env with
`step_of`, or its `bare_step`, give it what `input_of` makes, and read what it returned with
`one_result`. So a preprocess function, an env that answers in two halves, and one that answers
with a list mean the same everywhere.
"""

from __future__ import annotations

from inspect import iscoroutinefunction
from traceback import walk_tb
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.envs.fast_path import fast_path_of
from rlightning_aio.trees import as_numpy, stacked
from rlightning_aio.types import (
    EnvRet,
    MultiAgentEnvRet,
    PolicyResponse,
    default_env_preprocess_fn,
)

if TYPE_CHECKING:
    from collections.abc import Callable


def has_preprocess_fn(env: BaseEnv) -> bool:
    """Return True if actions of `env` pass through a function of the user."""
    return env._preprocess_fn is not default_env_preprocess_fn  # pyright: ignore[reportPrivateUsage]


def reads_extras(env: BaseEnv) -> bool:
    """Return True if `env` can read more of a response than its action."""
    built_in = type(env).__module__.startswith("rlightning_aio.envs.")
    return has_preprocess_fn(env) or not (built_in or fast_path_of(env).bare_step() is not None)


def input_of(env: BaseEnv) -> Callable[[Any, dict[str, Any]], Any]:
    """Return a function that makes the input of a step from an action and the policy's extras.

    For `bare_step`, if the env has one, the input is an action, preprocessed if there is a
    preprocess function. For `step_of` it is a `PolicyResponse`.
    """
    env_id = env.env_id
    if fast_path_of(env).bare_step() is None:
        return lambda action, extras: PolicyResponse(env_id, action, **extras)
    if not has_preprocess_fn(env):
        return lambda action, _extras: action
    preprocess = env._preprocess_fn  # pyright: ignore[reportPrivateUsage]
    return lambda action, extras: as_numpy(preprocess(PolicyResponse(env_id, action, **extras)))


def explained(error: BaseException) -> BaseException:
    """Return `error`, or one that says which values a reset and a step return, if an env has
    returned others.
    """
    if not isinstance(error, TypeError | ValueError) or " unpack" not in str(error):
        return error
    *_, (frame, _) = walk_tb(error.__traceback__)
    # In the env's own code it is another error.
    if not frame.f_globals.get("__name__", "").startswith(_UNPACKING):
        return error
    if "coroutine" in str(error):
        words = (
            "its step and reset are coroutine functions, as a gymnasium.Env has none: leave that "
            "base class out"
        )
    else:
        words = (
            "a step returns (observation, reward, terminated, truncated, info), and a reset "
            "(observation, info). If this env has Gym's old interface, put "
            "shimmy.GymV21CompatibilityV0(env=env) around it"
        )
    found = TypeError(f"{error}: {words}")
    found.__cause__ = error
    return found


_UNPACKING: Final = ("rlightning_aio.", "gymnasium.")
"""Modules that take the results of envs apart."""


def is_async_first(env: BaseEnv) -> bool:
    """Return True if `env` steps by `BaseEnv.step_async` and `BaseEnv.collect_async`."""
    kind = type(env)
    return (
        kind.step_async is not BaseEnv.step_async
        and kind.collect_async is not BaseEnv.collect_async
    )


def is_awaitable(env: BaseEnv) -> bool:
    """Return True if `reset` and `step` of `env` are coroutine functions.

    Raises:
        TypeError: only one of them is.
    """
    kinds = {iscoroutinefunction(env.reset), iscoroutinefunction(env.step)}
    if len(kinds) > 1:
        raise TypeError(
            f"reset and step of env {env.env_id!r} must both be `async def`, or neither of them"
        )
    return kinds.pop()


def step_of(env: BaseEnv) -> Callable[[PolicyResponse], Any]:
    """Return a function that steps `env` and returns its result."""
    if not is_async_first(env):
        return env.step

    def step(policy_resp: PolicyResponse) -> Any:
        env.step_async(policy_resp)
        return env.collect_async()

    return step


def one_result(env: BaseEnv, method: str, returned: Any) -> EnvRet | MultiAgentEnvRet:
    """Convert the value that `method` of `env` returned to one result.

    A list holds one result for each sub-environment, in order; their arrays are stacked
    (as NumPy arrays) and their infos become Gymnasium's vector form.

    Raises:
        TypeError: it is neither a result nor a list with one for each sub-environment.
    """
    if isinstance(returned, EnvRet | MultiAgentEnvRet):
        return returned
    if not isinstance(returned, list):
        raise TypeError(
            f"{method}() of env {env.env_id!r} must return an EnvRet or a MultiAgentEnvRet, not "
            f"{type(returned).__name__}"
        )
    results = cast("list[Any]", returned)
    if len(results) == env.num_envs == 1:
        return one_result(env, method, results[0])
    if len(results) != env.num_envs or not all(isinstance(one, EnvRet) for one in results):
        kinds = sorted({type(one).__name__ for one in results})
        raise TypeError(
            f"{method}() of env {env.env_id!r} returned a list of {len(results)} "
            f"({', '.join(kinds) or 'nothing'}); it must hold one EnvRet for each of its "
            f"{env.num_envs} sub-environments"
        )
    return _together(env, cast("list[EnvRet]", results))


def _together(env: BaseEnv, results: list[EnvRet]) -> EnvRet:
    # Not at the top: a worker seldom needs it.
    from rlightning_aio.batch.infos import vector_infos

    return EnvRet(
        env_id=env.env_id,
        observation=stacked([as_numpy(one.observation) for one in results]),
        last_reward=np.array([as_numpy(one.last_reward) for one in results], np.float64),
        last_terminated=np.array([as_numpy(one.last_terminated) for one in results], np.bool_),
        last_truncated=np.array([as_numpy(one.last_truncated) for one in results], np.bool_),
        info=vector_infos([one.info for one in results]),
    )
