"""`envpool`: batches of EnvPool's C++ environments, synchronous or asynchronous.

Rule: a result is the unchanged output of EnvPool's `recv`; actions go to the
sub-environments of the last result.
Left out: EnvPool's tasks with several players, whose batches vary in size.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from gymnasium.vector.utils import batch_space

from rlightning_aio.envs.base import BaseEnv, PreprocessFn, result_of, sub_env_seeds
from rlightning_aio.envs.fast_path import (
    BareResult,
    BareStep,
    BareStepAsync,
    BareStepWait,
    FastPath,
)
from rlightning_aio.envs.results import has_preprocess_fn
from rlightning_aio.errors import ConfigError
from rlightning_aio.trees import as_numpy, index, is_dict, mapped
from rlightning_aio.types import EnvRet, PolicyResponse

if TYPE_CHECKING:
    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig

__all__ = ["EnvPoolEnv"]

# Optional and untyped, so imported by name.
envpool: Any = import_module("envpool")

# Largest int32: EnvPool's seeds are below it, and as a step limit it means no limit.
UNLIMITED = 2**31 - 1

Places: TypeAlias = "int | dict[str, Places]"
"""The position of a value among a pool's arrays, or the positions of its parts."""


class EnvPoolEnv(FastPath, BaseEnv):
    """A pool of ``num_envs`` C++ environments; ``env_kwargs`` go to `envpool.make`.

    With ``batch_size`` M below ``num_envs`` the pool is asynchronous: each result holds
    the M sub-environments that were ready first, while the others compute, and the env's
    spaces and ``num_envs`` are those of M. In both modes ``info["env_id"]`` (int32 ``[M]``)
    names the sub-environment of each row.

    The step after the end of a sub-environment's episode resets it, ignores its action and
    returns reward 0; the result before it holds the final observation.
    """

    autoreset = "next_step"
    fresh_results = True

    def __init__(
        self,
        config: EnvConfig,
        worker_index: int = 0,
        preprocess_fn: PreprocessFn | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(config, worker_index, preprocess_fn, **kwargs)
        self.num_envs = self._batch_size()
        self._asynchronous = self.num_envs < config.num_envs
        # EnvPool's default is one fixed seed, which would make all envs equal.
        self._unseeded = np.random.default_rng()
        self._open(self._drawn_seeds())
        limit = int(self.env.config["max_episode_steps"])
        self.max_episode_steps = limit if limit < UNLIMITED else None

    def _batch_size(self) -> int:
        count = self.config.num_envs
        batch_size = int(self.config.env_kwargs.get("batch_size") or count)
        if not 1 <= batch_size <= count:
            raise ConfigError(
                f"env {self.env_id!r}: env_kwargs.batch_size is {batch_size}, but must be "
                f"between 1 and num_envs, which is {count}"
            )
        return batch_size

    def _drawn_seeds(self) -> list[int]:
        return self._unseeded.integers(UNLIMITED, size=self.config.num_envs).tolist()

    def _open(self, seeds: list[int]) -> None:
        """Make the pool, whose seeds can't change later."""
        limit = self.config.max_episode_steps
        self.env = envpool.make(
            self.config.task_name,
            env_type="gymnasium",
            seed=seeds,
            num_envs=self.config.num_envs,
            **({} if limit is None else {"max_episode_steps": limit}),
            **self.config.env_kwargs,
        )
        if self.env.config["max_num_players"] > 1:
            raise ConfigError(
                f"env {self.env_id!r}: EnvPool's task {self.config.task_name!r} has several "
                "players; choose one for a single player"
            )
        self._arrays = _PoolArrays(self.env)
        self._ready: Any = None  # The sub-environments that wait for actions.

    def _reopen(self, seeds: list[int]) -> None:
        self.env.close()
        self._open(seeds)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        """Reset every sub-environment.

        A seed makes a new pool, as EnvPool takes seeds only at construction. So does every reset
        but the first in asynchronous mode, as steps in progress can't be cancelled.

        Raises:
            ValueError: any `options`; EnvPool has none that resets the whole pool.
        """
        if options:
            raise ValueError(f"env {self.env_id!r}: EnvPool takes no reset options: {options}")
        if seed is not None:
            self._reopen(sub_env_seeds(self, seed))
        elif self._asynchronous and self._ready is not None:
            self._reopen(self._drawn_seeds())
        self.env.async_reset()
        observation, _, _, _, info = self._receive()
        return EnvRet(env_id=self.env_id, observation=observation, info=info)

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        # The pool reads the action later, and the caller may overwrite its array.
        action = np.array(as_numpy(self._preprocess_fn(policy_resp)))
        return result_of(self.env_id, self._step(action))

    def bare_step(self) -> BareStep | None:
        return self._step if self._is_bare else None

    def bare_step_async(self) -> tuple[BareStepAsync, BareStepWait] | None:
        return (self._send, self._receive) if self._is_bare else None

    @property
    def _is_bare(self) -> bool:
        plain = type(self).step is EnvPoolEnv.step
        return plain and not has_preprocess_fn(self)

    def _step(self, action: Any) -> BareResult:
        self._send(action)
        return self._receive()

    def _send(self, action: Any) -> None:
        """Answer the last result with an action that won't be overwritten."""
        if self._ready is None:
            raise RuntimeError(f"env {self.env_id!r} was stepped before its first reset")
        action = np.asarray(action)
        self._arrays.send(action if self.num_envs > 1 else action[None], self._ready)

    def _receive(self) -> BareResult:
        result = self._arrays.receive()
        # A copy, because the caller owns the original.
        self._ready = result[-1]["env_id"].copy()
        return result if self.num_envs > 1 else index(result, 0)

    def get_observation_space(self) -> gym.Space[Any]:
        return self._batched(self.env.observation_space)

    def get_action_space(self) -> gym.Space[Any]:
        return self._batched(self.env.action_space)

    def _batched(self, space: gym.Space[Any]) -> gym.Space[Any]:
        return batch_space(space, self.num_envs) if self.num_envs > 1 else space

    def close(self) -> None:
        self.env.close()


class _PoolArrays:
    """`send` and `recv` of a single-player pool, with their preparation done once.

    The originals lay out and name the arrays of `_send` and `_recv` in every step, which takes
    long compared with a short step. As in EnvPool 1.2 (`python/envpool.py` and
    `python/gymnasium_envpool.py`): `_send` takes ids, ids of players and the action, and
    `_recv` gives arrays in the order of `_state_keys`, such as ``info:env_id``, ``reward``,
    ``done``, ``trunc``, ``obs``, or ``obs:position`` for a Dict.
    """

    def __init__(self, pool: Any) -> None:
        self._pool = pool
        action = pool.spec.action_array_spec["action"]
        self._action_dtype = action.dtype
        self._action_shape = tuple(action.shape[1:] if action.shape[:1] == [-1] else action.shape)
        places = _nested(pool._state_keys)
        observation: Places = places["obs"]
        if not is_dict(pool.observation_space):
            while isinstance(observation, dict) and len(observation) == 1:
                (observation,) = observation.values()
        self._observation: Any = observation
        info: Any = places["info"]
        self._info: Any = {**info, "elapsed_step": places["elapsed_step"]}
        self._reward, self._done, self._truncated = map(
            pool._state_keys.index, ("reward", "done", "trunc")
        )

    def send(self, action: Any, env_ids: NDArray[np.int32]) -> None:
        """Do what the pool's `send` does, without copying the action."""
        action = np.ascontiguousarray(action, self._action_dtype)
        if action.shape != (len(env_ids), *self._action_shape):
            raise ValueError(
                f"an action of shape {action.shape} for {len(env_ids)} sub-environments; "
                f"expected {(len(env_ids), *self._action_shape)}"
            )
        self._pool._send([env_ids, env_ids, action])

    def receive(self) -> BareResult:
        """Do what the pool's `recv` does."""
        arrays = self._pool._recv()
        truncated = arrays[self._truncated]
        return (
            mapped(arrays.__getitem__, self._observation),
            arrays[self._reward],
            arrays[self._done] > truncated,
            truncated,
            mapped(arrays.__getitem__, self._info),
        )


def _nested(keys: list[str]) -> dict[str, Places]:
    """Return the positions of `keys` as a tree; a key is like ``info:players.env_id``."""
    tree: dict[str, Places] = {}
    for position, key in enumerate(keys):
        *path, name = key.replace(":", ".").split(".")
        node: Any = tree
        for part in path:
            node = node.setdefault(part, {})
        node[name] = position
    return tree
