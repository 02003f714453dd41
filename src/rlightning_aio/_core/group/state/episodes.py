"""`Episodes`: where each env is in its episode, and what its next result must report.

For every env it counts steps, up to the limits of `auto_reset`, and remembers whether the last
returned result ended the episode; these are arrays, updated when a batch is returned. For the few
envs that lost an episode it runs the transition table `LEGAL`. `seeds_for` reads the seeds of a
reset. Left out: hosts, time and I/O; callers say what was sent, answered and returned.
"""

from __future__ import annotations

import contextlib
import math
import operator
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np

from rlightning_aio._core.group.state.conditions import LOST_EPISODE, Conditions
from rlightning_aio.protocol.slab import IS_RESET, NO_SEED, OVER

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.outcomes import Loss

_NO_LIMIT: Final = 1 << 62


class LossPhase(Enum):
    """What the next result of an env must report about the episode before it."""

    INTACT = auto()
    """Nothing: the episode continues."""
    LOST = auto()
    """The episode is lost, and no request that reports it is in flight."""
    REPORTING = auto()
    """A request is in flight whose result begins a new episode and reports the loss."""


class LossEvent(Enum):
    """What can happen to an env that lost its episode."""

    EPISODE_LOST = auto()
    REPORT_SENT = auto()
    ANSWERED = auto()
    """A result has come: of an env that is LOST, that of a reset which the caller asked for."""
    RAISED = auto()


_INTACT, _LOST, _REPORTING = LossPhase

LEGAL: Final[dict[tuple[LossPhase, LossEvent], LossPhase]] = {
    (_LOST, LossEvent.REPORT_SENT): _REPORTING,
    **{(phase, LossEvent.EPISODE_LOST): _LOST for phase in LossPhase},
    **{(phase, LossEvent.ANSWERED): _INTACT for phase in (_LOST, _REPORTING)},
    **{(phase, LossEvent.RAISED): _LOST for phase in (_LOST, _REPORTING)},
}
"""The phase after each event. A pair that is missing is a bug, and raises."""


class Position(NamedTuple):
    """An env's place in its episode: steps since the reset, and if the step limit cut it there."""

    num_steps: int
    is_cut: bool


class Report(NamedTuple):
    """A loss that the result of a slot reports; `is_counted`: an error has told of it before."""

    slot: int
    why: Loss
    is_counted: bool


@dataclass(slots=True)
class _Loss:
    """The phase of one env that is not intact, and why its episode was lost.

    `is_counted`: it is among the failures already, by the error of a request.
    """

    phase: LossPhase
    why: Loss
    is_counted: bool = False


