"""Names that are the library's and names that are an env's don't collide; nor do their objects."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import pytest
from kit.driven import Driven

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.errors import ConfigError
from rlightning_aio.vector import VectorEnv


class Named(gym.Env[int, int]):
    """A method and an info with names of the library's."""

    observation_space: Any = gym.spaces.Discrete(9)
    action_space: Any = gym.spaces.Discrete(2)

    def named(self, *, env_ids: str, name: str = "", args: str = "", kwargs: str = "") -> list[str]:
        return [env_ids, name, args, kwargs]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        del options
        return 0, {"": 1, "text": "a"}

    def step(self, action: int) -> Any:
        del action
        return 1, 1.0, False, False, {"": 2}


ENTRY = {"name": "e", "backend": "callable", "task": Named, "num_workers": 2}


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_any_method_can_be_called(placement: str) -> None:
    group = Driven("sync", {**ENTRY, "placement": placement})
    group.init()
    kwargs = {"env_ids": "a", "name": "b", "args": "c", "kwargs": "d"}
    found = group.group.call_with("named", (), kwargs, ["e-1"])
    assert found == [["a", "b", "c", "d"]]
    assert group.group["e-0"].call("named", **kwargs) == [*"abcd"]
    group.end()


async def test_any_method_can_be_called_with_await() -> None:
    async with rl.build_env_group(ENTRY) as group:
        assert await group.call_with("named", kwargs={"env_ids": "a"}) == [["a", "", "", ""]] * 2


def test_any_method_can_be_called_through_a_vector_env() -> None:
    envs = VectorEnv([Named, Named])
    assert envs.call("named", env_ids="a", args="c") == (["a", "", "c", ""],) * 2
    envs.close()


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_an_info_may_have_any_key(placement: str) -> None:
    with sync.build_env_group({**ENTRY, "placement": placement}) as group:
        batch, _ = group.reset()
        assert batch.infos[""].tolist() == [1, 1]
        assert batch.infos["text"].tolist() == ["a", "a"]
        batch, _ = group.step(batch.respond(action=[0, 0]))
        assert batch.infos[""].tolist() == [2, 2]
        assert batch.info() == [{"": 2}] * 2


class Conversation:
    """An awaitable env that appends to the messages that it is given."""

    observation_space: Any = rl.Anything()
    action_space: Any = gym.spaces.Discrete(2)

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del seed
        options["messages"].append("hello")
        return list(options["messages"]), {}

    async def step(self, action: int) -> Any:
        if action:
            raise RuntimeError
        return [], 0.0, False, False, {}


@pytest.mark.parametrize("placement", ["process", "loop"])
async def test_an_env_that_begins_anew_has_the_options_as_they_were_given(placement: str) -> None:
    entry = {"name": "e", "backend": "callable", "task": Conversation, "placement": placement}
    async with rl.build_env_group({**entry, "on_env_error": "restart"}) as group:
        options = {"messages": ["system"]}
        batch, _ = await group.reset(options=options)
        for _ in range(2):
            batch, _ = await group.step(batch.respond(action=[1]))
            assert batch.restarted.tolist() == [True]
            assert batch.observation == [["system", "hello"]]
        assert options == {"messages": ["system"]}


@pytest.mark.parametrize("wraps", [lambda env: env, gym.wrappers.OrderEnforcing])
@pytest.mark.parametrize(
    "fields", [{"placement": "inline"}, {"envs_per_process": 2}], ids=["inline", "worker"]
)
def test_one_object_behind_several_callables_is_refused(fields: Any, wraps: Any) -> None:
    """As DummyVecEnv does; in workers of their own, each would have a copy."""
    one = Named()
    group = sync.build_env_group({**ENTRY, "task": lambda: wraps(one), **fields})
    with pytest.raises(ConfigError, match=r"'e-0' and 'e-1' returned the same env object"):
        group.init()
    group.close()


@pytest.mark.parametrize("fields", [{"placement": "loop"}, {"envs_per_process": 2}])
async def test_one_awaitable_object_behind_several_callables_is_refused(fields: Any) -> None:
    one = Conversation()
    group = rl.build_env_group({**ENTRY, "task": lambda: one, **fields})
    with pytest.raises(ConfigError, match="returned the same env object"):
        await group.init()
    await group.close()
