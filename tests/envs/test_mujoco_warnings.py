"""MuJoCo's warnings while a task is made reach only users who can act on them."""

from __future__ import annotations

import gymnasium as gym
import mujoco
import pytest

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.gymnasium import MujocoEnv

OUTDATED = """
<mujoco>
  <compiler settotalmass="14"/>
  <worldbody><body><freejoint/><geom size="0.1"/></body></worldbody>
</mujoco>
"""


class Unstable(gym.Env[object, object]):
    """Loads a model with a deprecated attribute and, unlike Gymnasium's tasks, breaks it."""

    def __init__(self) -> None:
        model = mujoco.MjModel.from_xml_string(OUTDATED)
        data = mujoco.MjData(model)
        data.qvel[:] = float("nan")
        mujoco.mj_step(model, data)


def test_deprecated_attributes_of_assets_do_not_warn(capfd: pytest.CaptureFixture[str]) -> None:
    """HalfCheetah's XML uses one, without a warning."""
    MujocoEnv(EnvConfig(name="cheetah", backend="mujoco", task="HalfCheetah-v5")).close()
    assert capfd.readouterr().err == ""


def test_other_warnings_pass() -> None:
    """Only an unstable simulation warns."""
    gym.register("Unstable-v0", Unstable)
    mujoco.set_mju_user_warning(None)  # What another test of this process has left gets them.
    try:
        with pytest.warns(RuntimeWarning, match="QVEL") as told:
            MujocoEnv(EnvConfig(name="unstable", backend="mujoco", task="Unstable-v0"))
    finally:
        gym.registry.pop("Unstable-v0")
    assert len(told) == 1


def test_a_users_handler_stays_and_gets_other_warnings() -> None:
    """During and after the env is made."""
    heard: list[str] = []
    mine = heard.append
    gym.register("Unstable-v0", Unstable)
    mujoco.set_mju_user_warning(mine)
    try:
        MujocoEnv(EnvConfig(name="unstable", backend="mujoco", task="Unstable-v0"))
        assert mujoco.get_mju_user_warning() == mine
    finally:
        mujoco.set_mju_user_warning(None)
        gym.registry.pop("Unstable-v0")
    assert len(heard) == 1
    assert "QVEL" in heard[0]
