"""Completions on their way from a worker to the trainer."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

import pytest

from rlightning_aio._core.hosts.completion_frames import completion_in, frame_of
from rlightning_aio._core.hosts.messages import (
    Attached,
    Built,
    Closed,
    ErrorText,
    Lost,
    NewSchema,
    NotBuilt,
    Raised,
    Result,
    Value,
)
from rlightning_aio.errors import EnvHung
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.info import InfoSchema

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.messages import Completion

ERROR = ErrorText("ValueError", "no", "Traceback: no")
STEP, CALL = entry(7, 3, Operation.STEP), entry(8, 3, Operation.CALL)
SCHEMA = InfoSchema.of({"a": 1})
assert SCHEMA is not None
FAULT = EnvHung("it hung", env_id="one-0")


class Unreadable:
    def __reduce__(self) -> Any:
        return exec, ("raise SystemExit('not here')",)


def sent(completion: Completion, host_id: int = 5) -> Completion:
    return completion_in(host_id, frame_of(completion))


@pytest.mark.parametrize(
    "completion",
    [
        Built(5, []),
        NotBuilt(5, 2, ERROR),
        Attached(5),
        NewSchema(5, 4, SCHEMA),
        Value(5, CALL, {"x": 1}),
        Raised(5, STEP, ERROR),
        Lost(5, 2, Loss("hung in a step", "env_hung", "either", "one-0")),
        Lost(5, 2, Loss("hung", "env_hung", "either", "one-0"), STEP, "env 'one-0' took too long"),
        Closed(5, [(1, ERROR)]),
    ],
    ids=lambda completion: type(completion).__name__,
)
def test_a_completion_arrives_as_it_was(completion: Completion) -> None:
    """The trainer's end adds the host, which no frame names."""
    assert sent(completion) == completion
    assert sent(completion._replace(host_id=0)) == completion


def test_what_is_out_of_band_stays_pickled() -> None:
    """Whoever collects the result reads it."""
    arrived = sent(Result(5, STEP, {"info": {"a": 1}}))
    assert isinstance(arrived, Result)
    assert isinstance(arrived.out_of_band, bytes)
    assert pickle.loads(arrived.out_of_band) == {"info": {"a": 1}}
    assert (arrived.host_id, arrived.entry) == (5, STEP)


@pytest.mark.parametrize(
    ("completion", "what"),
    [
        (Value(5, CALL, (each for each in ())), "what it returned"),
        (Result(5, STEP, {"info": {"a": (each for each in ())}}), "the result"),
    ],
)
def test_what_cannot_be_pickled_is_an_error_of_its_request(
    completion: Value | Result, what: str
) -> None:
    """So the request ends nevertheless."""
    arrived = sent(completion)
    assert isinstance(arrived, Raised)
    assert arrived.entry == completion.entry
    assert f"{what} can't be pickled" in arrived.error.text


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
