"""Episode continuity: its transition table, and losses and checkpoints step by step."""

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
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.slab import AS_RESTORED, IS_RESET, NO_SEED, OVER

if TYPE_CHECKING:
    from collections.abc import Callable

SLOT = np.array([0])
STEP = np.array([True])


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
    LossEvent.EPISODE_LOST: lambda c: c.lose([0], KILLED, from_checkpoint=True),
    LossEvent.REPORT_SENT: lambda c: c.report_losses(SLOT, ~STEP),
    LossEvent.RESUME_SENT: lambda c: c.report_losses(SLOT, STEP),
    LossEvent.RESET_SENT: lambda c: c.note_resets([0]),
    LossEvent.SHOW_SENT: lambda c: c.note_shows([0], [Position(3, is_cut=False)]),
    LossEvent.ANSWERED: lambda c: c.take_answers(SLOT),
    LossEvent.RAISED: lambda c: c.ended_without_result(0),
    LossEvent.GIVEN_UP: lambda c: c.give_up([0]),
}
"""A call that makes each event happen to slot 0, which has a checkpoint."""


def in_phase(phase: LossPhase) -> Continuity:
    """Drive slot 0 into a phase by public methods."""
    continuity = new_continuity()
    continuity.save(0, b"state", 1, before=True, is_step=True)
    if phase not in (LossPhase.INTACT, LossPhase.SHOWING):
        EVENTS[LossEvent.EPISODE_LOST](continuity)
    by_event = {
        LossPhase.REPORTING: LossEvent.REPORT_SENT,
        LossPhase.RESUMING: LossEvent.RESUME_SENT,
        LossPhase.RESETTING: LossEvent.RESET_SENT,
        LossPhase.SHOWING: LossEvent.SHOW_SENT,
    }
    if phase in by_event:
        EVENTS[by_event[phase]](continuity)
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


def test_a_lost_episode_resumes_from_its_last_valid_checkpoint() -> None:
    """A checkpoint of an unanswered request doesn't count; the report has what was lost."""
    continuity = new_continuity()
    for number in range(1, 6):
        if number == 3:
            continuity.save(0, b"third", number, before=False, is_step=True)
        continuity.returned(SLOT, (), continuity.judge(SLOT, ()))
    continuity.save(0, b"sixth", 6, before=False, is_step=True)
    continuity.drop_unfinished([0], {6})
    continuity.lose([0], KILLED, from_checkpoint=True)
    assert continuity.checkpoints([0]) == (b"third",)
    reports, seeds = continuity.report_losses(SLOT, STEP)
    assert (reports.tolist(), seeds.tolist()) == ([True], [AS_RESTORED])
    assert continuity.take_answers(SLOT) == [Report(0, KILLED, 2)]
    shown = part_of([0], [True], [False])
    continuity.returned(SLOT, [shown], continuity.judge(SLOT, [shown]))
    assert continuity.positions(SLOT) == [Position(3, is_cut=False)]


def test_an_env_that_is_being_reset_or_due_does_not_resume() -> None:
    """It begins a new episode, although it has a checkpoint."""
    continuity = in_phase(LossPhase.LOST)
    reports, seeds = continuity.report_losses(SLOT, ~STEP)
    assert (reports.tolist(), seeds.tolist()) == ([True], [NO_SEED])
    assert continuity.take_answers(SLOT) == [Report(0, KILLED, None)]


def test_an_env_that_dies_while_it_resumes_resumes_again() -> None:
    """Although its request is a reset by then."""
    continuity = in_phase(LossPhase.RESUMING)
    continuity.lose([0], AGAIN, from_checkpoint=True)
    _, seeds = continuity.report_losses(SLOT, ~STEP)
    assert seeds.tolist() == [AS_RESTORED]
    assert continuity.take_answers(SLOT) == [Report(0, AGAIN, 0)]


