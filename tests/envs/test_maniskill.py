"""The `maniskill` backend on the real ManiSkill, with and without a Vulkan device."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from envs.group_contract import GroupContract
from kit.contract import Expected, same

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.vulkan import render_device_is_usable
from rlightning_aio.errors import ConfigError
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rlightning_aio.envs.simulators.maniskill import ManiskillEnv
    from rlightning_aio.types import EnvRet

if find_spec("mani_skill") is None:
    pytest.skip("ManiSkill is not installed", allow_module_level=True)
# Not `mani_skill` itself: without a Vulkan device, it must not be imported first.
torch: Any = pytest.importorskip("torch")

pytestmark = [
    pytest.mark.simulators,
    pytest.mark.filterwarnings("default"),  # The simulator has deprecation warnings.
]
needs_vulkan = pytest.mark.skipif(
    not render_device_is_usable(), reason="images need a Vulkan device"
)
needs_gpu = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="ManiSkill batches on a GPU alone"
)

NO_VULKAN = {"VK_DRIVER_FILES": "/nonexistent", "VK_ICD_FILENAMES": "/nonexistent"}


def entry(task: str = "PickCube-v1", **fields: Any) -> EnvConfig:
    return EnvConfig(name="skill", backend="maniskill", task=task, **fields)


def make(task: str = "PickCube-v1", **fields: Any) -> ManiskillEnv:
    from rlightning_aio.envs.simulators.maniskill import ManiskillEnv

    return ManiskillEnv(entry(task, **fields))


def step(env: ManiskillEnv, action: Any = None) -> EnvRet:
    space = env.get_action_space()
    action = np.zeros(space.shape, space.dtype) if action is None else action
    return env.step(PolicyResponse(env.env_id, action))


class ManiskillContract(GroupContract):
    num_steps = 70  # Episodes have 50.

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        kwargs = {} if render_device_is_usable() else {"render_backend": "none"}
        env = gym.make(
            self.config.task,
            num_envs=1,
            enhanced_determinism=True,
            **kwargs,
            **self.config.env_kwargs,
        )
        observation, _ = env.reset(seed=self.seed)
        yield without_batch_axis(observation), 0.0, False, False
        ended = False
        for action in actions:
            if ended:
                outcome = without_batch_axis(env.reset()[0]), 0.0, False, False
            else:
                observation, *rest = env.step(action)[:4]
                outcome = without_batch_axis(observation), *(one.item() for one in rest)
            ended = outcome[2] or outcome[3]
            yield outcome
        env.close()


def without_batch_axis(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_batch_axis(one) for key, one in value.items()}
    return value[0].numpy()


class TestPickCube(ManiskillContract):
    config = entry()


class TestStateDict(ManiskillContract):
    config = entry("PushCube-v1", env_kwargs={"obs_mode": "state_dict"})


@needs_vulkan
class TestRgb(ManiskillContract):
    config = entry(env_kwargs={"obs_mode": "rgb", "sensor_configs": {"width": 64, "height": 48}})
    num_steps = 6

    def test_images_are_bytes_of_the_size_asked_for(self) -> None:
        """Cameras give uint8 images that are not blank."""
        with self.opened() as env:
            image = env.reset(seed=0).observation["sensor_data"]["base_camera"]["rgb"]
            assert image.shape == (48, 64, 3)
            assert image.dtype == torch.uint8
            assert image.float().std() > 10


@pytest.mark.gpu
@needs_gpu
class TestBatchOnAGpu(GroupContract):
    config = entry(num_envs=4)
    num_steps = 40

    def test_tensors_stay_on_the_gpu_and_keep_their_batch_axis(self) -> None:
        """All values are tensors on the device of the simulator."""
        with self.opened() as env:
            env.reset(seed=0)
            result = env.step(PolicyResponse(env.env_id, env.get_action_space().sample()))
            for value in (result.observation, result.last_reward, result.info["success"]):
                assert value.device.type == "cuda"
                assert value.shape[0] == 4

    def test_single_sub_environments_can_be_reset(self) -> None:
        """The others continue their episodes."""
        with self.opened() as env:
            env.reset(seed=0)
            for _ in range(3):
                env.step(PolicyResponse(env.env_id, env.get_action_space().sample()))
            result = env.reset(options={"env_idx": [1, 3]})
            assert result.info["elapsed_steps"].tolist() == [3, 0, 3, 0]


def test_one_env_has_no_batch_axis() -> None:
    """Observations fit the single space; rewards, flags and success are Python scalars."""
    env = make()
    start = env.reset(seed=0)
    assert start.observation.shape == (42,)
    result = step(env)
    assert type(result.last_reward) is float
    assert type(result.last_terminated) is type(result.last_truncated) is bool
    assert result.info["success"] is False
    assert result.info["elapsed_steps"] == 1
    env.close()


def test_success_and_failure_end_the_episode() -> None:
    """Both are in the info, and both terminate."""
    env = make("MS-CartpoleBalance-v1")
    env.reset(seed=0)
    for _ in range(500):
        result = step(env, np.ones(1, np.float32))
        if result.info["fail"]:
            break
    assert result.info["fail"] is True
    assert result.last_terminated is True
    env.close()


def test_the_step_limit_is_the_tasks_unless_configured() -> None:
    """Gymnasium doesn't find ManiSkill's limit; it truncates."""
    env = make()
    assert env.get_metadata().max_episode_steps == 50
    env.close()
    env = make(max_episode_steps=3)
    assert env.get_metadata().max_episode_steps == 3
    env.reset(seed=0)
    assert [step(env).last_truncated for _ in range(3)] == [False, False, True]
    env.close()


def test_reset_options_reach_the_simulator() -> None:
    """Sub-environments by index, as a list; and rebuilding the scene."""
    env = make()
    first = env.reset(seed=4)
    step(env)
    chosen = env.reset(seed=4, options={"env_idx": [0]})
    assert same(first.observation.numpy(), chosen.observation.numpy())
    rebuilt = env.reset(seed=4, options={"reconfigure": True})
    assert rebuilt.info["reconfigure"] is True
    env.close()


def test_unseeded_envs_differ() -> None:
    """Despite ManiSkill's fixed default seed."""
    envs = [make(), make()]
    assert not same(*(env.reset().observation.numpy() for env in envs))
    for env in envs:
        env.close()


