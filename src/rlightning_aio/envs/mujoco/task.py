"""What a task of many simulations is; `tasks` and `walkers` have Gymnasium's.

Actions and observations are ``[n, ...]``; what rewards are made of is ``[..., n]`` where NumPy is
faster so.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.envs.mujoco.outputs import FieldPart, StepArrays
    from rlightning_aio.envs.mujoco.threads import Simulations

Columns = Callable[[], dict[str, Any]]
"""Makes infos of several simulations, from values that don't change later."""


class Task:
    """Base class of tasks.

    Args:
        env: the unwrapped Gymnasium env.
        simulations: n of them; their outputs become those of the task.

    Attributes:
        needs_forces: True if the task reads contact forces.
        noise: how a reset draws velocities around the first ones, after positions that it draws
            uniformly; or more than that.
        num_further: number of columns that follow from others.
        place: where the bodies are, ``[..., n]``, for their velocities; None if unused.
    """

    needs_forces: ClassVar[bool] = False
    noise: ClassVar[Literal["uniform", "normal", "more"]] = "uniform"
    num_further = 0

    def __init__(self, env: Any, simulations: Simulations) -> None:
        self.env = env
        self.simulations = simulations
        self.place: Any = None
        self._outputs = simulations.watch(self.observed(), self.watched(), self.num_further)
        self._columns_before = self.columns

    @property
    def frame(self) -> StepArrays:
        """Arrays that the last step or reset wrote."""
        return self._outputs.frame

    @property
    def columns(self) -> NDArray[np.float64]:
        return self._outputs.frame.columns

    # -- the differences between tasks ----------------------------------------------------

    def observed(self) -> list[FieldPart]:
        """Parts of a simulation that form an observation."""
        raise NotImplementedError

    def watched(self) -> list[FieldPart]:
        return []

    def finish(self, which: Any = ...) -> None:
        """Complete the observations of some simulations in place."""

    def judge(self, frame: StepArrays) -> Columns:
        """Write rewards and terminations of a step. Return its infos."""
        raise NotImplementedError

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        """Infos of a reset of the simulations `ids`."""
        del ids
        return dict

    def settle(self, ids: Any) -> None:
        """Record where the simulations `ids` are after a reset."""

    def explain(self, frame: StepArrays) -> Columns:
        """Infos of a step that was judged."""
        raise NotImplementedError

    # -- use --------------------------------------------------------------------------------

    def renew(self, observations: NDArray[np.float64] | None = None) -> None:
        """Write the next outputs to another frame, as somebody has the last one.

        Args:
            observations: where to write them if some simulations stay as they are.
        """
        self._columns_before = self.columns
        if observations is None:
            self._outputs.renew()
        else:
            self._outputs.begin(observations)

    def keep(self, ids: list[int], observations: NDArray[np.float64]) -> None:
        """Leave the outputs of the simulations `ids` as they were; observations are given."""
        frame = self.frame
        frame.observations[ids] = observations[ids]
        frame.columns[:, ids] = self._columns_before[:, ids]
        self.settle(ids)

    def put(self, k: int, data: Any) -> None:
        """Move simulation `k` to `data`, without a step."""
        self._outputs.begin(self.frame.observations)
        self.simulations.put(k, data)
        self.settle([k])

    def stepped(self) -> Columns:
        """Judge a step, unless that was done. Return its infos."""
        frame = self.frame
        if self.simulations.has_judged:
            return self.explain(frame)
        self.finish()
        return self.judge(frame)


def lengths(vectors: NDArray[np.float64]) -> Any:
    """Return the length of each vector."""
    # Like `np.linalg.norm`, which uses a dot product.
    return np.sqrt(np.vecdot(vectors, vectors))
