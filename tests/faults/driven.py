"""Use the group of either driver from plain code, and check its results against the requests."""

from __future__ import annotations

import asyncio
import inspect
import os
import select
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import uvloop
from faults.faulty import CODES
from patience import HANG

import rlightning_aio
import rlightning_aio.sync
from rlightning_aio._core.hosts.process.host import ForkServerHandle

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvRet


class Driven:
    """A group of either kind for plain code: awaitable methods are awaited here."""

    def __init__(self, driver: str, cfgs: Any, **kwargs: Any) -> None:
        self.runner: asyncio.Runner | None = None
        if driver == "sync":
            self.group: Any = rlightning_aio.sync.build_env_group(cfgs, **kwargs)
        else:
            factory = uvloop.new_event_loop if driver == "uvloop" else asyncio.new_event_loop
            self.runner = asyncio.Runner(loop_factory=factory)
            self.group = rlightning_aio.build_env_group(cfgs, **kwargs)

    def _wait(self, result: Any) -> Any:
        if not inspect.iscoroutine(result):
            return result
        assert self.runner is not None
        return self.runner.run(result)

    def __getattr__(self, name: str) -> Any:
        method = getattr(self.group, name)
        return lambda *args, **kwargs: self._wait(method(*args, **kwargs))

    def __len__(self) -> int:
        return len(self.group)

    def call(self, env_id: str, name: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method through the env's handle."""
        return self._wait(self.group[env_id].call(name, *args, **kwargs))

    def end(self) -> None:
        """Close the group, and the loop."""
        self._wait(self.group.close())
        if self.runner is not None:
            self.runner.close()


def entry(num_workers: int = 2, **fields: Any) -> dict[str, Any]:
    """Return a config entry of faulty envs, which share one worker unless `fields` say
    otherwise.
    """
    return {
        "name": "faulty",
        "backend": "faulty",
        "task": "anything",
        "num_workers": num_workers,
        **({} if fields.get("placement") == "inline" else {"envs_per_process": num_workers}),
        **fields,
    }


def two_workers(**fields: Any) -> dict[str, Any]:
    """Return an entry of four envs, two in each worker."""
    return entry(4, **{"envs_per_process": 2, **fields})


def pid_of(group: Driven, env_id: str) -> int:
    """Return the process id of an env's worker."""
    return group.call(env_id, "returns", os.getpid)


def kill(pid: int) -> None:
    """Kill a process; return when it is dead."""
    descriptor = os.pidfd_open(pid)
    try:
        signal.pidfd_send_signal(descriptor, signal.SIGKILL)
        assert select.select([descriptor], [], [], HANG)[0], "the process is still alive"
    finally:
        os.close(descriptor)


def stop(pid: int) -> None:
    """Stop a process; return when it has stopped, which may take a moment on another core."""
    os.kill(pid, signal.SIGSTOP)
    while Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
        os.sched_yield()


class Tokens:
    """Makes steps with a new token for each env, and checks results against them."""

    def __init__(self) -> None:
        self._next = 1.0
        self._asked: dict[str, float] = {}

    def steps(self, env_ids: list[str], faults: dict[str, str] | None = None) -> BatchedData:
        """Return a batch of steps; `faults` is by env id."""
        actions: list[np.ndarray] = []
        for env_id in env_ids:
            self._asked[env_id] = self._next
            fault = (faults or {}).get(env_id, "nothing")
            actions.append(np.array([CODES[fault], self._next]))
            self._next += 1
        responses = [
            rlightning_aio.PolicyResponse(env_id, action)
            for env_id, action in zip(env_ids, actions, strict=True)
        ]
        return rlightning_aio.BatchedData(env_ids, responses)

    def check(self, batch: BatchedData) -> None:
        """Check that every result of `batch` answers its own env's last step."""
        for env_id, ret in batch.items():
            index, _, _, steps, token = ret.observation
            assert env_id == ret.env_id
            assert env_id == f"faulty-{int(index)}"
            assert token == self._asked[env_id]
            assert ret.last_reward == token
            assert ret.info == {"steps": steps, "name": index}


def marked(ret: EnvRet) -> bool:
    """Return True if a result comes from a replacement; check that it is as it must be then."""
    if "worker_restarted" not in ret.info:
        return False
    assert ret.last_truncated
    assert not ret.last_terminated
    assert ret.last_reward == 0.0
    assert list(ret.observation[2:]) == [1, 0, 0], (
        "a marked result has the first reset of a new life"
    )
    assert ret.info["resets"] == 1
    return True


def fork_server_of(group: Any) -> ForkServerHandle:
    """Return the only fork server of a group."""
    shared = group._core.tables.resources.values()
    (server,) = (one for one in shared if isinstance(one, ForkServerHandle))
    return server
