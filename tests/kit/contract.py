"""`EnvContract`: tests that the env of every backend must pass.

Rule: a subclass names a config and gets the tests; no test knows a simulator.
Left out: speed, and the meaning of observations.
"""

from __future__ import annotations

import contextlib
import warnings
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pytest

from rlightning_aio.envs.base import initialised
from rlightning_aio.envs.fast_path import fast_path_of
from rlightning_aio.envs.results import step_of
from rlightning_aio.protocol.columns import out_of_bounds
from rlightning_aio.registry import ENVS
from rlightning_aio.trees import as_numpy, mapped
from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Sequence

    import gymnasium as gym

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.base import BaseEnv

Expected = tuple[Any, Any, Any, Any]
"""Observation, reward, terminated, truncated; NumPy arrays and Python scalars in them."""


class EnvContract:
    """Tests of one env against `BaseEnv`'s contract.

    ::

        class TestMyEnv(EnvContract):
            config = EnvConfig(name="mine", backend="my_backend", task="MyTask-v1")

    Attributes:
        config: the config entry that the env is made from.
        num_steps: length of the trajectories.
        seed: of their first reset.
    """

    config: ClassVar[EnvConfig]
    num_steps: ClassVar[int] = 200
    seed: ClassVar[int] = 3

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        """Yield the bare simulator's outcomes of a reset with `seed` and of each action.

        Override it to compare the env with the simulator that it wraps. After the end of an
        episode, a reset without a seed takes the place of the next action.
        """
        del actions
        pytest.skip("no bare simulator to compare with")

    def actions(self, env: BaseEnv) -> list[Any]:
        """Return seeded random actions; override it if the action space is unbounded."""
        space = env.get_action_space()
        space.seed(self.seed)
        return [space.sample() for _ in range(self.num_steps)]

    def make_env(self) -> BaseEnv:
        """Return the env under test, initialised."""
        env = ENVS.resolve(self.config.backend)(self.config)
        initialised(env)
        return env

    @contextlib.contextmanager
    def opened(self) -> Generator[BaseEnv]:
        """Open the env under test, and close it at the end."""
        env = self.make_env()
        try:
            yield env
        finally:
            env.close()

    def test_metadata_is_what_the_env_was_configured_to_be(self) -> None:
        """Id, counts and spaces are known as soon as the env is built."""
        with self.opened() as env:
            meta = env.get_metadata()
            assert meta.env_id == f"{self.config.name}-0"
            assert meta.num_envs >= 1
            assert meta.observation_space is not None, "no observation space"
            assert meta.action_space is not None, "no action space"
            assert meta.max_episode_steps is None or meta.max_episode_steps >= 1

    def test_every_result_fits_the_spaces_and_counts(self) -> None:
        """Observations are members of the space; rewards and flags have one entry each.

        Exceeded bounds cause a warning, because simulators often declare wrong bounds.
        """
        with self.opened() as env:
            meta = env.get_metadata()
            shape = (meta.num_envs,) if meta.num_envs > 1 else ()
            ended = True
            for action in self.actions(env):
                result = env.reset() if ended else _step(env, action)
                outcome = values_of(result)
                _check_membership(self.config.task_name, outcome[0], env.get_observation_space())
                if not ended:
                    _check_columns(outcome, meta.agents, shape)
                ended = _awaits_reset(env, outcome)

    def test_a_reset_gives_no_reward_and_ends_nothing(self) -> None:
        """After a reset no agent has a reward, and no agent that takes part has ended."""
        with self.opened() as env:
            result = env.reset(seed=self.seed)
            assert isinstance(result, EnvRet | MultiAgentEnvRet), f"reset() gave {result}"
            assert not np.any(_entries(result.last_reward, ()))
            assert not np.any(_entries(result.last_truncated, ()))
            assert not np.all(_entries(result.last_terminated, ()))

    def test_one_seed_gives_one_trajectory(self) -> None:
        """The same seed and actions give the same bits, in this env and in another one."""
        with self.opened() as env, self.opened() as other:
            actions = self.actions(env)
            first = list(outcomes_of(env, actions, self.seed))
            assert same(first, list(outcomes_of(env, actions, self.seed))), "not when reset again"
            assert same(first, list(outcomes_of(other, actions, self.seed))), "not in another env"

    def test_other_seeds_give_other_trajectories(self) -> None:
        """The seed matters."""
        with self.opened() as env:
            actions = self.actions(env)
            one = list(outcomes_of(env, actions, self.seed))
            assert not same(one, list(outcomes_of(env, actions, self.seed + 1000)))

    def test_results_are_not_overwritten(self) -> None:
        """A returned result stays unchanged during later steps."""
        with self.opened() as env:
            result = env.reset(seed=self.seed)
            kept = _copied(values_of(result))
            for action in self.actions(env)[:20]:
                result_before, kept_before = result, kept
                result = _step(env, action)
                kept = _copied(values_of(result))
                assert same(values_of(result_before), kept_before)
                if _awaits_reset(env, kept):
                    break

    def test_bare_steps_are_steps(self) -> None:
        """`bare_step`, where there is one, gives what `step` gives."""
        with self.opened() as env, self.opened() as other:
            bare = fast_path_of(other).bare_step()
            if bare is None:
                return
            env.reset(seed=self.seed)
            other.reset(seed=self.seed)
            for action in self.actions(env):
                outcome = values_of(_step(env, action))
                assert same(outcome, tuple(map(as_numpy, bare(action)[:4])))
                if _awaits_reset(env, outcome):
                    break

    def test_torch_actions_are_taken(self) -> None:
        """An action may be a torch tensor, with the same effect as the array."""
        torch = pytest.importorskip("torch")
        with self.opened() as env, self.opened() as other:
            env.reset(seed=self.seed)
            other.reset(seed=self.seed)
            for action in self.actions(env)[:3]:
                assert same(
                    values_of(_step(env, action)),
                    values_of(_step(other, mapped(torch.as_tensor, action))),
                )

    def test_it_is_the_bare_simulator(self) -> None:
        """The env gives what the simulator gives, bit for bit."""
        with self.opened() as env:
            actions = self.actions(env)
            expected = list(self.simulate(actions))
            assert len(expected) == len(actions) + 1
            for index, (one, other) in enumerate(
                zip(outcomes_of(env, actions, self.seed), expected, strict=True)
            ):
                assert same(one, other), f"outcome {index}: {one} is not {other}"