def test_an_offloaded_env_raises_until_it_is_reloaded() -> None:
    """Offloading closes the simulator, keeps spaces known, and can be repeated."""
    env = make()
    before = env.reset(seed=6)
    space = env.get_observation_space()
    for _ in range(2):
        env.offload()
    assert env.env is None
    assert env.get_observation_space() == space
    for use in (env.reset, lambda: step(env), env.render):
        with pytest.raises(RuntimeError, match=r"'skill-0' is offloaded: reload\(\) it"):
            use()
    for _ in range(2):
        env.reload()
    assert same(before.observation.numpy(), env.reset(seed=6).observation.numpy())
    env.offload()
    env.close()


@needs_vulkan
def test_a_frame_is_an_array() -> None:
    """Rendering gives one image for one env."""
    env = make(env_kwargs={"render_mode": "rgb_array"})
    env.reset(seed=0)
    frame = env.render()
    assert isinstance(frame, np.ndarray)
    assert frame.dtype == np.uint8
    assert frame.ndim == 3
    env.close()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_batches_without_a_gpu_raise() -> None:
    """The message says why, and what to do instead."""
    with pytest.raises(ConfigError, match=r"no CUDA device is usable.*num_workers: 8"):
        make(num_envs=8)


def test_missing_assets_raise_with_the_command_that_fetches_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    """A worker has no terminal for a question."""
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    with pytest.raises(ConfigError, match=r"mani_skill\.utils\.download_asset PickSingleYCB-v1"):
        make("PickSingleYCB-v1")


WITHOUT_VULKAN = """
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.maniskill import ManiskillEnv
from rlightning_aio.types import PolicyResponse
import numpy as np

config = {"name": "skill", "backend": "maniskill", "task": "PickCube-v1"}
env = ManiskillEnv(EnvConfig(**config))
env.reset(seed=5)
for _ in range(20):
    result = env.step(PolicyResponse("skill-0", np.full(8, 0.1, np.float32)))
print(result.observation.numpy().tobytes().hex())
env.close()
try:
    ManiskillEnv(EnvConfig(**config, env_kwargs={"obs_mode": "rgb"}))
except ValueError as error:
    print(error)
"""


def test_states_need_no_vulkan_and_images_raise_without_it() -> None:
    """State mode gives identical results with and without a device; image modes raise."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_VULKAN],
        env={**os.environ, **NO_VULKAN, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    states, refusal = done.stdout.splitlines()[-2:]
    assert "env_kwargs ask for images, but no Vulkan device is usable" in refusal
    env = make()
    env.reset(seed=5)
    for _ in range(20):
        result = step(env, np.full(8, 0.1, np.float32))
    assert states == result.observation.numpy().tobytes().hex()
    env.close()
