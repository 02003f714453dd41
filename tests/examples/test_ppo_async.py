"""The asynchronous examples: learning beside the collection stays near."""

from __future__ import annotations

import asyncio
import importlib
import multiprocessing
from multiprocessing import resource_tracker
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

if TYPE_CHECKING:
    from types import ModuleType

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.simulators

EXAMPLES = Path(__file__).parents[2] / "examples"
SHORT: dict[str, Any] = {
    "placement": "process", "num_envs": 4, "envs_each": 1, "num_steps": 32, "total_steps": 512,
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def tracker_of_multiprocessing() -> None:
    """It lives as long as the process that has once spawned another: no test leaves it behind."""
    resource_tracker.ensure_running()


@pytest.fixture
def ppo_async(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module("ppo_async")


@pytest.fixture
def ppo_overlap(ppo_async: ModuleType) -> ModuleType:
    return importlib.import_module("ppo_overlap")


def test_learning_beside_the_collection_lags_by_one_version(
    ppo_overlap: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nothing that is learned from was chosen by a policy before the last but one."""
    lags, kept = [], []
    columns_of, learn = ppo_overlap.Learner.columns, ppo_overlap.LearnerProcess.learn

    def columns(learner: Any, rollout: Any) -> dict[str, Any]:
        lags.append(len(lags) - rollout.policy_version)
        return columns_of(learner, rollout) | {"lag": torch.from_numpy(lags[-1].copy())}

    async def noted(process: Any, columns: dict[str, Any], rate: float) -> dict[str, float]:
        kept.append(columns.pop("lag").numpy())
        return await learn(process, columns, rate)

    monkeypatch.setattr(ppo_overlap.Learner, "columns", columns)
    monkeypatch.setattr(ppo_overlap.LearnerProcess, "learn", noted)
    asyncio.run(ppo_overlap.train(ppo_overlap.CartPole(folder=str(tmp_path), **SHORT)))
    assert len(kept) == 4
    for lag, learned in zip(lags, kept, strict=True):
        np.testing.assert_array_equal(learned, lag[lag <= 1])
        assert len(learned) >= len(lag) - 4


def learner_of(example: ModuleType, folder: Path) -> Any:
    torch.manual_seed(1)
    args = example.CartPole(folder=str(folder), **SHORT)
    group = SimpleNamespace(
        get_observation_spaces=lambda: [Box(-1.0, 1.0, (4,), np.float32)],
        get_action_spaces=lambda: [Discrete(2)],
    )
    return example.Learner(args, group, SimpleNamespace(saved={}, steps=0))


def made_up_columns() -> dict[str, Any]:
    random = torch.Generator().manual_seed(0)
    one_each = ("log_prob", "value", "advantage", "target")
    return {
        "observation": torch.randn(128, 4, generator=random),
        "action": torch.randint(2, (128,), generator=random),
        **{name: torch.randn(128, generator=random) for name in one_each},
    }


def test_a_learner_in_its_own_process_learns_the_same(
    ppo_overlap: ModuleType, tmp_path: Path
) -> None:
    """Figures, weights, optimiser and random numbers are those of learning here."""
    here = learner_of(ppo_overlap, tmp_path)
    figures = [here.learn(made_up_columns(), rate) for rate in (1e-3, 1e-4)]
    expected = here.state()

    async def apart() -> tuple[list[Any], dict[str, Any]]:
        there = learner_of(ppo_overlap, tmp_path)
        async with ppo_overlap.LearnerProcess(there) as process:
            found = [await process.learn(made_up_columns(), rate) for rate in (1e-3, 1e-4)]
            return found, there.state() | await process.state()

    found, state = asyncio.run(apart())
    assert found == figures
    for part in ("agent", "optimizer", "random"):
        torch.testing.assert_close(state[part], expected[part], rtol=0, atol=0)


def test_a_learner_whose_process_dies_is_told_of(ppo_overlap: ModuleType, tmp_path: Path) -> None:
    async def end() -> None:
        async with ppo_overlap.LearnerProcess(learner_of(ppo_overlap, tmp_path)) as process:
            (child,) = multiprocessing.active_children()
            child.kill()
            child.join()
            with pytest.raises(RuntimeError, match="learner's process has ended"):
                await process.learn(made_up_columns(), 1e-3)

    asyncio.run(end())
