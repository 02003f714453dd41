"""`WatchedArm`: a simulated arm that a test can observe, and disturb."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from patience import HANG

from rlightning_aio.plugins.piper.arm import CanFrame, SimulatedArm

if TYPE_CHECKING:
    from collections.abc import Callable


class WatchedArm(SimulatedArm):
    """Remembers every command, and can be made deaf to some or fall silent.

    Attributes:
        in_the_grip: what the gripper can't close any further than, in m.
    """

    def __init__(self) -> None:
        super().__init__()
        self.commands: list[CanFrame] = []
        self.deaf_to: set[int] = set()
        self.silent = False
        self.in_the_grip = 0.0
        self._changed = threading.Condition()

    def receive(self, frame: CanFrame) -> list[CanFrame]:
        with self._changed:
            self.commands.append(frame)
            answers = [] if frame.can_id in self.deaf_to else super().receive(frame)
            self._changed.notify_all()
        return answers

    def advance(self, seconds: float) -> None:
        super().advance(seconds)
        if self.in_the_grip:
            self.gripper = max(self.gripper, self.in_the_grip)

    def feedback(self) -> list[CanFrame]:
        return [] if self.silent else super().feedback()

    def wait_for(self, predicate: Callable[[], Any], seconds: float = HANG) -> bool:
        """Return True if `predicate` becomes true after a command, within the time limit."""
        with self._changed:
            return bool(self._changed.wait_for(predicate, seconds))
