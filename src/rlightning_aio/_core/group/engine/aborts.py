"""`Aborts`: ends requests without their results, because their caller wants none.

An aborted request belongs to nobody: its call ends in `EpisodeLost`, and its reply is dropped when
it comes. The env is busy until then, which is soon, whatever it does: its host cancels the request,
takes it out of its queue, or is replaced (see `HangDetector`). The episode is lost.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio._core.group.state.request_states import COLLECTOR, NOBODY
from rlightning_aio.errors import EpisodeLost
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.results import Results
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables

_WHY: Final = Loss("was aborted", "cancelled", "caller")


class Aborts:
    """See the module; the arguments are the group's parts."""

    def __init__(
        self,
        tables: Tables,
        supervisor: Supervisor,
        results: Results,
        waiting: Waiting,
    ) -> None:
        self._envs = tables.envs
        self._requests = tables.requests
        self._record_of = tables.record_of
        self._episodes = tables.episodes
        self._supervisor = supervisor
        self._results = results
        self._waiting = waiting
        self._sums = tables.sums
        # The last request of each slot that was aborted while it was in flight.
        self._aborted: dict[int, int] = {}

    def drop(self, slots: NDArray[np.intp]) -> None:
        """Drop those results of `slots` that wait for the collector; errors that do so stay."""
        ready = self._requests.ready(slots)
        ready = ready[self._requests.owner[ready] == COLLECTOR]
        if len(ready):
            self._requests.drop(ready)
            self._results.drop(ready)
            self._sums.note_failures(ready, _WHY.kind)
        failed = self._requests.collector.free(slots.tolist())
        self._lose(np.concatenate((ready, failed)))

    def end(self, slots: NDArray[np.intp], now: float) -> Procedure[float]:
        """End the requests of `slots` that are outstanding; return the time after that.

        Results that are ready stay. If this is cancelled, the requests end all the same.
        """
        requests, slots = self._requests, self._requests.owed(slots)
        # Another call may be ending the rest; one that was cancelled belongs to nobody already.
        new = slots[np.array([self._is_wanted(slot) for slot in slots.tolist()], np.bool_)]
        wanted = new[requests.owner[new] != NOBODY]
        requests.abort(wanted, [self._fault(slot) for slot in wanted.tolist()])
        self._aborted.update(zip(new.tolist(), requests.numbering.entry[new].tolist(), strict=True))
        self._sums.note_failures(new, _WHY.kind)
        self._lose(new)
        self._supervisor.places.drop_unwanted(new)
        self._supervisor.detector.abort(new, now)
        self._waiting.poll()
        self._waiting.wake()  # Others may have waited for these, or without a look at the clock.
        chosen = set(slots.tolist())
        now = yield from self._waiting.until(now, lambda: len(requests.unwanted & chosen))
        return now

    def _is_wanted(self, slot: int) -> bool:
        """Return False if the request of `slot` was aborted before."""
        return self._aborted.get(slot) != self._requests.numbering.entry.item(slot)

    def _fault(self, slot: int) -> EpisodeLost:
        doing = Operation(self._requests.numbering.op(slot)).name.lower()
        env_id = self._envs.env_ids[slot]
        fault = EpisodeLost(
            f"the {doing} of {self._envs.describe(slot)} was aborted by the group's abort() or "
            "drain(), or by the end of its episode(); its episode is over: reset it to go on",
            env_id=env_id,
        )
        fault.outcome = _WHY.outcome(env_id)
        return fault

    def _lose(self, slots: NDArray[np.intp]) -> None:
        """Note that episodes are over; how one was lost before says more."""
        chosen: list[int] = slots.tolist()
        for slot in chosen:
            record = self._record_of(slot)
            if record.place is not None and not record.was_shown:
                continue  # It has no episode yet.
            known = self._episodes.why_lost(slot)
            self._episodes.lose([slot], _WHY if known is None else known)
        self._episodes.note_counted(chosen)
