"""Checkpoints: state and last result of an env, which let it continue in another worker.

A checkpoint is one pickle. Shown again, its result is no transition: no reward, no end, `is_reset`.
Observation, info and the sums of its episodes are as before, so the env continues as it would
have. `Saver` sends checkpoints to the trainer, which keeps the last one for a replacement of the
worker; `group.episodes.continuity` decides when it is used.
"""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any, TypeAlias

from rlightning_aio.protocol.pickling import dumped

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import OutOfBand
    from rlightning_aio._core.hosts.running.row_writer import RowWriter, ShownResult
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.protocol.slab import Slab

__all__ = ["Checkpoints", "Saver", "Send"]

Send: TypeAlias = "Callable[[bytes, bool], None]"
"""Sends a checkpoint. The flag is True if it is from before the current request."""


class Checkpoints:
    """Saves and restores one env.

    Args:
        env: the env.
        slab, row: where its results are.
        writer: of that row.

    Attributes:
        has_result: the env was reset, here or before its checkpoint was taken.
    """

    def __init__(self, env: BaseEnv, slab: Slab, row: int, writer: RowWriter) -> None:
        self._env, self._slab, self._row, self._writer = env, slab, row, writer
        self._restored: ShownResult | None = None
        self.has_result = False

    def take(self) -> bytes:
        """Return a checkpoint.

        Raises:
            TypeError: its state can't be pickled.
        """
        shown_result = self._restored
        if shown_result is None and self.has_result:
            shown_result = self._writer.shown_result()
        is_unshown = self._restored is not None
        return dumped((self._env.save_state(), shown_result, is_unshown), "its state")

    def load(self, checkpoint: bytes, *, show: bool) -> None:
        """Restore the env.

        With `show`, its next reset `AS_RESTORED` shows the saved result; otherwise only if that
        had still to be shown when the checkpoint was taken.
        """
        state, shown_result, is_unshown = pickle.loads(checkpoint)
        self._env.load_state(state)
        self.has_result = shown_result is not None
        self._restored = shown_result if show or is_unshown else None

    def resume(self, checkpoint: bytes) -> None:
        """Restore an env that was just built."""
        try:
            self.load(checkpoint, show=True)
        except ValueError:
            # The first reset may create parts of the state.
            self._env.reset()
            self.load(checkpoint, show=True)

    def note_result(self) -> None:
        """Record that the env was reset."""
        self.has_result = True

    def forget_result(self) -> None:
        """Drop a restored result that was not shown: the env is about to be reset."""
        self._restored = None

    def accept_show(self) -> bool:
        """Return True if the reset in the row asks for the restored result; forget it otherwise."""
        if self._restored is not None and self._slab.take_as_restored(self._row):
            return True
        self._restored = None
        return False

    def show(self) -> OutOfBand | None:
        """Write the restored result into the row; return what is out of band."""
        shown_result, self._restored = self._restored, None
        assert shown_result is not None
        return self._writer.write_shown(shown_result)


class Saver:
    """Sends checkpoints of an env: after each reset, each end, and every `every` steps in between.

    It also sends one before a reset that follows a step, because generators and wrappers may keep
    state from one episode to the next. So the last checkpoint and the last result always belong
    to the same episode.
    """

    def __init__(
        self, checkpoints: Checkpoints, over: NDArray[Any], every: int, send: Send
    ) -> None:
        self._checkpoints, self._over, self._every, self._send = checkpoints, over, every, send
        self._num_steps = 0

    def after_step(self) -> None:
        """Send a checkpoint after a step, if it is due."""
        self._num_steps += 1
        if self._num_steps >= self._every or self._over.all():
            self.save()

    def before_reset(self) -> None:
        """Send a checkpoint before a reset, if a step came before it."""
        if self._num_steps:
            self.save(before=True)

    def save(self, *, before: bool = False) -> None:
        """Send a checkpoint, which is from `before` the current request or after it."""
        self._send(self._checkpoints.take(), before)
        self._num_steps = 0
