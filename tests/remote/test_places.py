"""A client is a worker that starts itself: places, who takes them, and what a loss means."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zmq
from kit.counting import ClientThread, look, served
from kit.scripted import Counts
from patience import HANG
from remote.proxy import Proxy
from remote.test_hostile_hellos import hello

from rlightning_aio import BatchedData, EnvAway, PolicyResponse, ResetNeeded, build_env_group, sync
from rlightning_aio._core.hosts.process.host import ProcessHost
from rlightning_aio.errors import BadAction, UnknownEnv

if TYPE_CHECKING:
    from collections.abc import Iterator

_TESTS = Path(__file__).parents[1]


class ArmProcess:
    """An arm in a process of its own, which counts its motions."""

    def __init__(self, address: str, log: Path) -> None:
        self._log = log
        self._hold = log.with_suffix(".hold")
        self.process = subprocess.Popen(
            [sys.executable, str(_TESTS / "remote" / "moving_arm.py"), address, str(log)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(_TESTS), *sys.path])},
            stderr=subprocess.DEVNULL,
        )

    def motions(self) -> list[str]:
        return self._log.read_text().splitlines() if self._log.exists() else []

    def is_stopped(self) -> bool:
        return self._log.with_suffix(".stopped").exists()

    def hold(self) -> None:
        """Let the next motion go on until `let_go`."""
        self._hold.touch()

    def let_go(self) -> None:
        self._hold.unlink(missing_ok=True)

    def end(self) -> None:
        self.let_go()
        self.process.kill()
        self.process.wait()


@contextlib.contextmanager
def arms() -> Iterator[list[ArmProcess]]:
    started: list[ArmProcess] = []
    try:
        yield started
    finally:
        for arm in started:
            arm.end()


def actions(batch: Any) -> Any:
    return batch.respond(action=np.zeros((len(batch), 2), np.float32))


def wait_for(group: Any, condition: Any) -> None:
    """Let the group's sockets work until something holds."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < HANG
        look(group)


@pytest.mark.parametrize("operation", ["step", "reset"])
@pytest.mark.parametrize("fault", ["killed", "stopped", "cut off"])
def test_an_arm_moves_only_when_its_user_asks(fault: str, operation: str, tmp_path: Path) -> None:
    """Whatever is lost meanwhile, and whoever dials in."""
    with sync.build_env_group(served()) as group, arms() as started:
        address = group["robots-0"].address
        proxy = Proxy(address)
        with proxy:
            arm = ArmProcess(proxy.address, tmp_path / "first")
            started.append(arm)
            wait_for(group, lambda: group["robots-0"].clients)
            for _ in range(50):
                look(group)
            assert arm.motions() == []
            batch, _ = group.reset(seed=7)
            assert arm.motions() == ["reset 7"]
            batch, _ = group.step(actions(batch))
            arm.hold()
            if operation == "step":
                group.step_async(actions(batch))
            else:
                group.reset_async(seed=8)
            wait_for(group, lambda: len(arm.motions()) == 3)
            if fault == "killed":
                arm.process.kill()
            elif fault == "stopped":
                arm.process.send_signal(signal.SIGSTOP)
            else:
                proxy.silence()
            with pytest.raises(EnvAway):
                group.collect_async(deadline=HANG)
            arm.end()
            other = ArmProcess(address, tmp_path / "second")
            started.append(other)
            wait_for(group, lambda: group["robots-0"].clients)
            for _ in range(5):
                with pytest.raises(EnvAway, match="reset it to go on"):
                    group.step(actions(batch))
                with pytest.raises(EnvAway), group.auto_reset(1):
                    group.step_async(actions(batch))
                look(group)
            assert other.motions() == []
            batch, _ = group.reset(seed=9)
            assert other.motions() == ["reset 9"]
            assert batch.restarted.tolist() == [True]
            group.step(actions(batch))


