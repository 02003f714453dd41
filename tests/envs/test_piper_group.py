"""Piper arms in a group: workers, statistics, and arms without a trainer."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import Any

import numpy as np
import pytest

pytest.importorskip("piper_sdk")
pytest.importorskip("serial")

from envs.closing_table import closing_table, steps
from envs.watched_arm import WatchedArm
from kit.counting import ClientThread
from kit.processes import fork_server_pid, kill
from patience import HANG

from rlightning_aio import BatchedData, EnvConfig, PolicyResponse, sync
from rlightning_aio.errors import BadAction, EnvRaised, WorkerDied
from rlightning_aio.plugins.piper.arm import CanFrame
from rlightning_aio.plugins.piper.env import PiperEnv
from rlightning_aio.plugins.piper.sim import SlcanPort, running

pytestmark = [
    pytest.mark.simulators,
    # The SDK uses the former name of an argument of python-can.
    pytest.mark.filterwarnings("ignore:.*bustype.*:DeprecationWarning"),
]

READY = [0.0, 0.5, -0.5, 0.0, 0.0, 0.0]
SERVER = {"name": "arm", "backend": "env_server", "env_kwargs": {"connect_timeout": HANG}}


def entry(**fields: Any) -> dict[str, Any]:
    env_kwargs = {
        "can_interface": "virtual",
        "channel": "arm",
        "control_hz": 100,
        "speed": 100,
        "reset_joints": READY,
        "feedback_timeout": 2.0,
    } | fields.pop("env_kwargs", {})
    return {
        "name": "arm",
        "backend": "piper",
        "task": "test",
        "max_episode_steps": 20,
        "env_kwargs": env_kwargs,
        **fields,
    }


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_arms_in_a_group_reach_their_targets(placement: str) -> None:
    """Two arms on their own channels: spaces, steps, limits, episodes."""
    two = entry(num_workers=2, placement=placement, env_kwargs={"channel": ["left", "right"]})
    target = np.array([0.3, 0.6, -0.6, 0.0, 0.0, 0.0, 0.01], np.float32)
    with sync.build_env_group(two) as group, group.auto_reset():
        assert group.env_ids == ["arm-0", "arm-1"]
        batch, _ = group.reset(seed=0)
        assert batch.observation["joint_positions"] == pytest.approx(
            np.array([READY, READY]), abs=0.021
        )
        for step in range(1, 21):
            batch, flags = group.step(batch.respond(action=np.stack([target, target])))
            assert flags == [step == 20] * 2
        assert batch.observation["joint_positions"] == pytest.approx(
            np.stack([target[:6]] * 2), abs=1e-3
        )
        assert batch.truncated.tolist() == [True, True]
        assert batch["arm-0"].info["arm_status"] == "NORMAL"
        batch, flags = group.step(batch.respond(action=np.stack([target, target])))
        assert flags == [False, False]
        assert batch.observation["joint_positions"] == pytest.approx(
            np.array([READY, READY]), abs=0.021
        )
        assert group.get_env_stats()["arm-1"]["mean_length"] == 20


ACTIONS_THAT_ARE_NONE = {
    "NaN": ([0.1, *READY[1:5], math.nan, 0.0], r"joint_6 = nan rad is outside \[-2\.09439, 2"),
    "infinity": ([0.1, *READY[1:5], math.inf, 0.0], r"joint_6 = inf rad is outside \[-2\.09439"),
    "too few": (READY, r"shape \(7,\): joint_1 in \[-2\.6179, 2\.6179\] rad.*; got shape \(6,\)"),
    "None": (None, r"joint_1 in \[-2\.6179, 2\.6179\] rad.*; got None"),
    "text": ("left", r"joint_1 in \[-2\.6179, 2\.6179\] rad.*; got "),
}


@pytest.mark.parametrize("place", ["process", "inline", "client"])
def test_an_invalid_action_stops_a_moving_arm(monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    """The error names joint and limits, and the arm moves again only after a reset."""
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.0}')
    arm = WatchedArm()
    with contextlib.ExitStack() as stack:
        port = stack.enter_context(contextlib.closing(SlcanPort()))
        stack.enter_context(running(arm, port))
        slcan = {"can_interface": "slcan", "channel": port.path, "speed": 10}
        fields = entry(env_kwargs=slcan, placement="process" if place == "client" else place)
        config = SERVER if place == "client" else fields
        group = stack.enter_context(sync.build_env_group(config))
        if place == "client":
            env = PiperEnv(EnvConfig(**fields))
            monkeypatch.setattr(env, "is_finish", (finished := threading.Event()).is_set)
            client = ClientThread(group["arm-0"].address, "c", env)
            stack.callback(client.join)
            stack.callback(group.close)
            stack.callback(finished.set)

        def step(action: Any) -> Any:
            (env_id,) = batch.env_ids()
            group.step_async(BatchedData([batch.ids()[0]], [PolicyResponse(env_id, action)]))
            return group.collect_async(deadline=HANG)[0]

        for action, expected in ACTIONS_THAT_ARE_NONE.values():
            batch, _ = group.reset()
            batch = step([2.0, 2.0, -2.0, 1.0, 1.0, 1.0, 0.0])
            while np.abs(arm.joints - arm.targets).max() <= 0.5:  # Until the order is there.
                time.sleep(0.001)
            with pytest.raises(BadAction, match=expected):
                step(action)
            assert np.abs(arm.joints - arm.targets).max() < 0.1, "it holds where it is"
            with pytest.raises(EnvRaised, match=r"the arm is stopped; reset\(\) starts it again"):
                step([*READY[:5], 0.1, 0.0])


@pytest.mark.parametrize("killed", ["worker", "fork server"])
def test_the_whole_stop_is_sent_when_a_worker_is_killed(
    monkeypatch: pytest.MonkeyPatch, killed: str
) -> None:
    """What is killed with the worker leaves out the arm's watchdog, which sends it three times."""
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.0}')
    arm, stop = WatchedArm(), CanFrame(0x150, bytes([1, 0, 0, 0, 0, 0, 0, 0]))
    with contextlib.closing(SlcanPort()) as port, running(arm, port):
        slcan = {"can_interface": "slcan", "channel": port.path, "safe_stop": "emergency_stop"}
        with sync.build_env_group(entry(env_kwargs=slcan)) as group:
            batch, _ = group.reset()
            group.step(batch.respond(action=np.array([[*READY, 0.0]], np.float32)))
            assert stop not in arm.commands
            kill(fork_server_pid(group) if killed != "worker" else group.get_workers()[0]["pid"])
            assert arm.wait_for(lambda: arm.commands.count(stop) == 3)
            with pytest.raises(WorkerDied):
                group.step(batch.respond(action=np.array([[*READY, 0.0]], np.float32)))


def test_the_dry_run_ends_with_its_table() -> None:
    """The example config runs unchanged, without an arm."""
    assert steps(closing_table("piper", "--steps", "30")["steps"]) == 30
