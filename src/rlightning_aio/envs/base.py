"""`BaseEnv`: what every environment is to the runtime, one of a user's own, too.

Rule: an env knows its simulator and its config, never its group, its process or
its channel. `reset` and `step` speak `EnvRet`; a backend whose step is exactly
Gymnasium's may also offer it bare (`bare_step`), which saves the wrapping.
"""

from __future__ import annotations

import abc
import copy
import gc
import sys
from collections.abc import Callable
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

__all__ = [
    "BareReset",
    "BareResult",
    "BareStep",
    "BareStepAsync",
    "BareStepWait",
    "BaseEnv",
    "PreprocessFn",
    "Result",
    "result_of",
]

PreprocessFn = Callable[[PolicyResponse], Any]
Result = EnvRet | MultiAgentEnvRet | list[EnvRet]
BareReset = Callable[..., tuple[Any, dict[str, Any]]]
BareResult = tuple[Any, Any, Any, Any, dict[str, Any]]
BareStep = Callable[[Any], BareResult]
BareStepAsync = Callable[[Any], None]
BareStepWait = Callable[[], BareResult]


def result_of(env_id: str, outcome: BareResult) -> EnvRet:
    """The result that the five values of a Gymnasium step make."""
    observation, reward, terminated, truncated, info = outcome
    # Not validated: that would cost more than everything else here.
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
    closes an env on its main thread, one call at a time.

    Args:
        config: the config entry; the env keeps a deep copy.
        worker_index: 0-based index of this env within its entry.
        preprocess_fn: turns a `PolicyResponse` into what the simulator steps with.

    Attributes:
        env_id: ``<entry name>-<worker index>``, the same after a restart.
        trainer_pid: the trainer's process, if it is another process on this machine; the worker
            sets it once the env is built. A robot stops when that process is stopped.
        transforms_actions: set it on a subclass whose `step` takes actions that need not
            fit the action space (chunks, logits, dicts).
        agents: agent names of a multi-agent env, in order; empty otherwise.
        num_envs: sub-environments in each result. If it is below the config's, each result comes
            from some of them, and ``info["env_id"]`` says from which.
        autoreset: what sub-environments do after the end of their episode; see `EnvMeta`.
        fresh_results: what `bare_step` returns consists of new arrays and dicts, which nobody
            reads or writes again: with inline placement, observation and info are passed on
            uncopied.
    """

    transforms_actions: ClassVar[bool] = False
    fresh_results: ClassVar[bool] = False

    env: Any = None
    trainer_pid: int | None = None
    agents: tuple[str, ...] = ()
    autoreset: Autoreset = "disabled"

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
    ) -> Result:
        """Start a new episode.

        Args:
            seed: for the simulator; with ``num_envs > 1`` sub-environment k takes ``seed + k``.
            options: simulator-specific.

        Returns one result, of which only id and observation count. With ``num_envs > 1`` it may
        be a list with one for each sub-environment, in order; so may that of a step.
        """

    @abc.abstractmethod
    def step(self, policy_resp: PolicyResponse) -> Result:
        """Advance by one step with the action that ``self._preprocess_fn`` makes.

        A reward of 0.0 and ends of False, which are the defaults, hold for all sub-environments
        and agents.
        """

    def step_async(self, policy_resp: PolicyResponse) -> None:
        """Start a step, for an env that answers later, such as one on another machine.

        If an env has this and `collect_async`, they replace `step`, which may raise
        NotImplementedError then. With inline placement a step starts when it is sent.
        """
        raise NotImplementedError(f"env {self.env_id!r} has no step_async()")

    def collect_async(self) -> Result:
        """Wait for the end of the step that `step_async` has started, and return its result."""
        raise NotImplementedError(f"env {self.env_id!r} has no collect_async()")

    def bare_step(self) -> BareStep | None:
        """The simulator's own ``action -> (obs, reward, terminated, truncated, info)``.

        Return it only if `step` adds nothing to it but a call of ``self._preprocess_fn``, which
        the runtime makes by itself; None (the default) has the runtime call `step`. The action
        is its own: nobody writes to it again.
        """
        return None

    def bare_step_async(self) -> tuple[BareStepAsync, BareStepWait] | None:
        """`bare_step` in two halves: one only starts a step, the other waits for its end.

        Return them, beside a `bare_step`, if the simulator computes by itself in between: with
        inline placement a step whose action fits its row starts when it is sent then, not when
        it is collected. An interrupt (Ctrl-C) of the first half comes with the result.
        """
        return None

    def bare_reset(self) -> BareReset | None:
        """The simulator's own ``(seed=, options=) -> (obs, info)``, if `reset` adds nothing.

        Used where `bare_step` is.
        """
        return None

    def init(self) -> EnvMeta | None:
        """Called once after construction, where the env lives; None stands for `get_metadata`."""
        return self.get_metadata()

    def initialised(self) -> EnvMeta:
        """Call `init`, as whoever runs an env does; what the env is like from then on."""
        meta = self.init()
        return self.get_metadata() if meta is None else meta

    def get_metadata(self) -> EnvMeta:
        """Id, spaces and counts of this env."""
        return EnvMeta(
            env_id=self.env_id,
            observation_space=self.get_observation_space(),
            action_space=self.get_action_space(),
            num_envs=self.num_envs,
            agents=self.agents,
            max_episode_steps=self.max_episode_steps,
            autoreset=self.autoreset,
        )

    def get_observation_space(self) -> gym.Space[Any]:
        """Space of ``EnvRet.observation``; batched when ``num_envs > 1``."""
        return self.env.observation_space

    def get_action_space(self) -> gym.Space[Any]:
        """Space of the actions that `step` takes; batched when ``num_envs > 1``."""
        return self.env.action_space

    def sub_env_seeds(self, seed: int | list[int]) -> list[int]:
        """One seed for each sub-environment: ``seed + k``, or the list that was given.

        Raises:
            ValueError: a list of another length than ``num_envs`` of the config.
        """
        count = self.config.num_envs
        if not isinstance(seed, list):
            return [int(seed) + k for k in range(count)]
        if len(seed) != count:
            raise ValueError(f"env {self.env_id!r}: {len(seed)} seeds for {count} sub-environments")
        return [int(one) for one in seed]

    def save_state(self) -> Any:
        """Everything that the env needs to continue from here exactly as it would have, as a
        value that can be pickled; see `load_state`.

        By default it holds the attributes of this object and of the layers of its simulator; see
        docs/state.md. Define both methods if these can't be pickled, or aren't the whole state.

        Raises:
            NotImplementedError: the env can't give its state; the message says why.
        """
        return save_state(self)

    def load_state(self, state: Any) -> None:
        """Continue from where `save_state` was called: on this env or on another of the same
        entry, in this process or another, perhaps before its first reset.
        """
        load_state(self, state)

    def render(self) -> Any:
        """One frame, as the simulator renders it."""
        return self.env.render()

    def render_one(self, sub_env: int) -> Any:
        """One frame of a sub-environment; of an env without such, its own.

        By default what `render` has for it, which renders all of them.
        """
        frames = self.render()
        return frames if self.num_envs == 1 else frames[sub_env]

    def offload(self) -> None:
        """Free device memory until `reload`; envs that hold none need not support it."""
        raise NotImplementedError(f"backend {self.config.backend!r} has no offload()")

    def reload(self) -> None:
        """Allocate the memory freed by `offload` again."""
        raise NotImplementedError(f"backend {self.config.backend!r} has no reload()")

    def clear_memory(self) -> None:
        """Release memory that nothing uses any more; for `offload` to call at its end.

        Collects garbage, then empties torch's cache of CUDA memory, if torch was imported.
        """
        gc.collect()
        torch: Any = sys.modules.get("torch")
        if torch is not None and torch.cuda.is_available():
            torch.cuda.empty_cache()

    def is_finish(self) -> bool:
        """Whether `RemoteEnvClient.run` should end; asked after every reset and step."""
        return False

    def on_disconnect(self) -> None:
        """The trainer is gone: bring the env to a safe state (a robot stops). Default: nothing."""

    def close(self) -> None:
        """Release everything; called once, also after a failed step. Default: nothing."""
