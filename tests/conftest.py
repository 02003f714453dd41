"""What holds for every test: nothing outlives it, and async tests run on both loops.

Rule: a test that passes its assertions and leaves a process, a descriptor, shared
memory or a task behind has failed.
"""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import pytest_asyncio
import uvloop
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

# For the loops that tests make themselves; pytest-asyncio has an option for its own.
os.environ["PYTHONASYNCIODEBUG"] = "1"

# A thousand interpreters start for the tests; none of them shall compile everything anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# What tests start is to heed signals that whoever started the tests ignores, as nohup does: a
# handler, unlike that, is not passed on.
for _number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, lambda *_: None)

# How fast examples come says something of the machine, and nothing of the code.
settings.register_profile(
    "any machine",
    deadline=None,
    max_examples=int(os.environ.get("RLIGHTNING_AIO_EXAMPLES", "20")),
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("any machine")


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    repeated = [item for item in items if _repeats(item)]
    config.hook.pytest_deselected(items=repeated)
    items[:] = [item for item in items if item not in repeated]
    for item in items:
        if pytest_asyncio.is_async_test(item):
            # First in, last out: the tasks of other fixtures have ended by then.
            item.fixturenames.insert(0, no_task_left_behind.__name__)


def pytest_collection_finish() -> None:
    # What is imported stays: sparing the collector from walking it saves time in every test.
    gc.collect()
    gc.freeze()


def _repeats(item: pytest.Item) -> bool:
    """Whether a test shows with one driver what it shows with another as well.

    A synchronous group doesn't know what loop it runs in. Where who waits has no part in what
    is shown (`one_driver_for_each_place`), inline envs are in a synchronous group, and workers
    in one on uvloop.
    """
    params = item.callspec.params if hasattr(item, "callspec") else {}
    place = params.get("place")
    on_uvloop = any(value is uvloop.new_event_loop for value in params.values())
    if hasattr(place, "inline") and item.get_closest_marker("one_driver_for_each_place"):
        return place.synchronous != place.inline or on_uvloop == place.inline
    synchronous = any(getattr(value, "synchronous", False) for value in params.values())
    return synchronous and on_uvloop


def _children() -> dict[str, str]:
    """Child processes, zombies included, with what they run: one that has only just been started
    may still run what this one does.
    """
    found: dict[str, str] = {}
    for children in Path("/proc/self/task").glob("*/children"):
        try:
            pids = children.read_text().split()
        except (FileNotFoundError, ProcessLookupError):
            continue  # The thread has ended since it was listed.
        for pid in pids:
            try:
                command = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ")
            except (FileNotFoundError, ProcessLookupError):
                continue
            name = f"process {pid}"
            found[name] = f"{name}: {command.decode()[:80] or 'a zombie'}"
    return found


def _descriptors() -> set[str]:
    found: set[str] = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            found.add(f"descriptor {descriptor.name}: {descriptor.readlink()}")
        except FileNotFoundError:
            continue  # The one that the listing itself needed.
    return found


def _shared_memory() -> set[str]:
    """What this process maps of memory that others may map, with and without a name.

    The library gives its memory no name, so it lasts as long as somebody holds it: this
    process, in a descriptor or a mapping, or one that it has started, which would itself be
    left behind. /dev/shm is not listed: what is there may belong to anybody.
    """
    found: set[str] = set()
    for line in Path("/proc/self/maps").read_text().splitlines():
        _, _, _, _, inode, *path = line.split(maxsplit=5)
        if path and path[0].startswith(("/memfd:", "/dev/shm/")):
            found.add(f"shared memory: {path[0]}, inode {inode}")
    return found


def _held() -> dict[str, str]:
    """What this process holds, and how each of it is told."""
    return _children() | {name: name for name in _descriptors() | _shared_memory()}


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    before = _held()
    yield
    if _held().keys() - before:
        gc.collect()  # What merely awaits collection is in nobody's hands.
    left = [told for name, told in _held().items() if name not in before]
    assert not left, f"the test left behind {sorted(left)}"


@pytest_asyncio.fixture
async def no_task_left_behind() -> AsyncIterator[None]:
    yield
    left = asyncio.all_tasks() - {asyncio.current_task()}
    assert not left, f"the test left behind {left}"
