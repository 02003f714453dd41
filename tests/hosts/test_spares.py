"""Fork servers that are kept for the next group."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from run_python import output_of

from rlightning_aio import EnvConfig, StartFailed, sync
from rlightning_aio._core.hosts.process import spares

if TYPE_CHECKING:
    from collections.abc import Iterator

HANG = 60.0


@pytest.fixture(autouse=True)
def none_kept() -> Iterator[None]:
    """Begin and end without spares."""
    spares.end_all()
    yield
    spares.end_all()


def parent_of_a_worker(**fields: Any) -> int:
    """Build a group, close it, and return the pid of its fork server."""
    config = EnvConfig(name="e", backend="gymnasium", task="CartPole-v1", **fields)
    with sync.build_env_group([config]) as group:
        group.reset()
        (worker,) = group.get_workers()
        status = Path(f"/proc/{worker['pid']}/status").read_text()
    return int(status.partition("PPid:")[2].split()[0])


def test_the_next_group_continues_with_the_fork_server() -> None:
    """Its workers are new; one fork server is kept, however many groups there were."""
    first = parent_of_a_worker()
    assert [parent_of_a_worker() for _ in range(3)] == [first] * 3
    assert [spare.process.pid for spare in spares.kept()] == [first]


@pytest.mark.parametrize("change", ["environment", "folder", "env_vars", "sys.path"])
def test_other_surroundings_need_another_fork_server(
    change: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A worker has what it would inherit from a trainer that starts it now."""
    first, fields = parent_of_a_worker(), {}
    if change == "environment":
        monkeypatch.setenv("A_VARIABLE", "1")
    elif change == "folder":
        monkeypatch.chdir(tmp_path)
    elif change == "env_vars":
        fields["env_vars"] = {"A_VARIABLE": "1"}
    elif change == "sys.path":
        monkeypatch.syspath_prepend(tmp_path)
    assert parent_of_a_worker(**fields) != first
    assert len(spares.kept()) == 2


def test_a_few_are_kept() -> None:
    """The one that was used longest ago ends."""
    used = [parent_of_a_worker(env_vars={"A_VARIABLE": str(k)}) for k in range(4)]
    assert [spare.process.pid for spare in spares.kept()] == used[1:]
    assert not Path(f"/proc/{used[0]}").exists()


@pytest.mark.parametrize("continues", [False, True])
def test_a_start_that_fails_leaves_none(continues: bool) -> None:
    """Nor does one that continues with the fork server of a group before."""
    if continues:
        parent_of_a_worker()
    config = EnvConfig(name="e", backend="gymnasium", task="CartPole-v1", env_kwargs={"no": 1})
    with pytest.raises(StartFailed):
        sync.build_env_group([config]).init()
    assert not spares.kept()


def test_one_that_has_died_is_not_used() -> None:
    first = parent_of_a_worker()
    os.kill(first, signal.SIGKILL)
    spares.kept()[0].process.wait(HANG)
    assert parent_of_a_worker() != first


def test_the_one_that_replaced_a_dead_one_is_kept() -> None:
    config = EnvConfig(name="e", backend="gymnasium", task="CartPole-v1")
    with sync.build_env_group([config]) as group:
        group.reset()
        (worker,) = group.get_workers()
        status = Path(f"/proc/{worker['pid']}/status").read_text()
        os.kill(int(status.partition("PPid:")[2].split()[0]), signal.SIGKILL)
        while group.get_workers()[0]["pid"] in (worker["pid"], None):
            group.reset()  # The worker may still have replied to the first.
    (spare,) = spares.kept()
    assert spare.process.poll() is None


def test_none_outlives_the_program_and_a_forked_child_has_none() -> None:
    """The child builds a group of its own; both leave no process."""
    script = """
import os, sys
from rlightning_aio import EnvConfig, sync
from rlightning_aio._core.hosts.process import spares

def play():
    with sync.build_env_group([EnvConfig(name="e", backend="gymnasium", task="CartPole-v1")]) as g:
        g.reset()

play()
(spare,) = spares.kept()
print(spare.process.pid, flush=True)
child = os.fork()
if not child:
    assert not spares.kept()
    play()
    print(spares.kept()[0].process.pid, flush=True)
    sys.exit()
assert os.waitpid(child, 0)[1] == 0
assert spare.process.poll() is None
"""
    pids = output_of("-c", script).split()
    assert len(set(pids)) == 2
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)
