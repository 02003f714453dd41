"""`LoneCore`: the core of a synchronous group with a single, inline env.

That is what a script with one batched simulator has. A `step` that needs nothing but an
action is executed on the spot: there is nobody to wait for, and so no request to keep
account of, which halves what the group costs. Everything else is the core's own.
Absent on purpose: asynchronous groups, whose other tasks may ask, cancel and collect in
the middle of a step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from rlightning_aio.group.actions import write_actions
from rlightning_aio.group.auto_reset import NO_RESETS
from rlightning_aio.group.core import Core, Flags
from rlightning_aio.hosts.worker import ErrorText
from rlightning_aio.protocol.rings import STEP

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.fleet import Fleet
    from rlightning_aio.group.wait import Operation
    from rlightning_aio.hosts.inline import InlineHost

__all__ = ["LoneCore", "core_of"]


def core_of(fleet: Fleet, *, zero_copy: bool) -> Core:
    """The core that suits the group."""
    configs = fleet.slots.configs
    lone = len(configs) == len(fleet.slots.local_ids) == 1 and configs[0].placement == "inline"
    suited = LoneCore if lone and not fleet.watcher.shares_thread else Core
    return suited(fleet, zero_copy=zero_copy)


class LoneCore(Core):
    """A core whose slot 0 is all there is, and executes its steps at once."""

    def step(self, batch: BatchedData, now: float) -> Operation[tuple[BatchedData, Flags | None]]:
        """See `EnvGroup.step`."""
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
