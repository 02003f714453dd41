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


def kinds_on_both_drivers(name: str, values: Iterable[str]) -> pytest.MarkDecorator:
    """Parameter `name` is a list: of all `values`, and on the other driver of the first alone.

    For kinds of one thing that are all alike to whoever waits, shown one after another.
    """
    kinds = list(values)
    cases = [pytest.param("sync", kinds, id="sync"), pytest.param("uvloop", kinds[:1], id="uvloop")]
    return pytest.mark.parametrize(("driver", name), cases)
