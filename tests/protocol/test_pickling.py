"""Code of a script arrives with the names that its tracebacks show."""

from __future__ import annotations

import pickle
import traceback
from functools import partial
from types import CodeType, FunctionType
from typing import TYPE_CHECKING, Any

import pytest

from rlightning_aio.protocol.pickling import dumped, dumped_with_code

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def outer(divisor: int) -> Callable[[], int]:
    """Return a function that no other process could import."""

    def inner() -> int:
        return sum(1 // k for k in [divisor])

    return inner


def codes(code: CodeType) -> Iterator[CodeType]:
    """Yield `code` and all code in it."""
    yield code
    for held in code.co_consts:
        if isinstance(held, CodeType):
            yield from codes(held)


@pytest.mark.parametrize("dump", [partial(dumped, what="it"), dumped_with_code])
@pytest.mark.parametrize("function", [outer(0), lambda: [1 // 0 for _ in "a"]])
def test_code_keeps_its_file(dump: Callable[[Any], bytes], function: Any) -> None:
    """And that in it, such as a generator's, so a traceback shows file, line and source."""
    there = pickle.loads(dump(function))
    assert isinstance(there, FunctionType)
    assert there is not function
    assert list(codes(there.__code__)) == list(codes(function.__code__))
    assert {code.co_filename for code in codes(there.__code__)} == {__file__}
    with pytest.raises(ZeroDivisionError) as caught:
        there()
    frames = traceback.extract_tb(caught.value.__traceback__)[1:]
    assert {frame.filename for frame in frames} == {__file__}
    assert all("1 //" in str(frame.line) for frame in frames)
