"""Custom env classes: what they may omit, return and declare."""

from __future__ import annotations

import sys
import warnings
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from kit.scripted import Counts

from rlightning_aio import (
    ENVS,
    BaseEnv,
    BatchedData,
    EnvConfig,
    EnvRaised,
    EnvRet,
    MultiAgentEnvRet,
    PolicyResponse,
    sync,
)
from rlightning_aio.types import default_env_preprocess_fn

if TYPE_CHECKING:
    from collections.abc import Iterator

NAMES = ("tacit", "listing", "later", "crowd of two")


class Tacit(BaseEnv):
    """Omits whatever has a default: metadata of `init`, and rewards and ends of `step`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.steps = 0

    def init(self) -> None:
        self.steps = 100

    def get_observation_space(self) -> gym.Space[Any]:
        return spaces.Box(-999, 999, (self.num_envs, 1) if self.num_envs > 1 else (1,))

    def get_action_space(self) -> gym.Space[Any]:
        return (
            spaces.MultiDiscrete([9] * self.num_envs) if self.num_envs > 1 else spaces.Discrete(9)
        )

    def _observation(self) -> Any:
        return np.full(self.get_observation_space().shape, self.steps, np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return EnvRet(env_id=self.env_id, observation=self._observation())

    def step(self, policy_resp: PolicyResponse) -> Any:
        self.steps += 1
        return EnvRet(env_id=self.env_id, observation=self._observation())


class Listing(Tacit):
    """Returns a list with a result for each sub-environment, or with another number of results."""

    def _listed(self, **fields: Any) -> list[EnvRet]:
        return [
            EnvRet(
                env_id=f"{self.env_id}/{k}",
                observation=np.array([k], np.float32),
                info={"k": k},
                **{name: values[k] for name, values in fields.items()},
            )
            for k in range(self.config.env_kwargs.get("answers", self.num_envs))
        ]

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return self._listed()

    def step(self, policy_resp: PolicyResponse) -> Any:
        action = np.atleast_1d(self._preprocess_fn(policy_resp))
        return self._listed(last_reward=action, last_terminated=action > 5)


class Later(Tacit):
    """Implements only the two halves of a step."""

    def step(self, policy_resp: PolicyResponse) -> Any:
        raise NotImplementedError("use step_async and collect_async")

    def step_async(self, policy_resp: PolicyResponse) -> None:
        self.steps += 1
        self.answer = float(self._preprocess_fn(policy_resp)), getattr(policy_resp, "tag", None)

    def collect_async(self) -> Any:
        reward, tag = self.answer
        info = {} if tag is None else {"tag": tag}
        return [
            EnvRet(
                env_id=self.env_id, observation=self._observation(), last_reward=reward, info=info
            )
        ]


class CrowdOfTwo(Tacit):
    """Two agents that report only observations."""

    agents = ("a", "b")

    def get_observation_space(self) -> gym.Space[Any]:
        return spaces.Dict(a=spaces.Discrete(9), b=spaces.Discrete(9))

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return MultiAgentEnvRet(env_id=self.env_id, observation={"a": 1, "b": 2})

    def step(self, policy_resp: PolicyResponse) -> Any:
        return self.reset()


@pytest.fixture(autouse=True)
def backends() -> Iterator[None]:
    for name, kind in zip(NAMES, (Tacit, Listing, Later, CrowdOfTwo), strict=True):
        ENVS.register(name, cpu_bound=name == "tacit")(kind)
    yield
    for name in NAMES:
        ENVS._classes.pop(name)
        ENVS._cpu_bound.pop(name, None)


def entry(backend: str, **fields: Any) -> dict[str, Any]:
    return {"name": backend, "backend": backend, "task": "-", "placement": "inline", **fields}


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_an_env_may_leave_out_what_has_a_default(placement: str) -> None:
    """Metadata, rewards and ends, of each sub-environment and agent; results may be in a list."""
    entries = [
        entry("tacit", num_envs=3),
        entry("listing", num_envs=3),
        entry("later"),
        entry("crowd of two"),
    ]
    placed = [{**one, "placement": placement} for one in entries]
    with sync.build_env_group(placed, mixed_actions=True) as group:
        group.reset()
        tacit, listing, later, crowd = (group[id_] for id_ in group.env_ids)
        ret: Any = tacit.step(np.zeros(3, int))
        assert ret.observation.tolist() == [[101]] * 3
        for value, dtype in (
            (ret.last_reward, float),
            (ret.last_terminated, bool),
            (ret.last_truncated, bool),
        ):
            assert (value.tolist(), value.dtype) == ([0] * 3, dtype)
        ret = listing.reset()
        assert ret.observation.tolist() == [[0], [1], [2]]
        assert ret.last_reward.tolist() == [0, 0, 0]
        ret = listing.step(np.array([2, 8, 4]))
        assert ret.last_reward.tolist() == [2, 8, 4]
        assert ret.last_terminated.tolist() == [False, True, False]
        assert ret.info["k"].tolist() == [0, 1, 2]
        ret = later.step(PolicyResponse("later-0", 4, tag="x"))
        assert (ret.last_reward, ret.info, ret.observation.tolist()) == (4.0, {"tag": "x"}, [101])
        ret = later.step(3)
        assert (ret.last_reward, ret.info) == (3.0, {})
        ret = crowd.step(0)
        assert ret.last_reward == {"a": 0.0, "b": 0.0}
        assert ret.last_terminated == ret.last_truncated == {"a": False, "b": False}


@pytest.mark.parametrize("space", [gym.spaces.Dict(), gym.spaces.Tuple(())])
def test_an_action_space_may_be_empty(space: gym.Space[Any]) -> None:
    """Such an env acts without a choice."""

    class Clock(Counts):
        action_space = space

        def does(self, action: Any) -> float:
            return float(action == space.sample())

    clock = {"name": "clock", "task": Clock, "num_workers": 2}
    with sync.build_env_group({**clock, "envs_per_process": 2}) as group:
        batch, _ = group.reset()
        for now in (1, 2):
            batch, _ = group.step(batch.respond(action=[space.sample()] * 2))
            assert batch.observation.tolist() == [[now]] * 2
            assert batch.reward.tolist() == [1.0] * 2


def test_a_list_of_the_wrong_length_is_refused() -> None:
    """The error has the found and the expected number of results."""
    message = r"reset\(\) of env 'listing-0' returned a list of 2 .*3"
    listing = entry("listing", num_envs=3, env_kwargs={"answers": 2})
    with sync.build_env_group(listing) as group, pytest.raises(EnvRaised, match=message):
        group.reset()


class Tensor:
    """Has what distinguishes a torch tensor from other values."""

    __module__ = "torch"

    def detach(self) -> None: ...


def test_defaults_also_hold_for_envs_that_return_tensors() -> None:
    """Only the observation bypasses the row."""

    class OfTensors(Tacit):
        def _observation(self) -> Any:
            return Tensor()

    ENVS.register("tacit")(OfTensors)
    with sync.build_env_group(entry("tacit", num_envs=3)) as group:
        batch, _ = group.reset()
        batch, _ = group.step(batch.respond(action=np.zeros((1, 3), int)))
        ret: Any = batch.values()[0]
    assert type(ret.observation) is Tensor
    assert ret.last_reward.tolist() == [0, 0, 0]
    assert ret.last_truncated.tolist() == [False] * 3


def test_envs_of_a_cpu_bound_class_share_workers() -> None:
    """There are as many workers as cores; any other class has one for each env."""
    count = 1000
    shared = sync.build_env_group(entry("tacit", placement="process", num_workers=count))
    alone = sync.build_env_group(entry("later", placement="process", num_workers=7))
    assert 1 <= len(shared.get_workers()) < count
    assert len(alone.get_workers()) == 7


def test_memory_is_cleared_without_importing_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch's cache is emptied if torch is imported and has a device."""
    available, emptied = [False], list[bool]()
    cuda = SimpleNamespace(
        is_available=lambda: available[0], empty_cache=lambda: emptied.append(True)
    )
    env = Tacit(EnvConfig.model_validate(entry("tacit")))
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    env.clear_memory()
    assert "torch" not in sys.modules
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(cuda=cuda))  # type: ignore[arg-type]
    for available[0] in (False, True):
        env.clear_memory()
    assert emptied == [True]


