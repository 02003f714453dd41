"""The backends of each installation: `gymnasium` and `mujoco`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from envs.bare import gymnasium_outcomes
from envs.group_contract import GroupContract

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from kit.contract import Expected


class GymnasiumContract(GroupContract):
    num_steps = 300

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        env = gym.make(
            self.config.task,
            max_episode_steps=self.config.max_episode_steps,
            **self.config.env_kwargs,
        )
        return gymnasium_outcomes(env, self.seed, actions)


class TestCartPole(GymnasiumContract):
    config = EnvConfig(name="cartpole", backend="gymnasium", task="CartPole-v1")


class TestPendulumWithALimit(GymnasiumContract):
    config = EnvConfig(
        name="pendulum", backend="gymnasium", task="Pendulum-v1", max_episode_steps=40
    )


class TestTupleObservations(GymnasiumContract):
    config = EnvConfig(name="blackjack", backend="gymnasium", task="Blackjack-v1")


class TestHalfCheetah(GymnasiumContract):
    config = EnvConfig(
        name="cheetah",
        backend="mujoco",
        task="HalfCheetah-v5",
        env_kwargs={"reset_noise_scale": 0.2},
    )


def cartpole(**fields: Any) -> GymnasiumEnv:
    config = EnvConfig(name="cartpole", backend="gymnasium", task="CartPole-v1", **fields)
    return GymnasiumEnv(config)


def test_the_step_limit_is_the_registered_one_unless_configured() -> None:
    """Metadata have the effective limit."""
    assert cartpole().get_metadata().max_episode_steps == 500
    assert cartpole(max_episode_steps=7).get_metadata().max_episode_steps == 7


def test_a_preprocess_function_makes_the_action() -> None:
    """`step` calls it; callers of a bare step must do so themselves."""
    config = EnvConfig(name="cartpole", backend="gymnasium", task="CartPole-v1")
    flipped = GymnasiumEnv(config, preprocess_fn=lambda response: 1 - response.action)
    plain = GymnasiumEnv(config)
    assert flipped.bare_step() == flipped.env.step
    flipped.reset(seed=0)
    plain.reset(seed=0)
    one = flipped.step(PolicyResponse("cartpole-0", 0))
    other = plain.step(PolicyResponse("cartpole-0", 1))
    assert np.array_equal(one.observation, other.observation)


def test_a_subclass_with_its_own_step_is_not_stepped_bare() -> None:
    """`bare_step` never bypasses the method of a subclass."""

    class Doubled(GymnasiumEnv):
        def step(self, policy_resp: PolicyResponse) -> Any:
            super().step(policy_resp)
            return super().step(policy_resp)

    env = Doubled(EnvConfig(name="cartpole", backend="gymnasium", task="CartPole-v1"))
    assert env.bare_step() is None


def test_unsupported_operations_raise() -> None:
    """Offloading needs device memory, which these don't use."""
    with pytest.raises(NotImplementedError, match="'gymnasium' has no offload"):
        cartpole().offload()
