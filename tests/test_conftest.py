"""The guards that every other test relies on can themselves fail a test."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest

LEAKS = """
import asyncio, os, socket, subprocess, sys
from multiprocessing import resource_tracker

kept = []

def test_leaves_a_process():
    kept.append(subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE))

def test_leaves_a_zombie():
    done, theirs = socket.socketpair()
    pid = os.fork()
    if pid == 0:
        os._exit(0)
    theirs.close()
    done.recv(1)
    done.close()

def test_leaves_a_descriptor():
    kept.append(socket.socketpair())

def test_leaves_shared_memory(tmp_path):
    open(f"/dev/shm/rlightning-aio-{os.getpid()}", "w").close()

async def test_leaves_a_task():
    kept.append(asyncio.create_task(asyncio.Event().wait()))

def test_leaves_nothing(tmp_path):
    subprocess.run([sys.executable, "-c", ""], check=True)
    with open(tmp_path / "file", "w"), socket.socket():
        pass

async def test_ends_its_task():
    task = asyncio.create_task(asyncio.sleep(0))
    await task
"""

CLEAN_UP = """
from pathlib import Path

def pytest_sessionfinish():
    for path in Path("/dev/shm").glob("rlightning-aio-*"):
        path.unlink()
    import test_leaks
    for thing in test_leaks.kept[:1]:
        thing.communicate(b"")
"""


def test_what_a_test_leaves_behind_fails_it(pytester: pytest.Pytester) -> None:
    """A process, a zombie, a descriptor, shared memory or a task each make an error."""
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text() + CLEAN_UP)
    pytester.makepyfile(test_leaks=LEAKS)
    pytester.makeini("[pytest]\nasyncio_mode = auto\nasyncio_default_fixture_loop_scope=function")
    result = pytester.runpytest_subprocess("-q")
    result.assert_outcomes(passed=9, errors=6)
    output = result.stdout.str()
    for name in ("process", "zombie", "descriptor", "shared_memory", "task"):
        assert f"ERROR at teardown of test_leaves_a_{name}".replace("a_shared", "shared") in output


async def test_async_tests_run_on_both_loops_in_debug_mode(request: pytest.FixtureRequest) -> None:
    """The loop is the one that the test's id names, with asyncio's own checks on."""
    import asyncio

    loop = asyncio.get_running_loop()
    name = request.node.callspec.id
    assert type(loop).__module__.split(".")[0] == name
    assert loop.get_debug()
