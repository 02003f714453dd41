"""`BaseEnv`: the interface of every env, built-in or the user's own.

Rule: an env knows its simulator and its config, never its group, its process or
its channel. `reset` and `step` speak `EnvRet`; a backend whose step is exactly
Gymnasium's may also offer it bare (`fast_path`), which saves the wrapping.
"""

from __future__ import annotations

import abc
import copy
import gc
import sys
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, ClassVar

from rlightning_aio.envs.state import load_state, save_state
from rlightning_aio.types import (
    Autoreset,
    EnvMeta,
    EnvRet,
    MultiAgentEnvRet,
    PolicyResponse,
    default_env_preprocess_fn,
)

if TYPE_CHECKING:
    import gymnasium as gym

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.fast_path import BareResult

PreprocessFn = Callable[[PolicyResponse], Any]
Result = EnvRet | MultiAgentEnvRet | list[EnvRet]
Answer = Result | Awaitable[Result]
"""What `reset` and `step` return; those of awaitable envs are coroutine functions."""


def result_of(env_id: str, outcome: BareResult) -> EnvRet:
    """Make a result of the five values that a Gymnasium step returns."""
    observation, reward, terminated, truncated, info = outcome
    # Validation would cost more than everything else here.
    return EnvRet.model_construct(
        env_id=env_id,
        observation=observation,
        last_reward=reward,
        last_terminated=terminated,
        last_truncated=truncated,
        info=info,
    )


