"""Groups for fault tests, with either driver; fixtures close them whatever happened."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import uvloop
from kit.driven import Driven

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

# The first loop opens a pipe that libuv keeps, so it is made before the tests.
uvloop.new_event_loop().close()


@pytest.fixture(params=["sync", "uvloop"])
def driver(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def build(driver: str) -> Iterator[Callable[..., Driven]]:
    """Build groups without initialising them."""
    built: list[Driven] = []

    def build(cfgs: Any, **kwargs: Any) -> Driven:
        built.append(Driven(driver, cfgs, **kwargs))
        return built[-1]

    yield build
    while built:  # The test's item keeps its fixtures alive; it must not keep groups alive.
        built.pop().end()


@pytest.fixture
def start(build: Callable[..., Driven]) -> Callable[..., Driven]:
    """Build groups, initialise and reset them."""

    def start(cfgs: Any, **kwargs: Any) -> Driven:
        group = build(cfgs, **kwargs)
        group.init()
        group.reset(seed=0)
        return group

    return start