def test_only_a_function_that_is_given_to_an_env_server_is_warned_of() -> None:
    """None and the default function need nothing that an env_server lacks."""
    server = {"name": "robots", "backend": "env_server"}
    entries = [entry("tacit"), server]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for function in (None, default_env_preprocess_fn, [len, None]):
            sync.build_env_group(entries, preprocess_fn=function)
    for function in (len, [None, len]):
        with pytest.warns(UserWarning, match="'robots': preprocess_fn is ignored") as caught:
            sync.build_env_group(env_cfgs=entries, preprocess_fn=function)
        assert caught[0].filename == __file__


def idle_steps(group: sync.EnvGroup) -> BatchedData:
    actions = (np.zeros(3, int), 1, 1)
    pairs = zip(group.env_ids, actions, strict=True)
    return BatchedData(group.env_ids, [PolicyResponse(*pair) for pair in pairs])


def test_env_steps_count_sub_environments_but_no_resets() -> None:
    """A batch of several layouts is one batch."""
    entries = [entry("tacit", num_envs=3), entry("later", num_workers=2)]
    with sync.build_env_group(entries, mixed_actions=True) as group:
        group.reset()
        group.reset()
        stats = group.get_stats()
        assert stats["steps_per_second"] == 0.0
        for _ in range(4):
            for env_id, action in zip(group.env_ids, (np.zeros(3, int), 1, 1), strict=True):
                group[env_id].step(action)
        stats = group.get_stats()
        assert stats["batch_size"] == (3 + 3 + 12) / 14
        rates = stats["entries"]
        assert rates["tacit"] == pytest.approx(3 * 4 / (2 * 4) * rates["later"])
        assert stats["steps_per_second"] == pytest.approx(sum(rates.values()))
        before = group.metrics()["envs/steps"]
        with group.auto_reset(max_episode_steps=1):
            for _ in range(2):
                batch, _ = group.step(idle_steps(group))
        assert all(part.is_reset.all() for part in batch.by_entry().values())
        assert group.metrics()["envs/steps"] == before + 3 + 1 + 1
