"""Descriptions of envs that can't be pickled, or unpickled; tests/faults has values and results."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio._core.hosts.completion_frames import completion_in, frame_of
from rlightning_aio._core.hosts.messages import (
    Built,
    NotBuilt,
)

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.messages import Completion


class Unreadable:
    def __reduce__(self) -> Any:
        return exec, ("raise SystemExit('not here')",)


def sent(completion: Completion) -> Completion:
    return completion_in(5, frame_of(completion))


def test_a_description_that_cannot_be_unpickled_is_an_error_of_its_env() -> None:
    """A class may be missing in the trainer."""
    built: Any = [Unreadable()]
    arrived = sent(Built(5, built))
    assert isinstance(arrived, NotBuilt)
    assert "not here" in arrived.error.text


def test_a_description_that_cannot_be_pickled_is_an_error_of_its_env() -> None:
    """It names the last of the envs."""
    built: Any = [1, (each for each in ())]
    arrived = sent(Built(5, built))
    assert isinstance(arrived, NotBuilt)
    assert arrived.env_index == 1
