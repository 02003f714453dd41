"""RLightning's client and server of remote envs."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from rlightning_aio.errors import EnvRaised
from rlightning_aio.plugins.legacy.names import is_rlightning_installed, make_importable

if is_rlightning_installed():
    pytest.skip("RLightning itself is installed", allow_module_level=True)
make_importable()

from rlightning.env import BaseEnv  # noqa: E402
from rlightning.env.remote_env import RemoteEnvClient  # noqa: E402
from rlightning.types import BatchedData, EnvRet, PolicyResponse  # noqa: E402
from rlightning.utils.builders import build_env_group  # noqa: E402
from rlightning.utils.config import EnvConfig  # noqa: E402

STEPS = 3


class Robot(BaseEnv):
    """It is finished after some steps."""

    resets = steps = 0
    fails_in = 0

    def reset(self) -> EnvRet:
        self.resets += 1
        if self.resets == self.fails_in:
            raise RuntimeError("stuck")
        self.steps = 0
        return EnvRet(self.env_id, {"joints": np.zeros(7), "rgb": np.zeros((4, 4, 3), np.uint8)})

    def step(self, policy_resp: Any) -> EnvRet:
        self.steps += 1
        joints = np.asarray(self._preprocess_fn(policy_resp))
        observation = {"joints": joints, "rgb": np.full((4, 4, 3), self.steps, np.uint8)}
        return EnvRet(policy_resp.env_id, observation, 1.0, info={"gripper": "open"})

    def get_observation_space(self) -> Any:
        joints = spaces.Box(-np.inf, np.inf, (7,), np.float64)
        return spaces.Dict({"joints": joints, "rgb": spaces.Box(0, 255, (4, 4, 3), np.uint8)})

    def get_action_space(self) -> Any:
        return spaces.Box(-1, 1, (7,), np.float64)

    def is_finish(self) -> bool:
        return self.steps >= STEPS


def serving(address: tuple[str, int], times: int) -> tuple[threading.Thread, Robot]:
    """Start a thread in which a robot connects and serves `times` times."""
    config = EnvConfig(name="arm", backend="piper", task="any")
    robot = Robot(config, preprocess_fn=lambda response: response.action * 2)

    def serve() -> None:
        client = RemoteEnvClient(robot, *address)
        for _ in range(times):
            client.connect()
            client.run()

    thread = threading.Thread(target=serve)
    thread.start()
    return thread, robot


def answers(batch: BatchedData) -> BatchedData:
    rets = batch.values()
    responses = [PolicyResponse(env_id=ret.env_id, action=np.full(7, 0.25)) for ret in rets]
    return BatchedData(batch.ids(), responses)


def test_a_robot_serves_a_group_and_reconnects() -> None:
    """Its results have its own id, and batches have the server's."""
    group = build_env_group(
        EnvConfig(name="robots", backend="env_server", task="real", zmq_port="0")
    )
    (server_id,) = group.env_ids
    assert (len(group), group.size(), group.init()) == (1, 0, [])
    thread, robot = serving(group.env_servers[0].get_address_port(), times=2)
    try:
        batch, flags = group.reset()
        assert (batch.ids(), flags) == ((server_id,), [False])
        results = []
        while len(results) < 2 * STEPS:
            with pytest.raises(NotImplementedError, match="step_async"):
                group.step(answers(batch))
            group.step_async(answers(batch))
            batch, _ = group.collect_async()
            results += [ret for ret in batch.values() if ret.last_reward == 1.0]
    finally:
        thread.join()
        group.close()
    (env_id,) = {ret.env_id for ret in results}
    assert env_id.startswith(f"{server_id}/")
    assert results[0].observation["joints"].tolist() == [0.5] * 7
    assert (results[-1].observation["rgb"].max(), results[-1].info) == (STEPS, {"gripper": "open"})
    assert robot.steps == STEPS


def test_an_error_of_a_robot_in_a_reset_has_the_results_of_the_others() -> None:
    """Under RLightning's ids, also if an entry's name has a slash."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = build_env_group(
            [
                EnvConfig(name="local/cheetah", backend="mujoco", task="HalfCheetah-v5"),
                EnvConfig(name="all/robots", backend="env_server", task="real", zmq_port="0"),
            ]
        )
    local_id, server_id = group.env_ids
    thread, robot = serving(group.env_servers[0].get_address_port(), times=1)
    try:
        batch, _ = group.reset()
        robot.fails_in = robot.resets + 1
        with pytest.raises(EnvRaised, match="stuck") as caught:
            group.reset()
        assert caught.value.env_id == batch.values()[1].env_id
        assert caught.value.env_id.startswith(f"{server_id}/")
        assert caught.value.results.ids() == (local_id,)
    finally:
        robot.steps = STEPS  # It is finished.
        group.close()
        thread.join()


def test_a_loop_over_robots_that_come_and_go(tmp_path: Path) -> None:
    """Each of four serves twice, in a process of its own; a fifth one that comes late plays."""
    group = build_env_group(
        EnvConfig(name="robots", backend="env_server", task="real", zmq_port="0")
    )
    started: list[subprocess.Popen[bytes]] = []
    folders = [str(Path(__file__).parents[1]), *sys.path]

    def start() -> None:
        host, port = group.env_servers[0].get_address_port()
        script = str(Path(__file__).parent / "dialling_robot.py")
        started.append(
            subprocess.Popen(
                [sys.executable, script, host, str(port), str(tmp_path)],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
            )
        )

    try:
        for _ in range(4):
            start()
        batch, _ = group.reset()
        results = len(batch.ids())
        most = 0
        while results < 4 * 2 * 11:
            group.step_async(answers(batch))
            batch, _ = group.collect_async()
            results += len(batch.ids())
            most = max(most, len(group._group["robots-0"].clients))
        assert results == 88
        assert most == 4
        group.step_async(answers(batch))
        with pytest.raises(TimeoutError):
            group._group.collect_async(deadline=2.0)
        start()
        batch, _ = group.collect_async()
        assert len(batch.ids()) == 1
        for _ in range(21):
            group.step_async(answers(batch))
            batch, _ = group.collect_async()
    finally:
        for one in started:
            one.kill()
            one.wait()
        group.close()