def test_a_held_reset_that_is_taken_back_moves_nothing(tmp_path: Path) -> None:
    """By an abort, or because the call was interrupted."""
    with sync.build_env_group(served()) as group, arms() as started:
        address = group["robots-0"].address
        group.reset_async(seed=1)
        assert group.pending == ["robots-0/0"]
        group.abort()
        assert group.pending == []

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        before = signal.signal(signal.SIGALRM, interrupt)
        try:
            for env_ids in (None, ["robots-0/0"]):
                signal.setitimer(signal.ITIMER_REAL, 0.3)
                with pytest.raises(KeyboardInterrupt):
                    group.reset(seed=2, env_ids=env_ids)
                assert group.pending == []
        finally:
            signal.signal(signal.SIGALRM, before)
        arm = ArmProcess(address, tmp_path / "arm")
        started.append(arm)
        wait_for(group, lambda: group["robots-0"].clients)
        for _ in range(50):
            look(group)
        assert arm.motions() == []
        group.reset(seed=3)
        assert arm.motions() == ["reset 3"]


def mixed(**env_kwargs: Any) -> Any:
    local = {
        "name": "local",
        "backend": "gymnasium",
        "task": "Pendulum-v1",
        "num_workers": 4,
    }
    return sync.build_env_group([local, served(**env_kwargs)], mixed_actions=True)


