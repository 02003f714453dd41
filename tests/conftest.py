"""Checks of every test: it leaves nothing behind, and async tests run on both loops.

Rule: a test whose assertions pass fails if it leaves a process, a descriptor, shared memory or a
task behind.
"""

from __future__ import annotations

import asyncio
import dataclasses
import gc
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import traceback
from asyncio.constants import DEBUG_STACK_DEPTH
from pathlib import Path
from typing import TYPE_CHECKING, Any

import _pytest.runner
import pytest
import pytest_asyncio
import uvloop
from hypothesis import HealthCheck, settings
from kit import checked

from rlightning_aio._core.group.drivers import sync_driver
from rlightning_aio.registry import BACKENDS, ENVS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

    from rlightning_aio._core.hosts.process import spares

# The first loop of a process opens pipes that libuv keeps, so it is made before the tests.
uvloop.new_event_loop().close()

# For loops that tests make themselves; pytest-asyncio has an option for its own loops.
os.environ["PYTHONASYNCIODEBUG"] = "1"

# These checks keep the stack of each future that is made, for a warning. The whole of it is mostly
# pytest's, and to read its lines takes an eighth of the time of async tests.
_extracted = traceback.StackSummary.extract


def _where(frames: Any, *, limit: int | None = None, **options: Any) -> traceback.StackSummary:
    if limit is None and frames.__name__ == "walk_stack":
        return _extracted(frames, limit=DEBUG_STACK_DEPTH, lookup_lines=False)
    return _extracted(frames, limit=limit, **options)


traceback.StackSummary.extract = _where

# Every group that a test builds checks what happens to its requests.
checked.install()

# A group continues with the fork server of the one before only if the environment is the same, and
# pytest would write the name of each test there.
_pytest.runner._update_current_test_var = lambda *_: None

# The tests start a thousand interpreters; they must not compile all modules again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# MuJoCo imports glfw, which starts an interpreter to ask its library for the version, unless this
# variable names the library.
_glfw = importlib.util.find_spec("glfw")
if _glfw is not None and _glfw.origin is not None:
    _library = Path(_glfw.origin).parent / "x11" / "libglfw.so"
    if _library.exists():
        os.environ.setdefault("PYGLFW_LIBRARY", str(_library))

# Child processes must react to signals even if the tests were started with these ignored, as by
# nohup. A handler, unlike an ignored signal, is not inherited.
for _number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, lambda *_: None)

