"""Piper arms in a group: workers, statistics, and what becomes of an arm without a trainer."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("piper_sdk")
pytest.importorskip("serial")

from envs.closing_table import closing_table, steps
from envs.watched_arm import WatchedArm

from rlightning_aio import sync
from rlightning_aio.envs.piper_sim import SlcanPort, running
from rlightning_aio.errors import BadAction

pytestmark = [
    pytest.mark.simulators,
    # The SDK calls an argument of python-can by its former name.
    pytest.mark.filterwarnings("ignore:.*bustype.*:DeprecationWarning"),
]

READY = [0.0, 0.5, -0.5, 0.0, 0.0, 0.0]


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
def test_arms_in_a_group_go_where_they_are_sent(placement: str) -> None:
    """Two arms on channels of their own: spaces, steps, limits, episodes, as of one env."""
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


def test_a_bad_action_reaches_the_trainer_and_not_the_arm() -> None:
    """The worker's error has the joint and its limits; after a reset the arm goes on."""
    with sync.build_env_group(entry()) as group:
        batch, _ = group.reset()
        bad = np.array([[9.0, *READY[1:], 0.0]], np.float32)
        with pytest.raises(BadAction, match=r"joint_1 = 9 rad is outside"):
            group.step(batch.respond(action=bad))
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=np.array([[*READY, 0.0]], np.float32)))
        assert batch.info()[0]["arm_status"] == "NORMAL"


@pytest.mark.parametrize("death", [signal.SIGKILL, signal.SIGTERM])
def test_the_arm_stops_when_its_trainer_dies(death: signal.Signals) -> None:
    """Whatever kills the trainer, the worker makes the safe stop."""
    arm = WatchedArm()
    script = Path(__file__).with_name("piper_trainer.py")
    with (
        contextlib.closing(SlcanPort()) as port,
        running(arm, port),
        subprocess.Popen([sys.executable, script, port.path], stdout=subprocess.PIPE) as trainer,
    ):
        assert trainer.stdout
        assert trainer.stdout.readline() == b"moving\n"
        assert not arm.emergency_stopped
        trainer.send_signal(death)
        trainer.wait()
        assert arm.wait_for(lambda: arm.emergency_stopped)
        # Its worker, which has this pipe as well, must be gone before the port is: a stop that
        # the lost port can't take is said again to whatever arm has its path then.
        while trainer.stdout.readline():
            pass
        assert np.abs(arm.joints - arm.targets).max() == 0


def test_the_dry_run_ends_with_its_table() -> None:
    """The example config runs as it stands, without an arm."""
    assert steps(closing_table("piper", "--steps", "30")["piper"]) == 30
