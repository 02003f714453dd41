"""`LoneCore`: the core of a group whose only env is inline, as a batched simulator's may be.

A step that needs nothing but an action is executed on the spot. There is nobody to wait
for then, and no request to keep account of: the group costs half as much.
Everything else is the core's own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from rlightning_aio.group.actions import write_actions
from rlightning_aio.group.auto_reset import NO_RESETS
from rlightning_aio.group.core import Core, Flags
from rlightning_aio.group.wait import Operation, Wait
from rlightning_aio.hosts.worker import ErrorText
from rlightning_aio.protocol.rings import STEP

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.fleet import Fleet
    from rlightning_aio.hosts.inline import InlineHost

__all__ = ["LoneCore", "core_of"]


def core_of(fleet: Fleet, *, zero_copy: bool) -> Core:
    """The core that suits the group."""
    configs = fleet.slots.configs
    lone = len(configs) == len(fleet.slots.local_ids) == 1 and configs[0].placement == "inline"
    return (LoneCore if lone else Core)(fleet, zero_copy=zero_copy)


class LoneCore(Core):
    """See the module."""

    def step(self, batch: BatchedData, now: float) -> Operation[tuple[BatchedData, Flags | None]]:
        """See `EnvGroup.step`."""
        if self.fleet.watcher.shares_thread:
            now = yield Wait(0.0)
        slots, table = self.slots_of(batch), self.slots
        self._check_sendable(slots, "step")
        letters = write_actions(batch, slots, table, self.fleet.slabs)
        if letters is not None or not len(slots) or self.auto.due(slots) is not NO_RESETS:
            return (yield from super().step(batch, now))
        table.renumber(slots, STEP)
        table.sent_ns[0] = int(now * 1e9)
        try:
            rest = cast("InlineHost", self.fleet.hosts[0]).step_now(0)
        except BaseException as error:
            self.auto.not_completed(slots)
            if isinstance(error, KeyboardInterrupt):
                raise
            raise self._raised(0, ErrorText.of(error)) from None
        if rest is not None:
            self._rests[0] = rest
        results, flags = self._hand_out(slots, synchronous=True)
        return results, flags if self.auto.active else None
