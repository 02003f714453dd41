"""On which drivers a test of faults runs; on both, unless it says otherwise.

A start of workers is what such a test costs. What the driver has no part in is shown once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterable

on_one_driver = pytest.mark.parametrize("driver", ["sync"])
"""For what is decided before anything is waited for, or in the worker alone."""


def first_on_both_drivers(name: str, values: Iterable[str]) -> pytest.MarkDecorator:
    """All `values` of parameter `name`, the first of them on either driver.

    For kinds of one thing that are all alike to whoever waits.
    """
    listed = list(values)
    pairs = [("sync", value) for value in listed] + [("uvloop", listed[0])]
    return pytest.mark.parametrize(("driver", name), pairs)