def test_a_client_that_leaves_while_workers_start_fails_no_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is not welcomed before the group is open, when a loss is one of a client."""
    attach = ProcessHost.attach

    def visit() -> None:
        with zmq.Context() as context, context.socket(zmq.DEALER) as client:
            client.connect(group._core.supervisor.places.servers[0].address())
            client.send_multipart(hello())
            client.recv_multipart()

    def stop_while_somebody_visits(host: Any, order: Any) -> None:
        os.kill(host.pid, signal.SIGSTOP)
        threading.Timer(1.0, os.kill, (host.pid, signal.SIGCONT)).start()
        visitor.start()
        attach(host, order)

    visitor = threading.Thread(target=visit)
    monkeypatch.setattr(ProcessHost, "attach", stop_while_somebody_visits)
    group = sync.build_env_group([{"task": Counts}, served()])
    with group:
        wait_for(group, lambda: not visitor.is_alive())


def test_an_empty_place_delays_nobody() -> None:
    """Its requests are pending; a call that waits for it alone gets an error."""
    with mixed(clients=1, connect_timeout=0.5) as group:
        local = group.env_ids[:4]
        with pytest.raises(EnvAway, match=r"robots-0/0 within 0.5 s.*has no client"):
            group.reset()
        batch, _ = group.reset(seed=0, env_ids=local)
        group.reset_async(env_ids=["robots-0/0"])
        began = time.monotonic()
        while time.monotonic() - began < 1.5:
            group.step_async(batch.respond(action=np.zeros((4, 1), np.float32)))
            done, _ = group.collect_async(min_results=4)
            assert sorted(done.ids()) == sorted(local)
            batch = done
        assert group.pending == ["robots-0/0"]
        with pytest.raises(TimeoutError):
            group.collect_async(deadline=0.1)
        time.sleep(1.0)  # A learner's pause costs nothing.
        began = time.monotonic()
        with pytest.raises(EnvAway):
            group.collect_async(wait_all=True)
        assert time.monotonic() - began >= 0.5
        assert group.pending == []
        step = PolicyResponse("robots-0/0", action=np.zeros(2, np.float32))
        with pytest.raises(ResetNeeded):
            group.step_async(BatchedData([step.env_id], [step]))


async def test_each_place_has_the_time_of_its_own_call_and_entry() -> None:
    servers = [served(clients=2, connect_timeout=0.5), served(connect_timeout=math.inf)]
    servers[1]["name"] = "spares"
    async with build_env_group(servers) as group:
        with pytest.raises(UnknownEnv, match="'robots-0'; its envs are robots-0/0, robots-0/1"):
            group.episode("robots-0")
        group.reset_async(env_ids=["robots-0/0", "spares-0/0"])
        with pytest.raises(EnvAway, match=r"for robots-0/0 within 0.5 s"):
            await group.collect_async(wait_all=True)
        assert group.pending == ["spares-0/0"]

        async def reset(env_id: str) -> float:
            began = time.monotonic()
            with pytest.raises(EnvAway, match=f"for {env_id} within 0.5 s"):
                await group[env_id].reset()
            return time.monotonic() - began

        first = asyncio.ensure_future(reset("robots-0/0"))
        await asyncio.sleep(0.3)
        assert await reset("robots-0/1") >= 0.5
        await first


@pytest.mark.parametrize("operation", ["step", "reset"])
@pytest.mark.parametrize("fault", ["silent", "closed", "aborted", "Ctrl-C"])
def test_an_arm_at_work_is_stopped_when_its_session_is_over(
    tmp_path: Path, fault: str, operation: str
) -> None:
    """Somebody watches the session while the env moves, however long that takes."""
    with contextlib.ExitStack() as stack:
        group = stack.enter_context(sync.build_env_group(served(heartbeat=1)))
        proxy = stack.enter_context(Proxy(group["robots-0"].address))
        arm = ArmProcess(proxy.address, tmp_path / "first")
        stack.callback(arm.end)
        batch, _ = group.reset()
        arm.hold()
        if operation == "step":
            group.step_async(actions(batch))
        else:
            group.reset_async()
        wait_for(group, lambda: len(arm.motions()) == 2)
        assert not arm.is_stopped()
        if fault == "closed":
            group.close()
        elif fault == "aborted":
            group.abort()
        elif fault == "Ctrl-C":
            threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
            with pytest.raises(KeyboardInterrupt):
                group.collect_async()
        else:
            proxy.silence()
        until = time.monotonic() + HANG
        while not arm.is_stopped():
            assert time.monotonic() < until
            time.sleep(0.01)


def test_a_client_misses_a_silent_server_as_soon_as_that_would_miss_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In its first session, too, however patient it is itself."""
    with contextlib.ExitStack() as stack:
        group = stack.enter_context(sync.build_env_group(served(heartbeat=1)))
        proxy = stack.enter_context(Proxy(group["robots-0"].address))
        client = ClientThread(proxy.address, "one", heartbeat=86400)
        group.reset()
        send, pinged = proxy.send, threading.Event()

        def sending(flow: Any, data: bytes) -> None:
            send(flow, data)
            if flow is flow.pair.flows[1] and b"\4PING" in data:
                pinged.set()

        monkeypatch.setattr(proxy, "send", sending)
        assert pinged.wait(HANG)
        monkeypatch.setattr(proxy, "close", lambda pair: None)  # Nor does it hear of the end.
        proxy.silence()
        client.join()  # It ends when its session does.
        monkeypatch.undo()


@pytest.mark.parametrize("action", [None, np.full((1, 2), 3.0), np.zeros((2, 2)), np.zeros((1, 3))])
def test_a_clients_arm_stops_when_an_action_is_refused(tmp_path: Path, action: Any) -> None:
    """By the group, which sends it away, or by the client itself; a reset moves it again."""
    with sync.build_env_group(served()) as group, arms() as started:
        arm = ArmProcess(group["robots-0"].address, tmp_path / "first")
        started.append(arm)
        batch, _ = group.reset()
        with pytest.raises(BadAction):
            group.step(batch.respond(action=action))
        wait_for(group, arm.is_stopped)
        batch, _ = group.reset()
        group.step(actions(batch))
        assert arm.motions() == ["reset None", "reset None", "step"]


def test_an_arm_stops_when_the_program_of_its_client_ends(tmp_path: Path) -> None:
    """Though that closes nothing."""
    with sync.build_env_group(served()) as group, arms() as started:
        arm = ArmProcess(group["robots-0"].address, tmp_path / "arm")
        started.append(arm)
        batch, _ = group.reset()
        group.step(actions(batch))
        (tmp_path / "arm.end").touch()
        arm.process.wait(HANG)
        assert arm.is_stopped()
