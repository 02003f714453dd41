"""Exceptions as text for another process."""

from __future__ import annotations

from rlightning_aio.protocol.error_text import ErrorText


def test_a_group_of_exceptions_names_what_is_in_it() -> None:
    """One is named in place of the group, several after it; the traceback has all of them."""
    inner = ExceptionGroup("inner", [KeyError("a")])
    one = ErrorText.of(BaseExceptionGroup("unhandled errors in a TaskGroup", [inner]))
    assert one.summary == "KeyError: 'a'"
    assert "unhandled errors in a TaskGroup (1 sub-exception)" in one.traceback
    errors = [inner, ValueError("b"), TimeoutError(), OSError("c")]
    several = ErrorText.of(ExceptionGroup("the servers failed", errors))
    assert several.summary == (
        "ExceptionGroup: the servers failed (4 sub-exceptions): KeyError: 'a'; ValueError: b; "
        "TimeoutError; …"
    )
