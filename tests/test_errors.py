"""The tree of errors, as it crosses processes."""

from __future__ import annotations

import copy
import inspect
import pickle
import traceback
from typing import TYPE_CHECKING, Any

import pytest

from rlightning_aio import BatchedData, errors

if TYPE_CHECKING:
    from collections.abc import Callable

KINDS = [kind for name in errors.__all__ if issubclass(kind := getattr(errors, name), Exception)]
VALUES: dict[str, Any] = {"str": "some text", "int | None": -9}
"""For parameters, by their annotation."""
COPIES: list[Callable[[Any], Any]] = [
    *(lambda error, p=p: pickle.loads(pickle.dumps(error, p)) for p in range(6)),
    copy.copy,
    copy.deepcopy,
]


def made(kind: Any, message: str = "what went wrong") -> Any:
    """An error of a kind, each parameter of its constructor given."""
    constructor = kind.__init__
    if not inspect.isfunction(constructor):  # Python's own.
        return kind(message)
    _, _, *others = inspect.signature(constructor).parameters.values()
    return kind(message, **{other.name: VALUES[other.annotation] for other in others})


def state(error: BaseException) -> tuple[Any, ...]:
    """All that can be told of an error but its results."""
    attributes = {k: v for k, v in vars(error).items() if k not in ("results", "others")}
    others = [state(other) for other in vars(error).get("others", ())]
    return type(error), str(error), error.args, attributes, others


@pytest.mark.parametrize("kind", KINDS)
def test_every_error_can_be_copied_and_pickled(kind: Any) -> None:
    """With message, notes, attributes, results and causes."""
    error = made(kind)
    error.add_note("a note")
    if isinstance(error, errors.EnvFault):
        error.results = BatchedData(["a-0"], [7])
        error.others = (made(kind, "another"),)
    for copied in COPIES:
        found = copied(error)
        assert state(found) == state(error)
        assert str(found.__cause__) == str(error.__cause__)
        if isinstance(error, errors.EnvFault):
            assert found.results.items() == [("a-0", 7)]


class Unpicklable(Exception):
    """Can't be made from a message alone, and holds what no pickle takes."""

    def __init__(self, text: str, *, held: Any) -> None:
        super().__init__(text)
        self.held = held


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind is not errors.RemoteTraceback])
def test_a_cause_arrives_as_text_at_least(kind: Any) -> None:
    """Ours as what they are; whatever others there are, with their tracebacks."""
    try:
        try:
            raise Unpicklable("the cause", held=lambda: None)
        except Unpicklable as cause:
            raise made(kind) from cause
    except errors.RLightningError as error:
        found = pickle.loads(pickle.dumps(error))
    assert isinstance(found.__cause__, errors.RemoteTraceback)
    told = "".join(traceback.format_exception(found))
    assert "Unpicklable: the cause" in told
    assert 'raise Unpicklable("the cause"' in told
    found.__cause__ = made(kind, "ours")
    assert type(pickle.loads(pickle.dumps(found)).__cause__) is kind
