"""Tests of the fixtures that check every other test."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest

LEAKS = """
import asyncio, mmap, os, socket, subprocess, sys

kept = []
ELSEWHERE = f"/dev/shm/of-somebody-else-{os.getpid()}"

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

def test_leaves_shared_memory():
    descriptor = os.memfd_create("left")
    os.ftruncate(descriptor, 4096)
    kept.append(mmap.mmap(descriptor, 4096))
    os.close(descriptor)

async def test_leaves_a_task():
    kept.append(asyncio.create_task(asyncio.Event().wait()))

def test_lets_others_keep_theirs():
    script = "import sys; open(sys.argv[1], 'w').close()"
    subprocess.run([sys.executable, "-c", script, ELSEWHERE], check=True)
    assert os.path.exists(ELSEWHERE)

def test_leaves_nothing(tmp_path):
    with open(tmp_path / "file", "wb+") as file, socket.socket():
        descriptor = os.memfd_create("closed")
        os.ftruncate(descriptor, 4096)
        mmap.mmap(descriptor, 4096).close()
        os.close(descriptor)

async def test_ends_its_task():
    task = asyncio.create_task(asyncio.sleep(0))
    await task
"""

CLEAN_UP = """
from pathlib import Path

def pytest_sessionfinish():
    import test_leaks
    Path(test_leaks.ELSEWHERE).unlink()
    for thing in test_leaks.kept[:1]:
        thing.communicate(b"")
"""


def test_leftovers_of_a_test_fail_it(pytester: pytest.Pytester) -> None:
    """A process, a zombie, a descriptor, shared memory and a task are each an error."""
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text() + CLEAN_UP)
    pytester.makepyfile(test_leaks=LEAKS)
    options = "asyncio_mode = auto\nasyncio_default_fixture_loop_scope=function"
    pytester.makeini(f"[pytest]\n{options}\npythonpath = {Path(__file__).parent}")
    result = pytester.runpytest_subprocess("-q")
    result.assert_outcomes(passed=10, errors=6)
    output = result.stdout.str()
    assert "shared memory: /memfd:left" in output
    for name in ("process", "zombie", "descriptor", "shared_memory", "task"):
        assert f"ERROR at teardown of test_leaves_a_{name}".replace("a_shared", "shared") in output


async def test_async_tests_run_on_both_loops_in_debug_mode(request: pytest.FixtureRequest) -> None:
    """On the loop in the test's id, with asyncio's debug mode."""
    import asyncio

    loop = asyncio.get_running_loop()
    name = request.node.callspec.id
    assert type(loop).__module__.split(".")[0] == name
    assert loop.get_debug()