def test_the_steps_before_a_restore_are_not_lost_by_a_death_after_it() -> None:
    """An env that dies before it has shown a restored state is back in that state."""
    continuity = new_continuity()
    for number in range(3):
        continuity.save(0, b"a step", number, before=False, is_step=True)
        continuity.returned(SLOT, (), continuity.judge(SLOT, ()))
    continuity.save(0, b"restored", 4, before=False, is_step=False)
    continuity.note_shows([0], [Position(1, is_cut=False)])
    continuity.lose([0], KILLED, from_checkpoint=True)
    assert continuity.checkpoints([0]) == (b"restored",)
    continuity.report_losses(SLOT, ~STEP)
    assert continuity.take_answers(SLOT) == [Report(0, KILLED, 0)]


def test_an_env_that_is_put_back_after_a_death_knows_how_many_steps_it_has_lost() -> None:
    """It is put back to its checkpoint, whatever the caller has seen."""
    continuity = new_continuity()
    continuity.save(0, b"a reset", 1, before=True, is_step=False)
    for _ in range(3):
        continuity.returned(SLOT, (), continuity.judge(SLOT, ()))
    continuity.lose([0], KILLED, from_checkpoint=True)
    continuity.save(0, b"put back", 2, before=True, is_step=False)
    assert continuity.positions(SLOT) == [Position(0, is_cut=False)]


@pytest.mark.parametrize("shown", [LossPhase.SHOWING, LossPhase.RESUMING])
def test_the_steps_of_an_episode_that_could_not_be_shown_do_not_count(shown: LossPhase) -> None:
    """The reset after that begins at 0, whatever position was to be shown."""
    continuity = in_phase(shown)
    continuity.ended_without_result(0)
    continuity.note_resets([0])
    assert continuity.take_answers(SLOT) == []
    first = part_of([0], [True], [False])
    continuity.returned(SLOT, [first], continuity.judge(SLOT, [first]))
    assert continuity.positions(SLOT) == [Position(0, is_cut=False)]


def test_an_env_that_was_not_built_anew_does_not_resume() -> None:
    """It has no state of its checkpoint that it could show."""
    continuity = in_phase(LossPhase.INTACT)
    continuity.lose([0], KILLED)
    _, seeds = continuity.report_losses(SLOT, STEP)
    assert seeds.tolist() == [NO_SEED]


def test_an_env_that_was_not_built_anew_saves_nothing_before_its_reset() -> None:
    """Its state is not that of the episode whose steps are known."""
    continuity = in_phase(LossPhase.INTACT)
    continuity.lose([0], KILLED)
    assert continuity.why_lost(0, unless_saved=True) == KILLED
    continuity.report_losses(SLOT, STEP)
    continuity.save(0, b"somewhere", 2, before=True, is_step=False)
    assert continuity.checkpoints([0]) == (None,)


def test_a_restore_that_was_given_up_leaves_no_checkpoint() -> None:
    """Also if a reset is answered after it."""
    continuity = in_phase(LossPhase.INTACT)
    continuity.save(0, b"elsewhere", entry(2, 0, Operation.RESTORE), before=False, is_step=False)
    continuity.lose([0], KILLED)
    continuity.report_losses(SLOT, STEP)
    reset = entry(3, 0, Operation.RESET)
    continuity.save(0, b"a reset", reset, before=False, is_step=False)
    continuity.drop_unfinished([0], {reset})
    assert continuity.checkpoints([0]) == (None,)


@pytest.mark.parametrize("phase", [LossPhase.SHOWING, LossPhase.RESUMING, LossPhase.RESETTING])
def test_a_death_resumes_no_episode_whose_request_has_raised(phase: LossPhase) -> None:
    """Its next step begins a new one, as without the death."""
    continuity = in_phase(phase)
    continuity.ended_without_result(0)
    continuity.lose([0], AGAIN, from_checkpoint=True)
    _, seeds = continuity.report_losses(SLOT, STEP)
    assert seeds.tolist() == [NO_SEED]
