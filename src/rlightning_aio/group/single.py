"""`SingleEnvCore`: the core of a synchronous group with a single, inline env.

That is what a script with one batched simulator has. A `step` that needs nothing but an
action is executed on the spot: there is nobody to wait for, and so no request to keep
account of, which halves what the group costs. Everything else is the core's own.
Absent on purpose: asynchronous groups, whose other tasks may ask, cancel and collect in
the middle of a step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from rlightning_aio.batch.data import columns_of_responses
from rlightning_aio.group.actions import write_actions
from rlightning_aio.group.auto_reset import NO_RESETS
from rlightning_aio.group.core import Core, Flags
from rlightning_aio.hosts.messages import ErrorText

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.wait import Procedure
    from rlightning_aio.hosts.messages import OutOfBand

__all__ = ["SingleEnvCore", "StepsAtOnce"]


@runtime_checkable
class StepsAtOnce(Protocol):
    """A host that can step its first env without a request."""

    def step_now(self) -> OutOfBand | None:
        """Step with the action in the row; what of the result is out of band."""
        ...


class SingleEnvCore(Core):
    """A core whose slot 0 is all there is, and executes its steps at once."""

    single_host: StepsAtOnce
    """Set by `assemble`."""

    def step(self, batch: BatchedData, now: float) -> Procedure[tuple[BatchedData, Flags | None]]:
        """See `EnvGroup.step`."""
        slots = self._slots_of(batch)
        self._dispatch.check_sendable(slots, "step")
        out_of_band = write_actions(batch, slots, self.envs, self._layout)
        columns = columns_of_responses(batch)
        at_once = out_of_band is None and columns is not None and len(slots) > 0
        if not at_once or self.auto.due(slots) is not NO_RESETS:
            return (yield from super().step(batch, now))
        self._results.note_sent(slots, columns)
        self.requests.step_answered_at_once(0, now)
        try:
            out_of_band = self.single_host.step_now()
        except BaseException as error:
            self.auto.not_completed(slots)
            if isinstance(error, KeyboardInterrupt):
                raise
            raise self._intake.raised(0, ErrorText.of(error)) from None
        self._results.keep(0, out_of_band or {})
        self.requests.answer_at_once(0)
        self.drain()  # An info may have come in a new form.
        results, flags = self.hand_out(slots, synchronous=True)
        return results, flags if self.auto.active else None
