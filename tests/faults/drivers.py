"""Choose the drivers for a fault test: both, unless the test says otherwise.

Such a test mainly costs the start of workers, so behaviour that the driver can't affect is tested
on one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterable

on_one_driver = pytest.mark.parametrize("driver", ["sync"])
"""For behaviour that is decided before any wait, or in the worker."""


def kinds_on_both_drivers(name: str, values: Iterable[str]) -> pytest.MarkDecorator:
    """Parametrise `name` with a list: all `values` on one driver, the first on the other.

    For variants that look alike to the driver, tested one after another.
    """
    kinds = list(values)
    cases = [pytest.param("sync", kinds, id="sync"), pytest.param("uvloop", kinds[:1], id="uvloop")]
    return pytest.mark.parametrize(("driver", name), cases)
