"""Groups for the fault tests: of either driver, closed at the end whatever happened."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import uvloop
from faults.driven import Driven

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

# The first loop opens a pipe that libuv keeps for good; no test is to be blamed for it.
uvloop.new_event_loop().close()


@pytest.fixture(params=["sync", "uvloop"])
def driver(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def build(driver: str) -> Iterator[Callable[..., Driven]]:
    """Builds groups, not initialised."""
    built: list[Driven] = []

    def build(cfgs: Any, **kwargs: Any) -> Driven:
        built.append(Driven(driver, cfgs, **kwargs))
        return built[-1]

    yield build
    while built:  # The test's item holds on to its fixtures; it shall not hold on to groups.
        built.pop().end()


@pytest.fixture
def start(build: Callable[..., Driven]) -> Callable[..., Driven]:
    """Builds groups, initialised and reset."""

    def start(cfgs: Any, **kwargs: Any) -> Driven:
        group = build(cfgs, **kwargs)
        group.init()
        group.reset(seed=0)
        return group

    return start