class Episodes:
    """See the module.

    Attributes:
        exceptional: some env is not intact, so requests and results must be checked for reports.
        due: by slot, whether the env is reset in place of its next step; all False while no
            context is open.
        auto_reset_is_open: an `auto_reset` context is open.
    """

    def __init__(self, envs: EnvTable, conditions: Conditions | None = None) -> None:
        self._envs = envs
        self._conditions = conditions or Conditions()
        self.due = np.zeros(len(envs), np.bool_)
        self._num_steps = np.zeros(len(envs), np.int64)
        # The last returned result reached the step limit; ended the episode by itself.
        self._cut = np.zeros(len(envs), np.bool_)
        self._ended = np.zeros(len(envs), np.bool_)
        self._limits: NDArray[np.int64] | None = None
        self._uses_own_limits = False
        self._resets_ended = True
        # No env can reach its limit within this number of batches.
        self._margin = 0
        self._losses: dict[int, _Loss] = {}
        # What results that are still to be returned show, by slot.
        self._restored: dict[int, Position] = {}
        self.exceptional = False
        self.auto_reset_is_open = False
        # Slots of places without a client: their losses set no condition of the group.
        self._empty: set[int] = set()

    # -- the context ------------------------------------------------------------------

    def begin(
        self, max_episode_steps: float | None, *, on_done: bool, needs_limits: bool = True
    ) -> None:
        """Open the `auto_reset` context; without `needs_limits`, envs may lack limits of their own.

        Raises:
            ValueError: the limit is neither a positive int nor `math.inf`, or is None and an env
                has none.
            RuntimeError: the context is open already.
        """
        if self.auto_reset_is_open:
            raise RuntimeError("auto_reset contexts don't nest; leave the open one first")
        self._limits = self._chosen_limits(max_episode_steps, needs_limits=needs_limits)
        self._uses_own_limits = max_episode_steps is None
        self._margin = 0
        self._resets_ended = on_done
        self.auto_reset_is_open = True
        self._update_due()

    def _chosen_limits(self, given: float | None, *, needs_limits: bool) -> NDArray[np.int64]:
        envs = self._envs
        if given is None:
            present = np.ones(len(envs), np.bool_)
            present[list(self._empty)] = False
            lacking = np.flatnonzero(present & (envs.step_limits == 0) & ~envs.resets_itself)
            if needs_limits and len(lacking):
                raise ValueError(
                    f"{envs.describe(int(lacking[0]))} has no step limit, neither a configured "
                    "max_episode_steps nor one of the simulator's own; configure one, pass "
                    "auto_reset(max_episode_steps=…), or auto_reset(math.inf) for no limit"
                )
            return self._own_limits(...)
        limit = _NO_LIMIT if given == math.inf else as_int(given)
        if limit is None or limit < 1:
            raise ValueError(
                f"max_episode_steps must be a positive int, or math.inf for no limit, not {given!r}"
            )
        configured = {config.max_episode_steps for config in envs.configs} - {None, limit}
        if configured:
            warnings.warn(
                f"auto_reset(max_episode_steps={given}) overrides the limits that are configured",
                stacklevel=5,
            )
        return np.full(len(envs), limit, np.int64)

    def _own_limits(self, slots: Any) -> Any:
        """Return each env's own limit. Envs that reset themselves keep their limits themselves,
        one sub-environment at a time.
        """
        limits = self._envs.step_limits[slots]
        return np.where((limits == 0) | self._envs.resets_itself[slots], _NO_LIMIT, limits)

    def end(self, *, forgets: bool = True) -> None:
        """Close the context: steps are plain again, and no env is due for a reset.

        Unless it `forgets` them, envs whose episodes are over are due again in the next context.
        """
        self._limits = None
        self.auto_reset_is_open = False
        self.due[:] = False
        if forgets:
            self._cut[:] = self._ended[:] = False

    @contextlib.contextmanager
    def resetting_ended(self) -> Generator[None]:
        """Reset envs at the ends of their episodes, too, whatever the open context does."""
        before, self._resets_ended = self._resets_ended, True
        self._update_due()
        try:
            yield
        finally:
            self._resets_ended = before
            if self.auto_reset_is_open:
                self._update_due()

    def _update_due(self) -> None:
        if self._resets_ended:
            np.logical_or(self._cut, self._ended, out=self.due)
        else:
            self.due[:] = self._cut

    def note_empty(self, slot: int) -> None:
        """Note that a place has no client: its loss concerns nobody until there is one."""
        self._empty.add(slot)
        self._note_losses()

    def note_taken(self, slot: int) -> None:
        """Note that a place has a client, and use the step limit of that."""
        self._empty.discard(slot)
        self._note_losses()
        if self._limits is not None and self._uses_own_limits:
            self._limits[slot] = self._own_limits(slot)
            self._margin = 0

    # -- requests ---------------------------------------------------------------------

    def report_losses(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Report lost episodes with the requests that are about to be sent to `slots`.

        Returns which requests must be resets that report a loss.
        """
        reports = np.zeros(len(slots), np.bool_)
        for k, slot in enumerate(slots.tolist()):
            loss = self._losses.get(slot)
            if loss is not None and loss.phase is LossPhase.LOST:
                reports[k] = True
                self._move(slot, LossEvent.REPORT_SENT)
        return reports

    def note_restores(self, slots: NDArray[np.intp], positions: Iterable[Position]) -> None:
        """Record that requests are about to be sent whose results show states at `positions`."""
        self._restored.update(zip(slots.tolist(), positions, strict=True))
        self._margin = 0

    # -- replies ----------------------------------------------------------------------

    def lose(self, slots: Iterable[int], why: Loss) -> None:
        """Record that the episodes of `slots` are lost; no request that reports it is in flight."""
        for slot in slots:
            self._move(slot, LossEvent.EPISODE_LOST, why)
            self._restored.pop(slot, None)

    def take_answers(self, slots: NDArray[np.intp]) -> list[Report]:
        """Record that results of `slots` arrived, and return the losses that they report.

        A restore has put a saved state in place of the episode, and reports nothing.
        """
        reports: list[Report] = []
        for slot in slots.tolist():
            loss = self._losses.get(slot)
            if loss is None:
                continue
            if slot not in self._restored:
                reports.append(Report(slot, loss.why, loss.is_counted))
            self._move(slot, LossEvent.ANSWERED)
        return reports

    def note_counted(self, slots: Iterable[int]) -> None:
        """Record that errors have ended requests of `slots`, which count what was lost, if any."""
        for slot in slots:
            if slot in self._losses:
                self._losses[slot].is_counted = True

    def ended_without_result(self, slot: int) -> Loss | None:
        """Record that the request of `slot` ended without a result; return the loss that it would
        have reported.
        """
        self._restored.pop(slot, None)
        loss = self._losses.get(slot)
        if loss is None:
            return None
        reports = loss.phase is LossPhase.REPORTING
        self._move(slot, LossEvent.RAISED)
        return loss.why if reports else None

    def _move(self, slot: int, event: LossEvent, why: Loss | None = None) -> None:
        """Apply an event of one slot by the table; `why` is given where the episode is lost."""
        loss = self._losses.get(slot)
        phase = LossPhase.INTACT if loss is None else loss.phase
        after = LEGAL.get((phase, event))
        if after is None:
            raise RuntimeError(f"slot {slot} is {phase.name}, where {event.name} can't happen")
        known = why if loss is None or why is not None else loss.why
        if known is None or after is LossPhase.INTACT:
            self._losses.pop(slot, None)
        else:
            self._losses[slot] = _Loss(after, known, loss is not None and loss.is_counted)
        self._note_losses()

    def _note_losses(self) -> None:
        self.exceptional = bool(self._losses)
        is_noticed = self.exceptional and not self._losses.keys() <= self._empty
        self._conditions.note(LOST_EPISODE, is_noticed)

    # -- results ----------------------------------------------------------------------

    def returned(
        self, slots: NDArray[np.intp], flagged: Sequence[ResultColumns]
    ) -> NDArray[np.bool_] | None:
        """Record that results are returned; return which the step limit cuts, or None for none.

        Args:
            slots: of all results, each once.
            flagged: the parts of the batch that have any flag set.
        """
        num_steps = self._num_steps[slots] + 1
        restored: list[int] = []
        for part in flagged:
            self._note_flags(part, slots, num_steps, restored)
        self._num_steps[slots] = num_steps
        is_cut = None
        if self._limits is not None:
            self._margin -= 1
            if self._margin <= 0:
                self._margin = int((self._limits - self._num_steps).min())
                is_cut = num_steps >= self._limits[slots]
                if restored:  # The limit was reported when the state was new.
                    is_cut &= ~np.isin(slots, restored)
                is_cut = is_cut if len(is_cut.nonzero()[0]) else None
        for slot in restored:
            self._cut[slot] = self._restored.pop(slot).is_cut and self.auto_reset_is_open
            self._margin = 0
        if is_cut is not None:
            self._cut[slots[is_cut]] = True
        if self.auto_reset_is_open and (flagged or is_cut is not None):
            self._update_due()
        return is_cut

    def _note_flags(
        self,
        part: ResultColumns,
        slots: NDArray[np.intp],
        num_steps: NDArray[np.int64],
        restored: list[int],
    ) -> None:
        """Note which episodes of `part` have ended, and restart the counts of those that begin.

        An env that resets itself needs no request for that: its next episode must not be cut for
        the steps of the one that ends here.
        """
        flags = part.flags
        begins = resets = flags[:, IS_RESET] if flags.ndim == 2 else _all_reset(part)
        ended = flags[:, OVER] if flags.ndim == 2 else part.over
        if self._envs.any_resets_itself:
            resets_itself = self._envs.resets_itself[part.slots]
            begins = resets | (ended & resets_itself)
            ended = ended & ~resets_itself
        places = begins.nonzero()[0]
        if part.positions is not None:
            places = part.positions[places]
        num_steps[places] = 0
        if self._restored:
            for place in places.tolist():
                position = self._restored.get(slots.item(place))
                if position is not None:
                    num_steps[place] = position.num_steps
                    restored.append(slots.item(place))
        begun = part.slots[resets]
        self._cut[begun] = self._ended[begun] = False
        self._ended[part.slots[ended]] = True

    def positions(self, slots: NDArray[np.intp]) -> list[Position]:
        """Return the positions at the last results of `slots`."""
        steps, cut = self._num_steps[slots].tolist(), self._cut[slots].tolist()
        return [Position(*each) for each in zip(steps, cut, strict=True)]

    def why_lost(self, slot: int) -> Loss | None:
        """Return why an env lost its episode; None if it has not."""
        loss = self._losses.get(slot)
        return None if loss is None else loss.why


def _all_reset(part: ResultColumns) -> NDArray[np.bool_]:
    """Return which envs were reset, with all of their sub-environments."""
    resets = part.is_reset
    return resets if resets.ndim == 1 else np.logical_and.reduce(resets, 1)


def as_int(value: Any) -> int | None:
    """Return `value` as an int, NumPy's included; None if it is no whole number, or a bool."""
    if isinstance(value, bool):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None


Seeds: TypeAlias = "int | Sequence[int] | Mapping[str, int] | None"


def seeds_for(envs: EnvTable, seed: Seeds, slots: NDArray[np.intp]) -> NDArray[np.int64]:
    """The seed of each slot, ``[n]``; `NO_SEED` for none.

    From an int, sub-environment k of the group gets ``seed + k``.

    Raises:
        ValueError: a seed is out of range, or of an env that is not being reset, or there isn't one
            for each slot.
    """
    if seed is None:
        return np.full(len(slots), NO_SEED)
    if isinstance(seed, Mapping):
        given = {envs.find_one(env_id): checked_seed(one) for env_id, one in seed.items()}
        chosen = [given.pop(slot, NO_SEED) for slot in slots.tolist()]
        if given:
            names = ", ".join(repr(envs.env_ids[slot]) for slot in given)
            raise ValueError(
                f"there are seeds for {names}, which this call doesn't reset; leave them out, or "
                "name these envs in env_ids, too"
            )
    elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
        if len(seed) != len(slots):
            raise ValueError(f"{len(seed)} seeds for {len(slots)} envs; give one for each")
        chosen = [checked_seed(one) for one in seed]
    else:
        return envs.seed_offset[slots] + checked_seed(seed)
    return np.array(chosen, np.int64)


def checked_seed(seed: Any, whose: str = "") -> int:
    """`seed` as an int, small enough that adding an offset can't overflow an int64.

    Raises:
        ValueError: it isn't an int from 0 to 2**62 - 1; `whose` ends its name in the message.
    """
    value = as_int(seed)
    if value is None or not 0 <= value < 1 << 62:
        raise ValueError(f"the seed{whose} must be an int from 0 to 2**62 - 1, not {seed!r}")
    return value