def outcomes_of(env: BaseEnv, actions: Sequence[Any], seed: int) -> Iterator[Expected]:
    """Yield the env's outcomes of a reset with `seed` and of each action.

    As in `EnvContract.simulate`, a reset takes the place of the step after the end of an episode,
    unless the env resets itself.
    """
    yield values_of(env.reset(seed=seed))
    ended = False
    for action in actions:
        outcome = values_of(env.reset() if ended else _step(env, action))
        ended = _awaits_reset(env, outcome)
        yield outcome


def values_of(result: Any) -> Expected:
    """Return observation, reward and ends of a result, without torch tensors."""
    assert isinstance(result, EnvRet | MultiAgentEnvRet), f"not a result: {result}"
    ends = result.last_terminated, result.last_truncated
    observation, reward, terminated, truncated = map(
        as_numpy, (result.observation, result.last_reward, *ends)
    )
    return observation, reward, terminated, truncated


def same(one: Any, other: Any) -> bool:
    """Return True if two values agree in structure, shapes and every bit; NaN equals NaN."""
    if isinstance(one, dict):
        return (
            isinstance(other, dict)
            and one.keys() == other.keys()
            and all(same(value, other[key]) for key, value in one.items())
        )
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    array = np.asarray(one)
    return np.array_equal(array, np.asarray(other), equal_nan=array.dtype.kind == "f")


def _check_membership(task: str, observation: Any, space: gym.Space[Any]) -> None:
    if said := out_of_bounds(space, observation, "an observation"):
        warnings.warn(f"task {task!r}: {said}", stacklevel=2)
    else:
        assert space.contains(observation), f"observation not in {space}: {observation}"


def _check_columns(outcome: Expected, agents: tuple[str, ...], shape: tuple[int, ...]) -> None:
    """Check that rewards and flags have one entry for each agent and sub-environment."""
    for name, value in zip(("reward", "terminated", "truncated"), outcome[1:], strict=True):
        arrays = list(map(np.asarray, _entries(value, agents)))
        assert {one.shape for one in arrays} == {shape}, f"{name}: {value}"
        if name != "reward":
            assert {one.dtype.kind for one in arrays} == {"b"}, f"{name} is not boolean: {value}"


def _step(env: BaseEnv, action: Any) -> Any:
    return step_of(env)(PolicyResponse(env.env_id, action))


def _entries(value: Any, agents: Sequence[str]) -> list[Any]:
    """Return the values of all agents in their order, or the one value of a single-agent env."""
    if not isinstance(value, dict):
        assert not agents, f"not by agent: {value}"
        return [value]
    assert not agents or tuple(value) == tuple(agents), f"not of {agents}: {value}"
    return list(value.values())


def _awaits_reset(env: BaseEnv, outcome: Expected) -> bool:
    """Return True if all have ended, and the env does not reset itself."""
    if env.autoreset != "disabled":
        return False
    _, _, terminated, truncated = outcome
    flags = zip(_entries(terminated, ()), _entries(truncated, ()), strict=True)
    return all(bool(np.all(np.logical_or(one, other))) for one, other in flags)


def _copied(value: Any) -> Any:
    return mapped(lambda one: np.array(one, copy=True), value)
