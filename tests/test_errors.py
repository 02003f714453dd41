"""Errors are copied and pickled with their contents."""

from __future__ import annotations

import builtins
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
VALUES: dict[str, Any] = {"str": "some text", "int | None": -9, "Blame": "env"}
"""Arguments by annotation."""
COPIES: list[Callable[[Any], Any]] = [
    *(lambda error, p=p: pickle.loads(pickle.dumps(error, p)) for p in range(6)),
    copy.copy,
    copy.deepcopy,
]


def made(kind: Any, message: str = "what went wrong") -> Any:
    """Return an error of a class, with an argument for each parameter."""
    constructor = kind.__init__
    if not inspect.isfunction(constructor):  # Python's own.
        return kind(message)
    _, _, *others = inspect.signature(constructor).parameters.values()
    return kind(message, **{other.name: VALUES[other.annotation] for other in others})


def state(error: BaseException) -> tuple[Any, ...]:
    """Return all contents of an error except its results."""
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


def raised(type_name: str) -> errors.EnvRaised:
    """Return the error for an exception that a worker reports."""
    return errors.env_raised(
        "what went wrong",
        env_id="a-0",
        exception_type=type_name,
        exception_text="some text",
        traceback_text="the remote traceback",
    )


BUILTINS = [
    kind for kind in vars(builtins).values()
    if isinstance(kind, type) and issubclass(kind, BaseException)
    and kind.__module__ == "builtins"  # MuJoCo adds its own when it is imported.
]  # fmt: skip


@pytest.mark.parametrize("builtin", sorted({*BUILTINS}, key=lambda kind: kind.__name__))
def test_an_error_of_an_env_can_be_caught_by_its_builtin_class(
    builtin: type[BaseException],
) -> None:
    """With any constructor; except for classes that Python itself handles."""
    acted_on = BaseExceptionGroup | StopIteration | StopAsyncIteration
    error = raised(builtin.__name__)
    if issubclass(builtin, Exception) and not issubclass(builtin, acted_on):
        assert isinstance(error, builtin)
    else:
        assert type(error) is errors.EnvRaised
    assert str(error) == "what went wrong"
    for copied in COPIES:
        found = copied(error)
        assert state(found) == state(error)
        assert str(found.__cause__) == str(error.__cause__)
    text = "".join(traceback.format_exception(error))
    assert "what went wrong" in text
    assert "the remote traceback" in text


@pytest.mark.parametrize("name", ["no_such", "mine.KeyError", "print", "__name__", ""])
def test_other_exceptions_only_have_our_class(name: str) -> None:
    assert type(raised(name)) is errors.EnvRaised


class Unpicklable(Exception):
    """Needs more than a message, and has an attribute that can't be pickled."""

    def __init__(self, text: str, *, held: Any) -> None:
        super().__init__(text)
        self.held = held


@pytest.mark.parametrize("kind", KINDS)
def test_a_cause_is_transferred_at_least_as_text(kind: Any) -> None:
    """Our errors as themselves; others as their tracebacks."""
    try:
        try:
            raise Unpicklable("the cause", held=lambda: None)
        except Unpicklable as cause:
            raise made(kind) from cause
    except errors.RLightningError as error:
        found = pickle.loads(pickle.dumps(error))
    assert isinstance(found.__cause__, errors.RemoteTraceback)
    text = "".join(traceback.format_exception(found))
    assert "Unpicklable: the cause" in text
    assert 'raise Unpicklable("the cause"' in text
    found.__cause__ = made(kind, "ours")
    assert type(pickle.loads(pickle.dumps(found)).__cause__) is kind
