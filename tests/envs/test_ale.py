"""The `ale` backend on the real Arcade Learning Environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from envs.bare import gymnasium_outcomes
from envs.group_contract import GroupContract
from kit.contract import Expected, same, values_of

from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import ConfigError
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rlightning_aio.envs.simulators.ale import ALEEnv

pytest.importorskip("ale_py")
import gymnasium as gym
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation, TimeLimit

pytestmark = pytest.mark.simulators


def entry(task: str = "ALE/Pong-v5", num_envs: int = 1, **fields: Any) -> EnvConfig:
    return EnvConfig(name="atari", backend="ale", task=task, num_envs=num_envs, **fields)


def make(config: EnvConfig) -> ALEEnv:
    from rlightning_aio.envs.simulators.ale import ALEEnv

    return ALEEnv(config)


class TestRawFrames(GroupContract):
    config = entry()

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        return gymnasium_outcomes(gym.make("ALE/Pong-v5"), self.seed, actions)


class TestPreprocessedStack(GroupContract):
    config = entry(
        "ALE/Breakout-v5",
        env_kwargs={
            "preprocessing": {"terminal_on_life_loss": True, "screen_size": [84, 96]},
            "frame_stack": 4,
        },
    )

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        game = gym.make("ALE/Breakout-v5", frameskip=1)
        frames = AtariPreprocessing(game, terminal_on_life_loss=True, screen_size=(84, 96))
        return gymnasium_outcomes(FrameStackObservation(frames, 4), self.seed, actions)


class TestStepLimit(GroupContract):
    config = entry(max_episode_steps=30, env_kwargs={"preprocessing": True})

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        frames = AtariPreprocessing(gym.make("ALE/Pong-v5", frameskip=1))
        return gymnasium_outcomes(TimeLimit(frames, 30), self.seed, actions)


class TestVectorOfRawFrames(GroupContract):
    config = entry("ALE/Breakout-v5", 3)

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        games = gym.make_vec(
            "ALE/Breakout-v5",
            num_envs=3,
            vectorization_mode="vector_entry_point",
            img_height=210,
            img_width=160,
            grayscale=False,
            stack_num=1,
            maxpool=False,
            noop_max=0,
            use_fire_reset=False,
            reward_clipping=False,
        )
        for stacked, *rest in gymnasium_outcomes(
            games, np.arange(self.seed, self.seed + 3), actions, resets_itself=True
        ):
            yield stacked[:, 0], *rest


class TestVectorOfPreprocessedStacks(GroupContract):
    config = entry(
        "ALE/Breakout-v5", 3, env_kwargs={"preprocessing": {"noop_max": 12}, "frame_stack": 4}
    )

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        games = gym.make_vec(
            "ALE/Breakout-v5",
            num_envs=3,
            vectorization_mode="vector_entry_point",
            noop_max=12,
            use_fire_reset=False,
            reward_clipping=False,
        )
        seeds = np.arange(self.seed, self.seed + 3)
        return gymnasium_outcomes(games, seeds, actions, resets_itself=True)


@pytest.mark.parametrize(
    ("env_kwargs", "shape"),
    [
        ({}, (210, 160, 3)),
        ({"frame_stack": 2}, (2, 210, 160, 3)),
        ({"preprocessing": True}, (84, 84)),
        ({"preprocessing": True, "frame_stack": 4}, (4, 84, 84)),
        ({"preprocessing": {"grayscale_obs": False, "screen_size": 64}}, (64, 64, 3)),
    ],
)
def test_num_envs_only_adds_an_axis(env_kwargs: dict[str, Any], shape: tuple[int, ...]) -> None:
    """Options have the same meaning for one game and for several."""
    for num_envs, head in ((1, ()), (2, (2,))):
        env = make(entry(num_envs=num_envs, env_kwargs=env_kwargs))
        assert env.get_observation_space().shape == (*head, *shape)
        assert env.get_observation_space().dtype == np.uint8
        env.close()


@pytest.mark.parametrize("preprocessing", [False, {"noop_max": 0}])
def test_a_vector_plays_the_same_games_as_single_envs(preprocessing: Any) -> None:
    """Game k of a vector is a single game with seed + k, frame for frame, until it ends."""
    env_kwargs = {"repeat_action_probability": 0.0, "preprocessing": preprocessing}
    vector = make(entry("ALE/Breakout-v5", 2, env_kwargs=env_kwargs))
    singles = [make(entry("ALE/Breakout-v5", env_kwargs=env_kwargs)) for _ in range(2)]
    actions = np.random.default_rng(0).integers(4, size=(400, 2))
    vector.reset(seed=11)
    for k, single in enumerate(singles):
        single.reset(seed=11 + k)
    steps = 0
    for action in actions:
        together = values_of(vector.step(PolicyResponse("atari-0", action)))
        for k, single in enumerate(singles):
            alone = values_of(single.step(PolicyResponse("atari-0", action[k])))
            assert same([column[k] for column in together[1:]], list(alone[1:]))
            # The last raw frames of a game may differ.
            assert same(together[0][k], alone[0]) or alone[2]
        steps += 1
        if together[2].any():
            break
    assert 50 < steps < 400
    for env in (vector, *singles):
        env.close()


def test_a_vectorised_game_that_ended_starts_over_in_the_next_step() -> None:
    """The step after an end is a reset: reward 0, and the action is ignored."""
    env = make(entry(num_envs=2, max_episode_steps=5))
    env.reset(seed=0)
    results = [env.step(PolicyResponse("atari-0", np.array([2, 2]))) for _ in range(7)]
    assert [bool(result.last_truncated.all()) for result in results] == [False] * 4 + [
        True,
        False,
        False,
    ]
    assert not any(result.last_terminated.any() for result in results)
    assert not results[5].last_reward.any()
    assert results[5].info["episode_frame_number"].tolist() == [0, 0]
    env.close()


def test_unseeded_vectors_differ() -> None:
    """Workers that start in the same second don't play the same games."""
    envs = [make(entry("ALE/Breakout-v5", 2, env_kwargs={"preprocessing": True})) for _ in "ab"]
    for env in envs:
        env.reset()
    actions = np.random.default_rng(0).integers(4, size=(20, 2))
    last = [[env.step(PolicyResponse("atari-0", a)) for a in actions][-1] for env in envs]
    assert not np.array_equal(last[0].observation, last[1].observation)
    for env in envs:
        env.close()


def test_an_unknown_option_raises() -> None:
    """The message has the option, the number of envs, and the known options."""
    with pytest.raises(ConfigError, match="preprocessing has no frameskip"):
        make(entry(env_kwargs={"preprocessing": {"frameskip": 2}}))
    with pytest.raises(ConfigError, match=r"no scale_obs with num_envs: 2; .*screen_size"):
        make(entry(num_envs=2, env_kwargs={"preprocessing": {"scale_obs": True}}))
