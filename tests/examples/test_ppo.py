"""The synchronous example learns what CleanRL's loop on Gymnasium's vector environments learns."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from types import ModuleType

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.simulators

ROOT = Path(__file__).parents[2]


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    """The example, its parts, and the baseline."""
    for folder in (ROOT / "examples", Path(__file__).parent):
        monkeypatch.syspath_prepend(folder)
    names = ("ppo", "training_run", "gymnasium_ppo")
    return {name: importlib.import_module(name) for name in names}


@pytest.mark.parametrize(
    ("preset", "changed"),
    [
        # Three episodes, of 1,000 steps, end in it. Each of several envs would have statistics of
        # its own there.
        ("Args", {"num_envs": 1, "num_steps": 64, "num_minibatches": 4, "epochs": 2}),
        ("CartPole", {"num_steps": 32}),
    ],
)
def test_weights_equal_the_baselines(
    preset: str, changed: dict[str, Any], modules: dict[str, ModuleType], tmp_path: Path
) -> None:
    """After fifty updates they do to the bit, and so do the returns on the way."""
    make = getattr(modules["ppo"], preset)
    size = changed.get("num_envs", 4) * changed.get("num_steps", 128)
    args = make(total_steps=50 * size, folder=str(tmp_path), **changed)
    ours = modules["ppo"].train(args)
    weights = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["agent"]
    theirs, agent = modules["gymnasium_ppo"].train(args)
    assert weights.keys() == agent.state_dict().keys()
    for name, value in agent.state_dict().items():
        assert torch.equal(weights[name], value), name
    returns = [[row["return"] for row in run.rows] for run in (ours, theirs)]
    np.testing.assert_allclose(*returns, rtol=1e-6)
    assert np.isfinite(returns[0][-1])
