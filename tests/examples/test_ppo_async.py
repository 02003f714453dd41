"""The asynchronous examples: a run is repeated by its record, and learning beside it stays near."""

from __future__ import annotations

import asyncio
import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rlightning_aio.collecting import Collector, RecordedGroup, ReplayedGroup

if TYPE_CHECKING:
    from types import ModuleType

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.simulators

EXAMPLES = Path(__file__).parents[2] / "examples"
SHORT: dict[str, Any] = {
    "placement": "process", "num_envs": 4, "envs_each": 1, "num_steps": 32, "total_steps": 512,
}  # fmt: skip


@pytest.fixture
def ppo_async(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module("ppo_async")


def test_a_run_is_repeated_by_its_record(
    ppo_async: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Weights, normaliser and returns are the same to the bit, whoever is ready first."""
    recorded: list[Any] = []

    def weights(group_in_front: Any, folder: str) -> dict[str, Any]:
        def collector(group: Any, policy: Any, **options: Any) -> Any:
            recorded.append(group_in_front(group))
            return Collector(recorded[-1], policy, **options)

        monkeypatch.setattr(ppo_async, "Collector", collector)
        args = ppo_async.CartPole(folder=str(tmp_path / folder), normalize=True, **SHORT)
        asyncio.run(ppo_async.train(args))
        return torch.load(tmp_path / folder / "checkpoint.pt", weights_only=True)

    once = weights(RecordedGroup, "recorded")
    again = weights(lambda group: ReplayedGroup(group, recorded[0].record), "replayed")
    for part in ("agent", "normalizer"):
        for name, value in once[part].items():
            assert torch.equal(again[part][name], value), name
    returns = [[row["return"] for row in saved["run"]["rows"]] for saved in (once, again)]
    np.testing.assert_array_equal(*returns)


def test_learning_beside_the_collection_lags_by_one_version(
    ppo_async: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nothing that is learned from was chosen by a policy before the last but one."""
    overlap = importlib.import_module("ppo_overlap")
    lags, kept = [], []
    plain = overlap.Learner

    class Learner(plain):
        """Notes how old what it learns from is, and learns nothing until a rollout is there."""

        def columns(self, rollout: Any) -> dict[str, Any]:
            lags.append(len(lags) - rollout.policy_version)
            return {**super().columns(rollout), "lag": torch.from_numpy(lags[-1].copy())}

        def learn(self, columns: dict[str, Any], rate: float) -> dict[str, float]:
            kept.append(columns.pop("lag").numpy())
            return super().learn(columns, rate)

    monkeypatch.setattr(overlap, "Learner", Learner)
    asyncio.run(overlap.train(overlap.CartPole(folder=str(tmp_path), **SHORT)))
    assert len(kept) == 4
    for lag, learned in zip(lags, kept, strict=True):
        np.testing.assert_array_equal(learned, lag[lag <= 1])
        assert len(learned) >= len(lag) - 4
