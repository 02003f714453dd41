"""Episode continuity: its transition table, and losses step by step."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rlightning_aio._core.group.episodes.continuity import (
    LEGAL,
    Continuity,
    LossEvent,
    LossPhase,
    Position,
    Report,
)
from rlightning_aio._core.group.state.env_table import EnvTable
from rlightning_aio.config import EnvConfig
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.slab import IS_RESET, OVER

if TYPE_CHECKING:
    from collections.abc import Callable

SLOT = np.array([0])


def new_continuity(size: int = 1) -> Continuity:
    config = EnvConfig(name="e", backend="gymnasium", task="x")
    return Continuity(EnvTable([config] * size, [f"e-{k}" for k in range(size)]))


def part_of(slots: Any, is_reset: Any, over: Any) -> Any:
    """Return the columns of a part of a batch that continuity reads."""
    flags = np.zeros((len(slots), 4), np.bool_)
    flags[:, IS_RESET], flags[:, OVER] = is_reset, over
    return SimpleNamespace(slots=np.array(slots), flags=flags, positions=None)


KILLED = Loss("was killed", "env_died", "env", "env-1")
AGAIN = Loss("was killed again", "env_died", "env")
EVENTS: dict[LossEvent, Callable[[Continuity], object]] = {
    LossEvent.EPISODE_LOST: lambda c: c.lose([0], KILLED),
    LossEvent.REPORT_SENT: lambda c: c.report_losses(SLOT),
    LossEvent.ANSWERED: lambda c: c.take_answers(SLOT),
    LossEvent.RAISED: lambda c: c.ended_without_result(0),
    LossEvent.GIVEN_UP: lambda c: c.give_up([0]),
}
"""A call that makes each event happen to slot 0."""


def in_phase(phase: LossPhase) -> Continuity:
    """Drive slot 0 into a phase by public methods."""
    continuity = new_continuity()
    if phase is not LossPhase.INTACT:
        EVENTS[LossEvent.EPISODE_LOST](continuity)
    if phase is LossPhase.REPORTING:
        EVENTS[LossEvent.REPORT_SENT](continuity)
    return continuity


def phase_of(continuity: Continuity) -> LossPhase:
    loss = continuity._losses.get(0)
    return LossPhase.INTACT if loss is None else loss.phase


@pytest.mark.parametrize(("phase", "event"), LEGAL)
def test_each_transition_of_the_table_happens(phase: LossPhase, event: LossEvent) -> None:
    """Through public methods; `exceptional` is True while an env is not intact."""
    continuity = in_phase(phase)
    assert phase_of(continuity) is phase
    if event is LossEvent.GIVEN_UP and phase is LossPhase.INTACT:
        assert LEGAL[phase, event] is LossPhase.INTACT
    EVENTS[event](continuity)
    assert phase_of(continuity) is LEGAL[phase, event]
    assert continuity.exceptional == (LEGAL[phase, event] is not LossPhase.INTACT)


@pytest.mark.parametrize(
    ("phase", "event"),
    [pair for pair in itertools.product(LossPhase, LossEvent) if pair not in LEGAL],
)
def test_every_other_event_is_refused(phase: LossPhase, event: LossEvent) -> None:
    """A pair that is not in the table raises and changes nothing."""
    continuity = in_phase(phase)
    with pytest.raises(RuntimeError, match=f"is {phase.name}, where {event.name} can't happen"):
        continuity._move(0, event)
    assert phase_of(continuity) is phase


def test_an_env_that_shows_a_saved_state_is_at_its_place_in_the_episode() -> None:
    """Steps count from there; a limit that was reached there is reported no second time."""
    continuity = new_continuity()
    continuity.begin(3, on_done=True)
    continuity.note_restores(SLOT, [Position(3, is_cut=True)])
    shown = part_of([0], [True], [False])
    assert continuity.returned(SLOT, [shown]) is None
    assert continuity.positions(SLOT) == [Position(3, is_cut=True)]
    assert continuity.due.tolist() == [True]


@pytest.mark.parametrize("lose", [True, False])
def test_a_state_that_could_not_be_shown_does_not_count(lose: bool) -> None:
    """The reset after that begins at 0."""
    continuity = new_continuity()
    continuity.note_restores(SLOT, [Position(3, is_cut=False)])
    if lose:
        continuity.lose([0], KILLED)
    else:
        continuity.ended_without_result(0)
    first = part_of([0], [True], [False])
    continuity.returned(SLOT, [first])
    assert continuity.positions(SLOT) == [Position(0, is_cut=False)]


def test_a_reset_that_the_caller_asked_for_makes_a_loss_moot() -> None:
    continuity = in_phase(LossPhase.LOST)
    assert continuity.take_answers(SLOT) == []
    assert not continuity.exceptional


def test_the_last_of_several_losses_is_reported() -> None:
    continuity = in_phase(LossPhase.REPORTING)
    continuity.lose([0], AGAIN)
    assert continuity.report_losses(SLOT).tolist() == [True]
    assert continuity.take_answers(SLOT) == [Report(0, AGAIN)]