# The speed of examples depends on the machine, so it must fail no test. The few examples of an
# ordinary run are the same each time, so a change fails only for what it did; more are random.
_examples = os.environ.get("RLIGHTNING_AIO_EXAMPLES")
settings.register_profile(
    "any machine",
    deadline=None,
    derandomize=_examples is None,
    max_examples=20 if _examples is None else int(_examples),
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("any machine")


# Many envs are in modules of tests, which import pytest: longer than all else that a worker does to
# start. A fork server does that once.
BACKENDS["callable"] = dataclasses.replace(
    BACKENDS["callable"], preload=(*BACKENDS["callable"].preload, "pytest")
)


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    repeated = [item for item in items if _repeats(item)]
    config.hook.pytest_deselected(items=repeated)
    items[:] = [item for item in items if item not in repeated]
    for item in items:
        if pytest_asyncio.is_async_test(item):
            # The first fixture is torn down last, when the tasks of other fixtures have ended.
            item.fixturenames.insert(0, no_task_left_behind.__name__)


def _repeats(item: pytest.Item) -> bool:
    """Return True if a test with one driver repeats the same test with another.

    A synchronous group doesn't depend on the running loop. If the driver doesn't matter
    (`one_driver_for_each_place`), inline envs are in a synchronous group, and workers in one on
    uvloop. Only awaitable envs in this process are on both loops then.
    """
    params = item.callspec.params if hasattr(item, "callspec") else {}
    place = params.get("place")
    on_uvloop = any(value is uvloop.new_event_loop for value in params.values())
    if item.get_closest_marker("one_driver_for_each_place"):
        if hasattr(place, "inline"):
            return place.synchronous != place.inline or on_uvloop == place.inline
        on_asyncio = any(value is asyncio.new_event_loop for value in params.values())
        return on_asyncio and place not in (None, "loop")
    synchronous = any(getattr(value, "synchronous", False) for value in params.values())
    return synchronous and on_uvloop


def _spares() -> list[spares.RunningForkServer]:
    """Return the fork servers that are kept for the next group."""
    from rlightning_aio._core.hosts.process import spares

    return spares.kept()


def _children() -> dict[str, str]:
    """Return child processes, zombies included, with their commands. A process that has just been
    forked may still have the command of this one.
    """
    found: dict[str, str] = {}
    kept = {str(spare.process.pid) for spare in _spares()}
    for children in Path("/proc/self/task").glob("*/children"):
        try:
            pids = set(children.read_text().split())
        except (FileNotFoundError, ProcessLookupError):
            continue  # The thread has ended since it was listed.
        for pid in pids - kept:
            try:
                command = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ")
            except (FileNotFoundError, ProcessLookupError):
                continue
            name = f"process {pid}"
            found[name] = f"{name}: {command.decode()[:80] or 'a zombie'}"
    return found


def _descriptors() -> set[str]:
    found: set[str] = set()
    kept = {str(spare.messages.fileno()) for spare in _spares()}
    for descriptor in Path("/proc/self/fd").iterdir():
        if descriptor.name in kept:
            continue
        try:
            target = descriptor.readlink()
        except FileNotFoundError:
            continue  # The descriptor of the listing itself.
        # Mesa, which draws without a GPU, keeps its memory as long as the process lasts.
        if target.name != "memfd:allocation fd (deleted)":
            found.add(f"descriptor {descriptor.name}: {target}")
    return found


def _shared_memory() -> set[str]:
    """Return the mappings of memory that can be shared, with and without a name.

    The library's memory has no name, so it lasts as long as a descriptor or a mapping of this
    process, or of a child process, which would itself be left behind. /dev/shm is not listed,
    because other programs use it, too.
    """
    found: set[str] = set()
    for line in Path("/proc/self/maps").read_text().splitlines():
        if "/memfd:" in line or "/dev/shm/" in line:
            _, _, _, _, inode, path = line.split(maxsplit=5)
            if path.startswith(("/memfd:", "/dev/shm/")):
                found.add(f"shared memory: {path}, inode {inode}")
    return found


def _held() -> dict[str, str]:
    """Return descriptions of this process's resources, by a unique key."""
    return _children() | {name: name for name in _descriptors() | _shared_memory()}


@pytest.fixture(scope="module", autouse=True)
def _imports_are_no_garbage() -> None:
    """Exempt what was imported until now from garbage collection, which every test then spends a
    tenth of the time on. No other fixture holds anything yet.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", params=["python", "c"])
def implementation(request: pytest.FixtureRequest) -> Iterator[str]:
    """Use each implementation of the hot path in turn, in this process and in its workers."""
    from rlightning_aio.protocol import kernel

    if request.param == "c" and kernel.compiled() is None:
        pytest.skip("the compiled kernel was not built")
    before = kernel.selected
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(kernel.VARIABLE, request.param)
        kernel.select(request.param)
        yield request.param
    kernel.select(before)


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    before = _held()
    yield
    after = _held()
    if after.keys() - before.keys():
        gc.collect()  # Ignore garbage.
        after = _held()
    left = [shown for name, shown in after.items() if name not in before]
    assert not left, f"the test left behind {sorted(left)}"


@pytest_asyncio.fixture
async def no_task_left_behind() -> AsyncIterator[None]:
    yield
    left = asyncio.all_tasks() - {asyncio.current_task()}
    assert not left, f"the test left behind {left}"


@pytest.fixture
def python_raises() -> Iterator[None]:
    """Have Ctrl-C raise KeyboardInterrupt, also where the shell has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def pressed_again(python_raises: None, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return a list that gets an item in place of each Ctrl-C that comes again after a call."""
    pressed: list[bool] = []
    monkeypatch.setattr(sync_driver, "press_again", lambda: pressed.append(True))
    return pressed


@pytest.fixture
def moving(monkeypatch: pytest.MonkeyPatch) -> None:
    """All envs move something real."""
    monkeypatch.setattr(type(ENVS), "is_hardware", lambda self, *entry: True)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a file system of one mebibyte and yield its folder."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, check=False).returncode:
        pytest.skip("only root mounts file systems")
    yield folder
    # Lazily, because it may be the working directory of a test.
    subprocess.run(["umount", "--lazy", str(folder)], check=True)
