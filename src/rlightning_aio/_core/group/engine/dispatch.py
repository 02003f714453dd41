"""`Dispatch`: checks requests, packs their arguments, and gives them to hosts.

Rule: all or nothing. All checks are done and all arguments packed before the first request is sent.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from rlightning_aio._core.group.state.request_states import COLLECTOR, NOBODY, State
from rlightning_aio.errors import BadAction, EnvBusy
from rlightning_aio.protocol.slab import NO_SEED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.actions import OutOfBandSteps
    from rlightning_aio._core.group.engine.waiting import Poller, Waiting
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables

Packed: TypeAlias = "tuple[NDArray[np.intp], list[Any]]"
"""Positions in a batch of steps, and for each the packed arguments that go out of band."""


class Dispatch:
    """The outgoing side of a group."""

    def __init__(
        self, tables: Tables, supervisor: Supervisor, poller: Poller, waiting: Waiting
    ) -> None:
        self._envs = tables.envs
        self._requests = tables.requests
        self._record_of = tables.record_of
        self._lifetime = tables.lifetime
        self._supervisor = supervisor
        self._poller = poller
        self._intake = waiting.intake
        self._waiting = waiting
        self._driver = tables.driver

    def distinct(self, env_ids: Sequence[str]) -> NDArray[np.intp]:
        """The slots of `env_ids`; `EnvBusy` if an id appears twice."""
        slots = self._envs.find(env_ids)
        if slots is not self._envs.all and len(set(env_ids)) < len(slots):
            double = next(id_ for k, id_ in enumerate(env_ids) if id_ in env_ids[:k])
            raise EnvBusy(f"{double!r} appears twice in one call; nothing was sent")
        return slots

    def check_sendable(self, now: float, slots: NDArray[np.intp], what: str) -> None:
        """Raise an error if the group is closed, or an env of `slots` is busy or gone.

        What was cancelled or aborted and still runs in an env is ended before, inline by executing
        it.
        """
        self._lifetime.check_open()
        while (slot := self._requests.first_not_idle(slots)) is not None:
            if self._requests.owner[slot] != NOBODY or not self._end_call(now, slot):
                break
        if slot is not None:
            raise EnvBusy(
                f"can't {what} {self._envs.describe(slot)}: {self._why_busy(slot)}; nothing was "
                "sent"
            )
        # Last: the error of a worker that is gone may still have to be collected.
        self._supervisor.check_usable(slots)

    def _why_busy(self, slot: int) -> str:
        state, owner = self._requests.state.item(slot), self._requests.owner.item(slot)
        if owner == NOBODY:
            return "what was cancelled or aborted still runs in it; try again when that has ended"
        why = {
            State.BUSY: "its last request has not replied yet",
            State.READY: "the result of its last request was not collected",
            State.SPENT: "its last request ended in an error that was not collected",
        }[State(state)]
        if owner == COLLECTOR:
            others = self._driver.others()
            return f"{why}{others}; collect it first, with collect_async(), or end it with drain()"
        if state != State.BUSY:
            why = "the call that asked it has not returned yet"
        return f"{why}{self._driver.others()}; wait for that call first"

    def _end_call(self, now: float, slot: int) -> bool:
        """Note the end of a request of nobody that has ended since the group last waited.

        In this process, it is executed now, after the requests that were sent before it. Returns
        False if it has not ended.
        """
        self._driver.read()
        self._intake.apply_completions()
        while not self._requests.is_idle(slot) and self._poller.execute(1, None):
            self._intake.apply_completions()
        if not self._requests.is_idle(slot):  # Perhaps nobody waits who would replace its worker.
            self._waiting.check(now)
        return self._requests.is_idle(slot)

    def check_local(self, slots: NDArray[np.intp], what: str) -> None:
        """Raise `NotImplementedError` if any of `slots` belongs to a client."""
        if (remote := slots[slots >= self._envs.num_local]).size:
            raise NotImplementedError(
                f"can't {what} {self._envs.describe(int(remote[0]))}: clients answer resets and "
                "steps only; nothing was sent"
            )

    def packed_steps(self, slots: NDArray[np.intp], out_of_band: OutOfBandSteps) -> Packed:
        """Pack the arguments of steps that go out of band."""
        chosen = slots[out_of_band.positions].tolist()
        try:
            for slot, (action, extras) in zip(chosen, out_of_band.contents, strict=True):
                place = self._record_of(slot).place
                if place is not None:
                    place.check_step(action, extras)
            return out_of_band.positions, [
                self.packed(slot, content, "the response")
                for slot, content in zip(chosen, out_of_band.contents, strict=True)
            ]
        except TypeError as error:
            raise BadAction(str(error)) from error

    def packed_resets(
        self, slots: NDArray[np.intp], seeds: NDArray[np.int64], options: dict[str, Any]
    ) -> list[Any]:
        if not isinstance(cast("object", options), Mapping):
            raise TypeError(
                f"options must be a dict, which each env gets, not a {type(options).__name__}; for "
                "options of its own, reset an env by itself: reset(options={…}, env_ids=[env_id])"
            )
        packed: list[Any] = []
        for slot, seed in zip(slots.tolist(), seeds.tolist(), strict=True):
            given = (None if seed == NO_SEED else seed, options)
            self._check_reset(slot, *given)
            packed.append(self.packed(slot, given, "the options"))
        return packed

    def resets_of_places(
        self, slots: NDArray[np.intp], seeds: NDArray[np.int64], options: dict[str, Any] | None
    ) -> list[Any]:
        """Return what resets of places are sent with, which is never in a row."""
        found: list[Any] = []
        for slot, seed in zip(slots.tolist(), seeds.tolist(), strict=True):
            given = (None if seed < 0 else seed, options)
            self._check_reset(slot, *given)
            found.append(given)
        return found

    def _check_reset(self, slot: int, seed: int | None, options: dict[str, Any] | None) -> None:
        place = self._record_of(slot).place
        if place is None:
            return
        try:
            place.check_reset(seed, options)
        except ValueError as error:
            raise TypeError(f"{error}; nothing was sent") from error

    def packed(self, slot: int, arguments: Any, what: str) -> Any:
        try:
            return self._record_of(slot).host.packed(arguments)
        except Exception as error:
            raise TypeError(
                f"{what} for {self._envs.describe(slot)} can't be sent to its worker: {error}; "
                "nothing was sent"
            ) from error

    def hand_over(
        self,
        slots: NDArray[np.intp],
        entries: NDArray[np.int64],
        arguments: Sequence[Any] | None = None,
    ) -> None:
        """Give issued requests to their hosts, one call per run of slots of the same host."""
        for host_id, part in self._requests.put_in_flight(slots):
            given = None if arguments is None else arguments[part]
            self._supervisor.submit(host_id, entries[part], given)

    def hand_over_steps(
        self,
        slots: NDArray[np.intp],
        entries: NDArray[np.int64],
        packed: Packed,
        resets: NDArray[np.bool_],
    ) -> None:
        """Give issued steps to their hosts; without their arguments where they became resets."""
        positions, arguments = packed
        out_of_band = np.zeros(len(slots), np.bool_)
        out_of_band[positions] = True
        out_of_band &= ~resets
        self.hand_over(slots[~out_of_band], entries[~out_of_band])
        kept = out_of_band[positions]
        chosen = positions[kept]
        arguments = [one for one, keep in zip(arguments, kept.tolist(), strict=True) if keep]
        self.hand_over(slots[chosen], entries[chosen], arguments)
