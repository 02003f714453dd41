"""`AwaitedRunner`: executes requests on one env whose `reset` and `step` are coroutine functions.

It is an `EnvRunner` that awaits the env and writes each result as that does.
"""

from __future__ import annotations

import inspect
import time
from typing import TYPE_CHECKING, Any

from rlightning_aio._core.hosts.messages import NO_ACTION, STEP_IN_ROW
from rlightning_aio._core.hosts.running.runner import EnvRunner, loaded
from rlightning_aio.envs.results import one_result
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.messages import OutOfBand

__all__ = ["Abandoned", "AwaitedRunner"]


class Abandoned(Exception):
    """The env was replaced while it was executing a request; its result is dropped."""


class AwaitedRunner(EnvRunner):
    """See the module.

    Attributes:
        is_abandoned: the env was replaced and may not write to its row any more.
        reset_with: seed and options of the last reset, of this env or of the one before it.
    """

    is_awaitable = True
    is_abandoned = False
    reset_with: tuple[Any, Any] = (None, None)

    def _bind(self) -> None:
        """Prepare steps; `answer` executes everything, and `snapshot_every` is refused."""
        bare = self.env.bare_step()
        self._step_env: Any = self.env.step if bare is None else bare
        self._is_bare = bare is not None

    def place_like(self, other: AwaitedRunner) -> None:
        """Take over the row of `other`, which this env replaces, and its episode."""
        self.attach(other._slab, other._row, other._announce)
        self.reset_with = other.reset_with

    async def answer(self, op: int, arguments: Any) -> Any:
        """Execute one request.

        Args:
            op: the operation.
            arguments: as of `EnvRunner.execute`.

        Returns the part of the result that is out of band; for a call, its value.
        """
        arguments = loaded(arguments)
        if op == Operation.STEP:
            action, extras = arguments or STEP_IN_ROW
            if action is NO_ACTION:
                action = self._read_action() if self._read_action is not None else None
            began = time.monotonic_ns()
            returned = await self._step_env(self._input(action, extras))
            return self._finish(returned, "step", time.monotonic_ns() - began)
        if op == Operation.RESET:
            return await self._reset_awaited(arguments)
        outcome = self.execute(op, arguments)
        return await outcome if inspect.iscoroutine(outcome) else outcome

    async def _reset_awaited(self, arguments: Any) -> OutOfBand | None:
        if arguments is None:
            if self._checkpoints.must_show():
                return self._show()
            as_before = self._slab.take_as_before(self._row)
            arguments = self.reset_with if as_before else (self._slab.take_seed(self._row), None)
        self._checkpoints.forget_result()
        seed, options = arguments
        if arguments is not self.reset_with:  # Not after a hang, whose numbers would come again.
            self._seed_generators(seed)
        if not (options and "reset_mask" in options):  # It begins no episode of the whole env.
            self.reset_with = arguments
        began = time.monotonic_ns()
        resetting: Any = self.env.reset(seed=seed, options=options)
        out_of_band = self._finish(await resetting, "reset", time.monotonic_ns() - began)
        self._checkpoints.note_result()
        return out_of_band

    def _finish(self, returned: Any, method: str, busy_ns: int) -> OutOfBand | None:
        """Write what the env has returned."""
        if self.is_abandoned:
            raise Abandoned
        stepped = method == "step"
        if stepped and self._is_bare:
            out_of_band = self._writer.write_step(returned, busy_ns)
        else:
            result = one_result(self.env, method, returned)
            out_of_band = self._write(result, busy_ns, stepped=stepped)
        if self._camera is not None:
            self._camera.see()
        return out_of_band
