"""Simulators on a CUDA GPU: their tensors stay there inline, and come as arrays from a worker.

`make test-gpu` runs these, each under the Python that has its simulator; where there is no GPU,
or another simulator, they are skipped and say so.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rlightning_aio import BatchedData, EnvConfig, PolicyResponse, sync

if TYPE_CHECKING:
    from pathlib import Path

    from rlightning_aio.types import EnvRet


def has_gpu() -> bool:
    if find_spec("torch") is None:
        return False
    import torch

    return torch.cuda.is_available()


pytestmark = [
    pytest.mark.gpu,
    pytest.mark.timeout(600),  # Kernels are compiled the first time.
    pytest.mark.filterwarnings("default"),  # The simulators warn about their own future.
    pytest.mark.skipif(not has_gpu(), reason="no CUDA GPU, or no torch that can use one"),
]
needs_isaac = pytest.mark.skipif(not find_spec("isaaclab"), reason="Isaac Lab is not here")
needs_maniskill = pytest.mark.skipif(not find_spec("mani_skill"), reason="ManiSkill is not here")

NUM_ENVS, NUM_STEPS = 16, 20


def walk(config: EnvConfig, actions: list[Any]) -> list[EnvRet]:
    """Results of a seeded reset and of each action."""
    with sync.build_env_group(config) as group:
        (env_id,) = group.env_ids
        results = [group.reset(seed=3)[0].values()[0]]
        for action in actions:
            batch, _ = group.step(BatchedData([env_id], [PolicyResponse(env_id, action)]))
            results.append(batch.values()[0])
    return results


def check_both_places(config: EnvConfig, action_size: int, part: str | None) -> None:
    """Tensors on the GPU inline, for actions on the GPU; the same numbers elsewhere."""
    import torch

    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (NUM_STEPS, NUM_ENVS, action_size)).astype(np.float32)
    inline = walk(
        config.model_copy(update={"placement": "inline"}),
        list(torch.tensor(actions, device="cuda")),
    )
    apart = walk(config.model_copy(update={"start_timeout": 300.0}), list(actions))
    for here, there in zip(inline, apart, strict=True):
        observations = here.observation, there.observation
        tensor, array = (o if part is None else o[part] for o in observations)
        assert tensor.device.type == "cuda"
        assert tensor.shape[0] == NUM_ENVS
        assert isinstance(array, np.ndarray)
        # A GPU sums contacts in any order.
        np.testing.assert_allclose(tensor.cpu().numpy(), array, rtol=1e-2, atol=1e-2)
    for here, there in zip(inline[1:], apart[1:], strict=True):
        for name in ("last_reward", "last_terminated", "last_truncated"):
            assert getattr(here, name).device.type == "cuda"
            assert getattr(there, name).shape == (NUM_ENVS,)


@needs_maniskill
def test_maniskill_batches_on_the_gpu() -> None:
    """`num_envs` above 1 is one batch of tensors."""
    config = EnvConfig(name="skill", backend="maniskill", task="PickCube-v1", num_envs=NUM_ENVS)
    check_both_places(config, action_size=8, part=None)


@needs_isaac
def test_isaac_lab_simulates_on_the_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a `device` in the config, a GPU is preferred to the CPU."""
    from envs.isaac_assets import write_assets

    monkeypatch.setenv("ISAACSIM_ASSET_ROOT", str(write_assets(tmp_path)))
    config = EnvConfig(
        name="isaac", backend="isaac_manager_based", task="Isaac-Cartpole", num_envs=NUM_ENVS
    )
    check_both_places(config, action_size=1, part="policy")