class BaseEnv(abc.ABC):
    """One environment (or ``num_envs`` vectorised ones) behind one interface.

    Subclasses call ``super().__init__`` first, create their simulator, and either set
    ``self.env`` or override the two space getters. A worker builds, resets, steps and
    closes an env on its main thread, one call at a time. An env whose `reset` and `step` are
    `async def` is awaitable: it runs on an event loop, with many others at once.

    Args:
        config: the config entry; the env keeps a deep copy.
        worker_index: 0-based index of this env within its entry.
        preprocess_fn: turns a `PolicyResponse` into what the simulator steps with.

    Attributes:
        env_id: ``<entry name>-<worker index>``, the same after a restart.
        trainer_pid: the trainer's process, if it is another process on this machine. The worker
            sets it once the env is built. A robot stops when that process is stopped.
        transforms_actions: set it on a subclass whose `step` takes actions that don't have to
            fit the action space (chunks, logits, dicts).
        hardware: set it on a subclass that moves something real.
        agents: agent names of a multi-agent env, in order; empty otherwise.
        num_envs: sub-environments in each result.
        autoreset: what sub-environments do after the end of their episode; see `EnvMeta`.
        switches_task: `reset` accepts the name of any task of the same spaces as
            ``options["task"]``, and switches to it until the next such reset.
    """

    transforms_actions: ClassVar[bool] = False
    hardware: ClassVar[bool] = False

    env: Any = None
    trainer_pid: int | None = None
    agents: tuple[str, ...] = ()
    autoreset: Autoreset = "disabled"
    switches_task: bool = False

    def __init__(
        self,
        config: EnvConfig,
        worker_index: int = 0,
        preprocess_fn: PreprocessFn | None = None,
        **kwargs: Any,
    ) -> None:
        del kwargs  # Accepted so that subclasses may pass on what they were given.
        self.config = copy.deepcopy(config)
        self.worker_index = worker_index
        self.env_id = f"{config.name}-{worker_index}"
        self.num_envs = config.num_envs
        self.max_episode_steps = config.max_episode_steps
        self._preprocess_fn = preprocess_fn or default_env_preprocess_fn

    @abc.abstractmethod
    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> Answer:
        """Start a new episode. An awaitable env defines this and `step` as `async def`.

        Args:
            seed: for the simulator; with ``num_envs > 1`` sub-environment k takes ``seed + k``.
            options: simulator-specific.

        Returns one result; only its id and observation are used. With ``num_envs > 1``, a reset or
        a step may also return a list with one result for each sub-environment, in order.
        """

    @abc.abstractmethod
    def step(self, policy_resp: PolicyResponse) -> Answer:
        """Advance by one step with the action that ``self._preprocess_fn`` makes.

        The defaults (reward 0.0, terminated and truncated False) apply to all sub-environments
        and agents.
        """

    def step_async(self, policy_resp: PolicyResponse) -> None:
        """Start a step, for an env that answers later, such as one on another machine.

        If an env defines this and `collect_async`, they replace `step`, which may then raise
        NotImplementedError. With inline placement a step starts when it is sent.
        """
        raise NotImplementedError(f"env {self.env_id!r} has no step_async()")

    def collect_async(self) -> Result:
        """Wait for the step that `step_async` started, and return its result."""
        raise NotImplementedError(f"env {self.env_id!r} has no collect_async()")

    def init(self) -> EnvMeta | None:
        """Finish construction where the env runs; called once. None stands for `get_metadata`."""
        return self.get_metadata()

    def get_metadata(self) -> EnvMeta:
        """Return id, spaces and counts of this env."""
        return EnvMeta(
            env_id=self.env_id,
            observation_space=self.get_observation_space(),
            action_space=self.get_action_space(),
            num_envs=self.num_envs,
            agents=self.agents,
            max_episode_steps=self.max_episode_steps,
            autoreset=self.autoreset,
            task=self.config.task_name,
            switches_task=self.switches_task,
        )

    def get_observation_space(self) -> gym.Space[Any]:
        """Return the space of ``EnvRet.observation``; batched when ``num_envs > 1``."""
        return self.env.observation_space

    def get_action_space(self) -> gym.Space[Any]:
        """Return the space of the actions of `step`; batched when ``num_envs > 1``."""
        return self.env.action_space

    def save_state(self) -> Any:
        """Return the complete state of the env as a value that can be pickled; see `load_state`.

        The default holds the attributes of this object and of the layers of its simulator; see
        docs/state.md. Define both methods if these can't be pickled or are not the whole state.

        Raises:
            NotImplementedError: the state can't be saved; the message says why.
        """
        return save_state(self)

    def load_state(self, state: Any) -> None:
        """Continue from the point where `save_state` was called.

        The state may come from this env or another one of the same entry, in this process or
        another, and may be loaded before the first reset.
        """
        load_state(self, state)

    def render(self) -> Any:
        """Return one frame as the simulator renders it."""
        return self.env.render()

    def render_one(self, sub_env: int) -> Any:
        """Return one frame of a sub-environment, or of an env that has no sub-environments.

        The default calls `render`, which renders all of them.
        """
        frames = self.render()
        return frames if self.num_envs == 1 else frames[sub_env]

    def offload(self) -> None:
        """Free device memory until `reload`; optional for envs that use none."""
        raise NotImplementedError(f"backend {self.config.backend!r} has no offload()")

    def reload(self) -> None:
        """Allocate the memory freed by `offload` again."""
        raise NotImplementedError(f"backend {self.config.backend!r} has no reload()")

    def clear_memory(self) -> None:
        """Release unused memory; `offload` calls this at its end.

        Collects garbage, then empties torch's cache of CUDA memory, if torch was imported.
        """
        gc.collect()
        torch: Any = sys.modules.get("torch")
        if torch is not None and torch.cuda.is_available():
            torch.cuda.empty_cache()

    def is_finish(self) -> bool:
        """Return True to end `RemoteEnvClient.run`.

        Called after every reset, step and `on_disconnect`, and not before.
        """
        return False

    def on_disconnect(self) -> None:
        """Bring the env to a safe state, because the trainer is gone. Default: do nothing."""

    def stop(self) -> None:
        """Stop what this env moves, at once. Default: `on_disconnect`.

        Called of hardware only (see `Backend`): after a `reset` or `step` has raised or
        its result was refused, when an action is refused, when the trainer is gone or ends, and
        before it is closed.
        It may be called from another thread while `reset` or `step` is at work, and again and
        again until that returns; what is at work should raise then.
        """
        self.on_disconnect()

    def close(self) -> Awaitable[None] | None:
        """Release everything; called once, also after a failed step. Default: nothing.

        An awaitable env may define it as `async def`.
        """


def initialised(env: BaseEnv) -> EnvMeta:
    """Call `init` and return the metadata; every runner of an env starts with this."""
    meta = env.init()
    return env.get_metadata() if meta is None else meta


def sub_env_seeds(env: BaseEnv, seed: int | list[int]) -> list[int]:
    """Return one seed for each sub-environment: ``seed + k``, or the given list.

    Raises:
        ValueError: a list of another length than ``num_envs`` of the config.
    """
    count = env.config.num_envs
    if not isinstance(seed, list):
        return [int(seed) + k for k in range(count)]
    if len(seed) != count:
        raise ValueError(f"env {env.env_id!r}: {len(seed)} seeds for {count} sub-environments")
    return [int(one) for one in seed]
