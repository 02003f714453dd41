"""What can't be pickled, or unpickled, is an error of its request, or of its env."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio._core.hosts.completion_frames import completion_in, frame_of
from rlightning_aio._core.hosts.messages import (
    Built,
    NotBuilt,
    Raised,
    Value,
)
from rlightning_aio.protocol.entries import Operation, entry

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.messages import Completion

CALL = entry(8, 3, Operation.CALL)


class Unreadable:
    def __reduce__(self) -> Any:
        return exec, ("raise SystemExit('not here')",)


def sent(completion: Completion) -> Completion:
    return completion_in(5, frame_of(completion))


def test_what_cannot_be_pickled_is_an_error_of_its_request() -> None:
    """So the request ends nevertheless."""
    arrived = sent(Value(5, CALL, (each for each in ())))
    assert isinstance(arrived, Raised)
    assert arrived.entry == CALL
    assert "what it returned can't be pickled" in arrived.error.text


def test_what_cannot_be_unpickled_is_an_error_of_its_request() -> None:
    """The class may be missing in the trainer; of a description, it is an error of its env."""
    arrived = sent(Value(5, CALL, Unreadable()))
    assert isinstance(arrived, Raised)
    assert (arrived.entry, arrived.error.summary) == (CALL, "SystemExit: not here")
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
