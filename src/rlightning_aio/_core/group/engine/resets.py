"""`Resets`: begins episodes, of envs that a caller names, or of all that are there.

It gives resets to their envs and waits for the replies; the core returns the results. Envs that
join by themselves may be waited for, and their first results count as those of a reset.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio._core.group.drivers.wait import Procedure, Wait
from rlightning_aio._core.group.episodes.seeds import checked_seed, seeds_for
from rlightning_aio._core.group.state.request_states import COLLECTOR
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.slab import AS_BEFORE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.dispatch import Dispatch
    from rlightning_aio._core.group.engine.results import Results
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.episodes.seeds import Seeds
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.base import Membership

__all__ = ["Resets"]


class Resets:
    """See the module; the arguments are the group's parts."""

    def __init__(
        self,
        tables: Tables,
        supervisor: Supervisor,
        dispatch: Dispatch,
        results: Results,
        waiting: Waiting,
    ) -> None:
        self._envs = tables.envs
        self._requests = tables.requests
        self._layout = tables.layout
        self._episodes = tables.episodes
        self._supervisor = supervisor
        self._members = supervisor.members
        self._dispatch = dispatch
        self._results = results
        self._intake = waiting.intake
        self._waiting = waiting

    def reset(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> Procedure[tuple[Ticket, NDArray[np.intp]]]:
        """Reset envs, and wait for all of them; return the ticket and the slots."""
        if env_ids is None and self._members.possible:
            now = yield from self._await_members(now)
        slots = self._members.everyone() if env_ids is None else self._dispatch.distinct(env_ids)
        return (yield from self._reset(now, seed, options, slots))

    def prepared(
        self, now: float, seed: Seeds, options: dict[str, Any] | None, env_ids: Sequence[str]
    ) -> tuple[NDArray[np.intp], Callable[[Ticket], None]]:
        """Check resets; return the slots, and what sends the resets for a ticket."""
        slots = self._dispatch.distinct(env_ids)
        return slots, self._prepared(now, seed, options, slots)

    def reset_members(
        self,
        now: float,
        server: Membership,
        seed: int | None,
        options: dict[str, Any] | None,
    ) -> Procedure[tuple[Ticket, NDArray[np.intp]]]:
        """Reset all envs that have joined a host, and wait for them."""
        now = yield from self._await_members(now)
        slots = np.array(server.member_indices(), np.intp) + server.first_slot
        seeds = None
        if seed is not None:
            self._members.rank()
            offsets = self._envs.seed_offset[slots]
            seeds = (checked_seed(seed) + offsets - offsets[:1]).tolist()
        return (yield from self._reset(now, seeds, options, slots))

    def reset_async(
        self,
        now: float,
        seed: Seeds,
        options: dict[str, Any] | None,
        env_ids: Sequence[str] | None,
    ) -> None:
        """Send resets, whose results the collector gets."""
        slots = self._members.everyone() if env_ids is None else self._dispatch.distinct(env_ids)
        seeds = self._seeds_for(slots, seed, now)
        self._dispatch.check_sendable(now, slots, "reset")
        packed = self._packed_resets(slots, seeds, options)
        self._send(slots, seeds, options, packed, COLLECTOR, now)

    def _await_members(self, now: float) -> Procedure[float]:
        """Wait until each host that envs join has enough."""
        began = now
        while (missing := self._members.missing(now - began)) is not None:
            now = yield Wait(self._supervisor.next_check(began + missing))
            self._waiting.check(now)
        return now

    def _reset(
        self, now: float, seed: Seeds, options: dict[str, Any] | None, slots: NDArray[np.intp]
    ) -> Procedure[tuple[Ticket, NDArray[np.intp]]]:
        send = self._prepared(now, seed, options, slots)
        ticket, _ = yield from self._waiting.ask(now, slots, send)
        return ticket, slots

    def _prepared(
        self, now: float, seed: Seeds, options: dict[str, Any] | None, slots: NDArray[np.intp]
    ) -> Callable[[Ticket], None]:
        seeds = self._seeds_for(slots, seed, now)
        joined = self._requests.joined(slots)
        self._dispatch.check_sendable(now, slots[~joined], "reset")
        packed = self._packed_resets(slots, seeds, options)

        def send(ticket: Ticket) -> None:
            asked, own_seeds = slots, seeds
            if joined.any():
                enough = seed is None and options is None
                self._take_first_results(slots[joined], ticket, enough=enough)
                if enough:
                    asked, own_seeds = slots[~joined], seeds[~joined]
            self._send(asked, own_seeds, options, packed, ticket.owner, now)

        return send

    def _seeds_for(self, slots: NDArray[np.intp], seed: Seeds, now: float) -> NDArray[np.int64]:
        """Apply completions, and return the seeds of resets that are about to be sent."""
        self._intake.now = now
        self._intake.apply_completions()
        if self._members.possible:
            self._members.rank()
        return seeds_for(self._envs, seed, slots)

    def _packed_resets(
        self, slots: NDArray[np.intp], seeds: NDArray[np.int64], options: dict[str, Any] | None
    ) -> list[Any] | None:
        return None if options is None else self._dispatch.packed_resets(slots, seeds, options)

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
            self._submit_resets(slots[lost], as_before, None, owner, now)
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
        self._dispatch.hand_over(slots, entries, packed)

    def _take_first_results(self, slots: NDArray[np.intp], ticket: Ticket, *, enough: bool) -> None:
        """Use the first results of envs that have just joined for a reset.

        An env that joins has been reset. That is `enough` unless the reset has a seed or options,
        so a robot that takes minutes to reset isn't reset twice.
        """
        if enough:
            self._requests.claim(slots, ticket)
            return
        self._requests.drop(slots)
        for slot in slots.tolist():
            self._results.drop(slot)
