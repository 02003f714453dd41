"""Episode episodes: its transition table, and losses step by step."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rlightning_aio._core.group.state.env_table import EnvTable
from rlightning_aio._core.group.state.episodes import (
    LEGAL,
    Episodes,
    LossEvent,
    LossPhase,
    Position,
    Report,
)
from rlightning_aio.config import EnvConfig
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.slab import IS_RESET, OVER

if TYPE_CHECKING:
    from collections.abc import Callable

SLOT = np.array([0])


def new_episodes(size: int = 1) -> Episodes:
    config = EnvConfig(name="e", backend="gymnasium", task="x")
    return Episodes(EnvTable([config] * size, [f"e-{k}" for k in range(size)]))


def part_of(slots: Any, is_reset: Any, over: Any) -> Any:
    """Return the columns of a part of a batch that episodes reads."""
    flags = np.zeros((len(slots), 4), np.bool_)
    flags[:, IS_RESET], flags[:, OVER] = is_reset, over
    return SimpleNamespace(slots=np.array(slots), flags=flags, positions=None)


KILLED = Loss("was killed", "env_died", "env", "env-1")
AGAIN = Loss("was killed again", "env_died", "env")
EVENTS: dict[LossEvent, Callable[[Episodes], object]] = {
    LossEvent.EPISODE_LOST: lambda c: c.lose([0], KILLED),
    LossEvent.REPORT_SENT: lambda c: c.report_losses(SLOT),
    LossEvent.ANSWERED: lambda c: c.take_answers(SLOT),
    LossEvent.RAISED: lambda c: c.ended_without_result(0),
    LossEvent.GIVEN_UP: lambda c: c.give_up([0]),
}
"""A call that makes each event happen to slot 0."""


def in_phase(phase: LossPhase) -> Episodes:
    """Drive slot 0 into a phase by public methods."""
    episodes = new_episodes()
    if phase is not LossPhase.INTACT:
        EVENTS[LossEvent.EPISODE_LOST](episodes)
    if phase is LossPhase.REPORTING:
        EVENTS[LossEvent.REPORT_SENT](episodes)
    return episodes


def phase_of(episodes: Episodes) -> LossPhase:
    loss = episodes._losses.get(0)
    return LossPhase.INTACT if loss is None else loss.phase


@pytest.mark.parametrize(("phase", "event"), LEGAL)
def test_each_transition_of_the_table_happens(phase: LossPhase, event: LossEvent) -> None:
    """Through public methods; `exceptional` is True while an env is not intact."""
    episodes = in_phase(phase)
    assert phase_of(episodes) is phase
    if event is LossEvent.GIVEN_UP and phase is LossPhase.INTACT:
        assert LEGAL[phase, event] is LossPhase.INTACT
    EVENTS[event](episodes)
    assert phase_of(episodes) is LEGAL[phase, event]
    assert episodes.exceptional == (LEGAL[phase, event] is not LossPhase.INTACT)


@pytest.mark.parametrize(
    ("phase", "event"),
    [pair for pair in itertools.product(LossPhase, LossEvent) if pair not in LEGAL],
)
def test_every_other_event_is_refused(phase: LossPhase, event: LossEvent) -> None:
    """A pair that is not in the table raises and changes nothing."""
    episodes = in_phase(phase)
    with pytest.raises(RuntimeError, match=f"is {phase.name}, where {event.name} can't happen"):
        episodes._move(0, event)
    assert phase_of(episodes) is phase


def test_an_env_that_shows_a_saved_state_is_at_its_place_in_the_episode() -> None:
    """Steps count from there; a limit that was reached there is reported no second time."""
    episodes = new_episodes()
    episodes.begin(3, on_done=True)
    episodes.note_restores(SLOT, [Position(3, is_cut=True)])
    shown = part_of([0], [True], [False])
    assert episodes.returned(SLOT, [shown]) is None
    assert episodes.positions(SLOT) == [Position(3, is_cut=True)]
    assert episodes.due.tolist() == [True]


@pytest.mark.parametrize("lose", [True, False])
def test_a_state_that_could_not_be_shown_does_not_count(lose: bool) -> None:
    """The reset after that begins at 0."""
    episodes = new_episodes()
    episodes.note_restores(SLOT, [Position(3, is_cut=False)])
    if lose:
        episodes.lose([0], KILLED)
    else:
        episodes.ended_without_result(0)
    first = part_of([0], [True], [False])
    episodes.returned(SLOT, [first])
    assert episodes.positions(SLOT) == [Position(0, is_cut=False)]


def test_a_reset_that_the_caller_asked_for_makes_a_loss_moot() -> None:
    episodes = in_phase(LossPhase.LOST)
    assert episodes.take_answers(SLOT) == []
    assert not episodes.exceptional


def test_the_last_of_several_losses_is_reported() -> None:
    episodes = in_phase(LossPhase.REPORTING)
    episodes.lose([0], AGAIN)
    assert episodes.report_losses(SLOT).tolist() == [True]
    assert episodes.take_answers(SLOT) == [Report(0, AGAIN)]
