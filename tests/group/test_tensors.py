"""Torch tensors in observations: unchanged inline, NumPy on the CPU from a process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium import spaces

from rlightning_aio import ENVS, BaseEnv, BatchedData, EnvRet, PolicyResponse, sync

if TYPE_CHECKING:
    from collections.abc import Iterator

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.simulators


class TensorEnv(BaseEnv):
    """Counts in one tensor; an episode has two steps."""

    def get_observation_space(self) -> Any:
        return spaces.Dict(count=spaces.Box(-9, 9, (2,)), index=spaces.Discrete(9))

    def get_action_space(self) -> Any:
        return spaces.Box(-1, 1, (2,))

    def _result(self, **fields: Any) -> EnvRet:
        observation = {"count": self.count.clone(), "index": torch.tensor(self.worker_index)}
        return EnvRet(env_id=self.env_id, observation=observation, **fields)

    def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:
        self.count = torch.zeros(2)
        return self._result()

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        self.count += torch.as_tensor(policy_resp.action)
        ended = self.count.sum() >= 4
        return self._result(
            last_reward=self.count.sum(),
            last_terminated=ended,
            info={"tensor": self.count.clone()},
            _extra={"k": 1},
        )


@pytest.fixture(params=["inline", "process"])
def group(request: pytest.FixtureRequest) -> Iterator[Any]:
    ENVS.register("tensors")(TensorEnv)
    entry = {"name": "t", "backend": "tensors", "task": "x", "num_workers": 2}
    with sync.build_env_group({**entry, "placement": request.param}) as group:
        group.reset()
        yield group, torch.Tensor if request.param == "inline" else np.ndarray


def test_results_have_the_type_that_their_placement_gives(group: Any) -> None:
    """In columns and single results, also in the step that ends an episode."""
    group, kind = group
    for step in (1, 2):
        actions = np.ones((2, 2), np.float32)
        actions = actions if step == 1 else torch.ones(2, 2)
        responses = [PolicyResponse(f"t-{k}", action) for k, action in enumerate(actions)]
        batch, _ = group.step(BatchedData(group.env_ids, responses))
        assert isinstance(batch.observation["count"], kind)
        assert batch.observation["count"].tolist() == [[step, step]] * 2
        assert batch.observation["index"].tolist() == [0, 1]
        assert batch.reward.tolist() == [2.0 * step] * 2
        assert batch.terminated.tolist() == [step == 2] * 2
        value = batch["t-1"]
        assert isinstance(value.observation["count"], kind)
        assert isinstance(value.info["tensor"], np.ndarray)
        assert value._extra == {"k": 1}
        assert ("episode" in value.info) == (step == 2)
    assert value.info["episode"] == {"r": 6.0, "l": 2}
