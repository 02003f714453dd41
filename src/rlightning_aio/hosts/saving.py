"""`SavingRunner`: an env that sends its standing now and then, for a replacement of its worker.

It does so after each reset, after each end, and after every so many steps in between. It also does
so before a reset if it has stepped since, so that the state that an episode has left in generators
and wrappers isn't lost. So the last standing sent always lies in the same episode as the last
answer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio.hosts.runner import EnvRunner
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from rlightning_aio.config import VideoConfig
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.hosts.messages import OutOfBand
    from rlightning_aio.hosts.runner import Execute
    from rlightning_aio.protocol.slab import RowLayout

__all__ = ["SavingRunner"]


class SavingRunner(EnvRunner):
    """See the module. Its env's config says how many steps come between two standings at most."""

    def __init__(
        self, env: BaseEnv, *, inline: bool = False, video: VideoConfig | None = None
    ) -> None:
        super().__init__(env, inline=inline, video=video)
        assert env.config.snapshot_every is not None
        self._every = env.config.snapshot_every
        self._since = 0

    def _bind(self, layout: RowLayout) -> None:
        super()._bind(layout)
        self._over = self._slab.over[self._row, ...]
        self.step = self._saving(self.step)
        self._own_reset = self._resetting(self._own_reset)
        # Its halves would not come by here.
        self.begin_step = None

    def execute(self, op: int, arguments: Any) -> Any:
        if op == Operation.RESET:
            return self._reset_saving(lambda: super(SavingRunner, self).execute(op, arguments))
        outcome = super().execute(op, arguments)
        if op == Operation.STEP:
            self._note_step()
        elif op == Operation.RESTORE:
            self._save()
        return outcome

    def _saving(self, step: Execute) -> Execute:
        def step_and_save() -> OutOfBand | None:
            outcome = step()
            self._note_step()
            return outcome

        return step_and_save

    def _note_step(self) -> None:
        self._since += 1
        if self._since >= self._every or self._over.all():
            self._save()

    def _resetting(self, reset: Execute) -> Execute:
        return lambda: self._reset_saving(reset)

    def _reset_saving(self, reset: Execute) -> OutOfBand | None:
        if self._since:
            self._save(before=True)
        outcome = reset()
        self._began = True
        self._save()
        return outcome

    def _save(self, *, before: bool = False) -> None:
        self._keep(self.standing(), before)
        self._since = 0
