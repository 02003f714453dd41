"""RLightning's client and server of remote envs."""

from __future__ import annotations

import threading
import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from patience import HANG

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
    """It is finished after some steps; its resets may wait for those of others."""

    resets = steps = 0
    stop: Any = None
    fails_in = 0
    together: threading.Barrier | None = None

    def reset(self) -> EnvRet:
        self.resets += 1
        if self.together is not None:
            self.together.wait(HANG)
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


def serving(
    address: tuple[str, int], times: int, together: threading.Barrier | None = None
) -> tuple[threading.Thread, Robot]:
    """Start a thread in which a robot connects and serves `times` times."""
    config = EnvConfig(name="arm", backend="piper", task="any")
    robot = Robot(config, preprocess_fn=lambda response: response.action * 2)
    robot.together = together

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


def test_a_robot_stops_when_its_trainer_is_gone() -> None:
    """Those of our backends have a `stop` in place of an `on_disconnect`; here it ends the run."""
    config = EnvConfig(name="robots", backend="env_server", task="real", zmq_port="0")
    group = build_env_group(config)
    thread, robot = serving(group.env_servers[0].get_address_port(), times=1)
    robot.stop = lambda: setattr(robot, "steps", STEPS)
    group.reset()
    group.close()
    thread.join(HANG)
    assert not thread.is_alive()


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


def test_a_loop_over_robots_that_come_and_go() -> None:
    """Each of four serves twice, all at the same time; a fifth one that comes late plays."""
    group = build_env_group(
        EnvConfig(name="robots", backend="env_server", task="real", zmq_port="0")
    )
    address, together = group.env_servers[0].get_address_port(), threading.Barrier(4)
    threads = [serving(address, times=2, together=together)[0] for _ in range(4)]
    batch, _ = group.reset()
    results, most = len(batch.ids()), 0
    while results < 4 * 2 * (STEPS + 1):
        group.step_async(answers(batch))
        batch, _ = group.collect_async()
        results += len(batch.ids())
        most = max(most, len(group._group["robots-0"].clients))
    assert most == 4
    group.step_async(answers(batch))
    with pytest.raises(TimeoutError):
        group._group.collect_async(deadline=0.5)
    threads.append(serving(address, times=1)[0])
    for _ in range(STEPS + 1):
        batch, _ = group.collect_async()
        assert len(batch.ids()) == 1
        group.step_async(answers(batch))
    for thread in threads:
        thread.join()
    group.close()
