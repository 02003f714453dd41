"""`Resets`: begins episodes, of envs that a caller names, or of all that are there.

It gives resets to their envs and waits for the replies; the core returns the results. A reset of
all envs waits until every place of an env_server has a client.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio._core.group.drivers.wait import Procedure, Wait
from rlightning_aio._core.group.state.episodes import seeds_for
from rlightning_aio._core.group.state.request_states import COLLECTOR
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.slab import AS_BEFORE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.results import Results
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.state.episodes import Seeds
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables


class Resets:
    """See the module; the arguments are the group's parts."""

    def __init__(
        self,
        tables: Tables,
        supervisor: Supervisor,
        results: Results,
        waiting: Waiting,
    ) -> None:
        self._envs = tables.envs
        self._record_of = tables.record_of
        self._requests = tables.requests
        self._layout = tables.layout
        self._episodes = tables.episodes
        self._supervisor = supervisor
        self._places = supervisor.places
        self._results = results
        self._waiting = waiting

    def reset(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> Procedure[tuple[Ticket, NDArray[np.intp]]]:
        """Reset envs, and wait for all of them; return the ticket and the slots."""
        if env_ids is None and self._places.servers:
            now = yield from self._await_clients(now)
        slots, send = self.prepared(now, seed, options, env_ids)
        ticket, _ = yield from self._waiting.ask(now, slots, send)
        return ticket, slots

    def check(self, seed: Seeds, options: dict[str, Any] | None) -> None:
        """Raise an error if the arguments of a reset of all envs are wrong."""
        seeds = seeds_for(self._envs, seed, self._envs.all)
        self._packed_resets(self._envs.all, seeds, options)

    def prepared(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> tuple[NDArray[np.intp], Callable[[Ticket | None], None]]:
        """Check resets; return the slots, and what sends the resets.

        That is given the ticket that they are for; None: the collector gets their results.
        """
        slots = self._envs.chosen(env_ids)
        seeds = seeds_for(self._envs, seed, slots)
        self._waiting.check_sendable(now, slots, "reset")
        packed = self._packed_resets(slots, seeds, options)

        def send(ticket: Ticket | None) -> None:
            owner = COLLECTOR if ticket is None else ticket.owner
            self._send(slots, seeds, options, packed, owner, now)

        return slots, send

    def _await_clients(self, now: float) -> Procedure[float]:
        """Wait until every place has a client."""
        began = now
        while empty := self._places.empty():
            late, due = self._places.late(empty, began, now)
            if late:
                raise self._places.away(late)
            now = yield Wait(self._supervisor.next_check(due))
            self._waiting.check(now)
        return now

    def _packed_resets(
        self, slots: NDArray[np.intp], seeds: NDArray[np.int64], options: dict[str, Any] | None
    ) -> list[Any] | None:
        """Check resets; return for each what it is sent with, None if that is the seed in its row.

        A place has its arguments with it: it may have no row yet.
        """
        num_local = self._envs.num_local
        if options is None and not (slots.size and int(slots.max()) >= num_local):
            return None
        if options is not None and not isinstance(cast("object", options), Mapping):
            raise TypeError(
                f"options must be a dict, which each env gets, not a {type(options).__name__}; for "
                "options of its own, reset an env by itself: reset(options={…}, env_ids=[env_id])"
            )
        packed: list[Any] = []
        for slot, seed in zip(slots.tolist(), seeds.tolist(), strict=True):
            given = (None if seed < 0 else seed, options)
            place = self._record_of(slot).place
            try:
                if place is not None:
                    place.check_reset(*given)
            except ValueError as error:
                raise TypeError(f"{error}; nothing was sent") from error
            is_in_row = options is None and place is None
            packed.append(
                None if is_in_row else self._supervisor.packed(slot, given, "the options")
            )
        return packed

    def _send(
        self,
        slots: NDArray[np.intp],
        seeds: NDArray[np.int64],
        options: dict[str, Any] | None,
        packed: list[Any] | None,
        owner: int,
        now: float,
    ) -> None:
        """Send resets.

        A mask resets a part of an env, so it can't make up for a lost episode: such an env is
        reset as a whole, and its result reports the loss.
        """
        if packed and "reset_mask" in (options or {}) and self._episodes.exceptional:
            lost = self._episodes.report_losses(slots)
            as_before = np.full(np.count_nonzero(lost), AS_BEFORE)
            whole = self._packed_resets(slots[lost], as_before, None)
            self._submit_resets(slots[lost], as_before, whole, owner, now)
            slots, seeds = slots[~lost], seeds[~lost]
            packed = [one for one, gone in zip(packed, lost.tolist(), strict=True) if not gone]
        self._submit_resets(slots, seeds, packed, owner, now)

    def _submit_resets(
        self,
        slots: NDArray[np.intp],
        seeds: NDArray[np.int64],
        packed: list[Any] | None,
        owner: int,
        now: float,
    ) -> None:
        entries = self._requests.issue(slots, Operation.RESET, owner, now)
        self._results.note_unasked(slots)
        if packed is None:
            self._layout.write_seeds(slots, seeds)
            self._supervisor.hand_over(slots, entries)
            return
        in_row = np.array([one is None for one in packed], np.bool_)
        self._layout.write_seeds(slots[in_row], seeds[in_row])
        self._supervisor.hand_over(slots[in_row], entries[in_row])
        given = [one for one in packed if one is not None]
        self._supervisor.hand_over(slots[~in_row], entries[~in_row], given)
