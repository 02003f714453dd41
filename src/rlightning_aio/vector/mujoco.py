"""Simulations of a MuJoCo task that are stepped together, as a vector env of their own.

No group is around them, so there is nothing to lose, to restart or to copy.
"""

from __future__ import annotations

import copy
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded

from rlightning_aio.envs.mujoco.batch import MujocoBatch
from rlightning_aio.envs.wrappers import name_of
from rlightning_aio.vector.lazy_infos import LazyColumns
from rlightning_aio.vector.pending import check_free, check_sent
from rlightning_aio.vector.proxies import CalledEnvs, check_name
from rlightning_aio.vector.reset_arguments import checked_mask, seeds_of_envs

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gymnasium.vector import AutoresetMode
    from numpy.typing import NDArray

__all__ = ["MujocoVectorEnv"]


# skrl looks for Gymnasium among the bases themselves.
class MujocoVectorEnv(  # pyright: ignore[reportIncompatibleMethodOverride]  # `np_random`.
    MujocoBatch, CalledEnvs, gym.vector.VectorEnv[Any, Any, Any]
):
    """Simulations of one of Gymnasium's MuJoCo tasks behind Gymnasium's vector interface.

    MuJoCo steps and resets them in threads of this process. Returned arrays are fresh: no later
    call changes them. Infos are made when they are first read.

    Args:
        env, num_envs, autoreset_mode, num_threads, randomize: see `MujocoBatch`.
    """

    _pending: str | None = None
    _do: Callable[[], Any]

    @property
    def autoreset_mode(self) -> AutoresetMode:
        return self.metadata["autoreset_mode"]

    @property
    def group(self) -> Any:
        """There is none; the error says how to get one."""
        raise AttributeError(
            "group: the envs of this task are stepped together in this process, without a group. "
            "EnvGroup with EnvConfig(num_envs=...) has groups of such batches; make_vec with "
            "placement='process', or another field of a config entry, has one of separate envs"
        )

    def _infos(self, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        return LazyColumns(make)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Reset all envs, or those of a mask.

        Args:
            seed: env k gets ``seed + k``; or a sequence with one seed or None for each env.
            options: passed to the task, without ``reset_mask``: a bool array ``[num_envs]`` that
                selects the envs to reset. The others return their last observation again.

        Raises:
            ClosedEnvironmentError: the vector env is closed.
        """
        check_free(self, self._pending, "reset_async")
        return self._resetting(seed, options)()

    def _resetting(self, seed: Any, options: dict[str, Any] | None) -> Callable[[], Any]:
        """Check the arguments of a reset, and return what does it; they may change meanwhile."""
        if options is not None and "reset_mask" in options:
            mask = checked_mask(options["reset_mask"], self.num_envs)
            options = {**options, "reset_mask": mask}
        return partial(super().reset, seed=seeds_of_envs(seed, self.num_envs), options=options)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[Any], NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:  # fmt: skip
        """Step all envs, or reset those that are over; see `MujocoBatch.step`."""
        check_free(self, self._pending, "step_async")
        return super().step(actions)

    # -- in two halves, of which the second computes -----------------------------------------

    def reset_async(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Note a reset; `reset_wait` resets."""
        check_free(self, self._pending, "reset_async")
        self._note("reset", self._resetting(seed, options))

    def reset_wait(self, timeout: float | None = None) -> tuple[NDArray[Any], dict[str, Any]]:
        """Reset as `reset_async` was told; `timeout` is ignored."""
        return self._noted("reset", timeout)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Note actions; `step_wait` steps."""
        self._note("step", partial(super().step, np.array(actions)))

    def step_wait(self, timeout: float | None = None) -> Any:
        """Step as `step_async` was told; `timeout` is ignored."""
        return self._noted("step", timeout)

    def call_async(self, name: str, /, *args: Any, **kwargs: Any) -> None:
        """Note a call; `call_wait` calls."""
        check_name(name)
        self._note("call", partial(super().call, name, *args, **kwargs))

    def call_wait(self, timeout: float | None = None) -> tuple[Any, ...]:
        """Call as `call_async` was told; `timeout` is ignored."""
        return self._noted("call", timeout)

    def _note(self, what: str, do: Callable[[], Any]) -> None:
        check_free(self, self._pending, f"{what}_async")
        self._pending, self._do = what, do

    def _noted(self, what: str, timeout: float | None) -> Any:
        del timeout
        check_sent(self, self._pending, what)
        self._pending = None
        return self._do()

    # -- methods and attributes -----------------------------------------------------------

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call method `name` of each env, or get an attribute."""
        check_free(self, self._pending, "call_async")
        check_name(name)
        return super().call(name, *args, **kwargs)

    def set_attr(self, name: str, values: Any) -> None:
        """Set attribute `name` of all envs to one value, or to equal values in a list or tuple."""
        check_free(self, self._pending, "set_attr")
        super().set_attr(name, values)

    def _look_up(self, place: int, name: str) -> tuple[bool, Any]:
        is_method = callable(getattr(self.env, name, None))
        return is_method, None if is_method else self._call_one(place, name)

    def _call_one(self, place: int, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of env `place`, or get its attribute."""
        check_free(self, self._pending, "call_async")
        check_name(name)
        return self.call_one(place, name, *args, **kwargs)

    def env_is_wrapped(self, wrapper_class: type[Any]) -> bool:
        """Return True if `wrapper_class` is among the wrappers of the envs."""
        check_free(self, self._pending, "call_async")
        return self.is_wrapped(name_of(wrapper_class))

    # -- state and rendering ---------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """Return the state of all envs, as a copy that can be pickled.

        Raises:
            ResetNeeded: there was no reset yet, or a step or reset was interrupted.
        """
        check_free(self, self._pending, "save_state")
        if self._ended is None or not self._is_whole:
            raise ResetNeeded("there is no state to save before reset()")
        return copy.deepcopy(super().save_state())

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore the state of all envs, of this vector env or of another one of the same task.

        Raises:
            ValueError: it is that of another model, number of envs, mode or step limit, of envs
                with another `randomize`, or of separate envs; nothing was changed.
        """
        check_free(self, self._pending, "load_state")
        if "simulations" not in state:
            raise ValueError("this is the state of a group of separate envs")
        super().load_state(copy.deepcopy(state))

    def render_one(self, k: int) -> Any:
        """Render a frame of env k in the render mode of the task."""
        check_free(self, self._pending, "render_one")
        return super().render_one(k)
