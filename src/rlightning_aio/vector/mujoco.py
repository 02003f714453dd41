"""Simulations of a MuJoCo task that are stepped together, as a vector env of their own.

No group is around them, so there is nothing to lose, to restart or to copy.
"""

from __future__ import annotations

import pickle
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.error import ResetNeeded

from rlightning_aio._core.group.state.snapshot_format import (
    EnvSnapshot,
    check_same,
    pack,
    unpack,
)
from rlightning_aio.envs.mujoco.batch import MujocoBatch
from rlightning_aio.envs.wrappers import check_running, name_of
from rlightning_aio.errors import SnapshotError
from rlightning_aio.vector.interface import CalledEnvs, check_name, checked_mask, seeds_of_envs
from rlightning_aio.vector.lazy_infos import LazyColumns

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gymnasium.vector import AutoresetMode
    from numpy.typing import NDArray


# skrl looks for Gymnasium among the bases themselves.
class MujocoVectorEnv(  # pyright: ignore[reportIncompatibleMethodOverride]  # `np_random`.
    MujocoBatch, CalledEnvs, gym.vector.VectorEnv[Any, Any, Any]
):
    """Simulations of one of Gymnasium's MuJoCo tasks behind Gymnasium's vector interface.

    MuJoCo steps and resets them in threads of this process. Returned arrays are fresh: no later
    call changes them. Infos are made when they are first read.

    Args:
        env, num_envs, autoreset_mode, num_threads: see `MujocoBatch`.
    """

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
        check_running(self)
        if options is not None and "reset_mask" in options:
            mask = checked_mask(options["reset_mask"], self.num_envs)
            options = {**options, "reset_mask": mask}
        return super().reset(seed=seeds_of_envs(seed, self.num_envs), options=options)

    # -- attributes -------------------------------------------------------------------------

    def call(self, name: str, /, *args: Any) -> tuple[Any, ...]:
        """Get attribute `name` of each env; see `MujocoBatch.call`."""
        check_running(self)
        check_name(name)
        return super().call(name, *args)

    def env_is_wrapped(self, wrapper_class: type[Any]) -> bool:
        """Return True if `wrapper_class` is among the wrappers of the envs."""
        check_running(self)
        return self.is_wrapped(name_of(wrapper_class))

    # -- state and rendering ---------------------------------------------------------------

    def snapshot(self) -> bytes:
        """Return the state of all envs.

        Raises:
            ResetNeeded: there was no reset yet, or a step or reset was interrupted.
        """
        check_running(self)
        if self._ended is None or not self._is_whole:
            raise ResetNeeded("there is no state to save before reset()")
        state = pickle.dumps(self.save_state())
        return pack([EnvSnapshot("simulations", self._identity(), {}, 0, False, state)])

    def restore(self, snapshot: bytes) -> tuple[NDArray[Any], dict[str, Any]]:
        """Put all envs into a state that `snapshot` has returned, here or in a run before.

        Returns what `reset` does: the observations that were returned last, and infos, which are
        empty.

        Raises:
            SnapshotError: it is damaged, or of another task, model, number of envs, mode or step
                limit, or of separate envs; nothing was changed.
        """
        check_running(self)
        saved, *_ = unpack(snapshot)
        check_same(saved, self._identity(), f"a {type(self).__name__}")
        state = pickle.loads(saved.state)  # noqa: S301  # See docs/state.md.
        try:
            self.load_state(state)
        except ValueError as error:
            raise SnapshotError(f"{error}; nothing was changed") from None
        return self._last.copy(), {}

    def _identity(self) -> dict[str, str]:
        """Return what the envs of a snapshot must share, by name."""
        task = "" if self.spec is None else self.spec.id
        kind = {name: str(value) for name, value in self._kind.items()}
        versions = {"version of mujoco": version("mujoco")}
        return {"backend": "simulations", "task": task, **kind, **versions}
