"""Trees of arrays, and what converts any value."""

from __future__ import annotations

from collections import Counter, OrderedDict, defaultdict, namedtuple
from typing import Any

import numpy as np
import pytest

from rlightning_aio.trees import copied

Pair = namedtuple("Pair", "one other")  # noqa: PYI024  # As a library's that has no types.


@pytest.mark.parametrize(
    "value",
    [
        Counter(goals=2, steps=5),
        OrderedDict(b=np.arange(2), a=[np.arange(3)]),
        defaultdict(list, a=(np.ones(1),)),
        Pair(np.zeros(2), "text"),
        {"a": {"b": (np.arange(2), [1.5, None])}},
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_copy_has_the_same_classes_and_values(value: Any) -> None:
    """An env may go on changing what it has reported."""
    copy = copied(value)
    assert repr(copy) == repr(value)
    assert copy is not value
    for one in copy.values() if isinstance(copy, dict) else copy:
        if isinstance(one, np.ndarray):
            one[:] = 7
    assert "7" not in repr(value)
