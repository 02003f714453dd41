"""Envs in Ray actors do what they do anywhere else, beside those that live elsewhere."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from hosts import beside_others
from hosts.beside_others import (
    steps,
)

from rlightning_aio import ENVS, BaseEnv, EnvRet
from rlightning_aio.errors import ConfigError, StartFailed

if TYPE_CHECKING:
    from pathlib import Path

    from kit.driven import Place

pytestmark = pytest.mark.ray


def entry(name: str, backend: str = "probe", placement: str = "ray", **fields: Any) -> Any:
    return beside_others.entry(name, backend, placement, **fields)


def wide() -> type[gym.Env[Any, Any]]:
    """A class that no module holds, as that of a notebook's."""

    class Wide(gym.Env[Any, Any]):
        """Observations too large for a message of Ray's, which go through its object store."""

        observation_space = gym.spaces.Box(-1, 1, (512, 1024), np.float64)
        action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

        def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
            return np.zeros(self.observation_space.shape), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            observation = np.full(self.observation_space.shape, action[0])
            return observation, 0.0, False, False, {}

    return Wide


async def test_envs_of_several_layouts_share_an_actor(sync_facade: Place) -> None:
    """Each has its row among those like it; large observations cross as well."""
    makers = [lambda: gym.make("CartPole-v1"), wide()] * 2
    config = {"name": "mixed", "task": makers, "num_workers": 4, "placement": "ray"}
    async with sync_facade.build({**config, "envs_per_process": 4}, mixed_actions=True) as group:
        await group.reset(seed=3)
        with gym.make("CartPole-v1") as bare:
            bare.reset(seed=5)
            expected = bare.step(1)[0]
        batch, _ = await group.step(steps(mixed_0=0, mixed_1=[0.5], mixed_2=1, mixed_3=[0.25]))
        np.testing.assert_array_equal(batch["mixed-2"].observation, expected)
        for env_id, value in (("mixed-1", 0.5), ("mixed-3", 0.25)):
            assert batch[env_id].observation.shape == (512, 1024)
            assert (batch[env_id].observation == value).all()


async def test_what_the_user_wrote_reaches_the_actor(
    sync_facade: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A class and functions that no module holds, environment variables, imports."""

    class Local(BaseEnv):
        def get_observation_space(self) -> gym.Space[Any]:
            return gym.spaces.Box(-1, 1, (1,))

        get_action_space = get_observation_space

        def reset(self, seed: int | None = None, options: Any = None) -> EnvRet:
            return EnvRet(
                env_id=self.env_id,
                observation=np.zeros(1),
                info={"env": os.environ["FROM_THE_ENTRY"]},
            )

        def step(self, policy_resp: Any) -> EnvRet:
            imported = "colorsys" in sys.modules
            return EnvRet(
                env_id=self.env_id,
                observation=np.ones(1),
                last_reward=self._preprocess_fn(policy_resp),
                info={"is": imported},
            )

    monkeypatch.setitem(ENVS._classes, "local", Local)
    fields = {"env_vars": {"FROM_THE_ENTRY": "7"}, "imports": ["colorsys"]}
    async with sync_facade.build(
        entry("one", "local", **fields), preprocess_fn=lambda response: response.action[0] * 10
    ) as group:
        batch, _ = await group.reset()
        assert batch.values()[0].info == {"env": "7"}
        batch, _ = await group.step(steps(one_0=np.array([0.5])))
        assert batch.reward.tolist() == [5.0]
        assert batch.values()[0].info == {"is": True}


async def test_an_actor_without_a_place_says_what_it_asked_for(sync_facade: Place) -> None:
    asked = entry(
        "big", start_timeout=1, num_cpus=3, num_gpus=2, ray_options={"resources": {"robot": 1}}
    )
    with pytest.raises(
        StartFailed,
        match=r"env 'big-0'.* did not start within 1\.0 s \(it could not be placed: it asks for "
        r"num_cpus=3\.0, num_gpus=2\.0, resources=\{'robot': 1\}\)",
    ):
        await sync_facade.build(asked).init()


async def test_a_node_that_lacks_the_package_says_so(sync_facade: Place, tmp_path: Path) -> None:
    (tmp_path / "rlightning_aio.py").write_text("raise ModuleNotFoundError('no rlightning_aio')")
    lacking = entry("one", env_vars={"PYTHONPATH": str(tmp_path)})
    with pytest.raises(StartFailed, match=r"was lost: .*no rlightning_aio"):
        await sync_facade.build(lacking).init()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"num_cpus": 2}, r"ray_options.num_cpus: leave it out; it is a field of the entry"),
        ({"lifetime": "detached"}, "ray_options.lifetime: .* outlive the trainer"),
        ({"num_gpu": 2}, "entry 'one', ray_options: Invalid option keyword num_gpu"),
        ({"resources": 3}, "entry 'one', ray_options: .*resources"),
    ],
)
def test_options_that_mean_nothing_are_refused(
    options: dict[str, Any], said: str, sync_facade: Place
) -> None:
    """Before anything starts."""
    with pytest.raises(ConfigError, match=said):
        sync_facade.build(entry("one", ray_options=options))
