"""`configs/zoo.yaml`: six simulators in one group, each at its own pace.

Isaac Lab runs under the Python that the variable ISAAC_PYTHON names, all others under the
one that runs these tests.
"""

from __future__ import annotations

import os
import subprocess
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from envs.closing_table import ROOT, closing_table

import rlightning_aio as rl
from rlightning_aio import sync

if TYPE_CHECKING:
    import gymnasium as gym

    from rlightning_aio import BatchedData

for simulator in ("ale_py", "mani_skill", "mpe2", "piper_sdk"):
    pytest.importorskip(simulator)

ISAAC_PYTHON = os.environ.get("ISAAC_PYTHON", "")
ZOO = ROOT / "configs" / "zoo.yaml"
NAMES = ["cheetah", "pong", "pick_cube", "isaac_cartpole", "spread", "piper"]
ISAAC = NAMES.index("isaac_cartpole")
RESULTS, LEAST, MOST = 1000, 10, 500
"""In all; of each entry; and after how many an entry rests, to leave the cores to the slow."""
NO_LIMIT = 10**6

pytestmark = [
    pytest.mark.simulators,
    pytest.mark.timeout(600),  # Kernels are compiled the first time.
    pytest.mark.skipif(not ISAAC_PYTHON, reason="ISAAC_PYTHON names no Python with Isaac Lab"),
]


@pytest.fixture
def overrides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Overrides of the config for tests, where Isaac Lab has no network for its assets."""
    assets = tmp_path / "assets"
    script = Path(__file__).with_name("isaac_assets.py")
    subprocess.run([ISAAC_PYTHON, script, assets], check=True)
    monkeypatch.setenv("ISAACSIM_ASSET_ROOT", str(assets))
    monkeypatch.chdir(ROOT)
    return [f"envs.{ISAAC}.interpreter={ISAAC_PYTHON}"]


def check(part: BatchedData, spaces: dict[str, gym.Space[Any]]) -> None:
    """Columns are as long as the batch, and each observation is in the space of its env."""
    space = spaces[part.ids()[0]]
    for array in leaves(part.observation):
        assert len(array) == len(part)
    for env_id, ret in part:
        assert ret.env_id == env_id
        assert spaces[env_id] == space
        assert space.contains(ret.observation)


def actions(part: BatchedData, spaces: dict[str, gym.Space[Any]]) -> list[Any]:
    """A random action for each result; zeros for Isaac Lab's cart, whose actions are unbounded."""
    if part.ids() == ["isaac_cartpole-0"]:
        return [np.zeros((16, 1), np.float32)]
    return [spaces[env_id].sample() for env_id in part.ids()]


def leaves(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [leaf for part in value.values() for leaf in leaves(part)]
    return [value]


# Episodes end by the envs' own limits here.
@pytest.mark.filterwarnings("ignore:.*overrides the limits")
async def test_six_simulators_are_collected_as_they_answer(overrides: list[str]) -> None:
    """Results go to their entries; slow ones delay no other, and all take part."""
    counts: Counter[str] = Counter(dict.fromkeys(NAMES, 0))
    partial = 0
    group = rl.build_env_group(rl.load_config(ZOO, overrides), mixed_actions=True)
    async with group:
        spaces = dict(zip(group.env_ids, group.get_observation_spaces(), strict=True))
        action_spaces = dict(zip(group.env_ids, group.get_action_spaces(), strict=True))
        batch, _ = await group.reset(seed=0)
        assert batch.ids() == group.env_ids
        with group.auto_reset(NO_LIMIT):
            for part in batch.by_entry().values():
                group.step_async(part.respond(action=actions(part, action_spaces)))
            while counts.total() < RESULTS or min(counts.values()) < LEAST:
                batch, _ = await group.collect_async()
                parts = batch.by_entry()
                # In lockstep every collect returns results of all, until the first entry rests.
                partial += len(parts) < len(NAMES) and max(counts.values()) < MOST
                for name, part in parts.items():
                    assert {id_.rpartition("-")[0] for id_ in part.ids()} == {name}
                    check(part, spaces)
                    counts[name] += len(part)
                    if counts[name] < MOST:
                        group.step_async(part.respond(action=actions(part, action_spaces)))
    assert list(counts) == NAMES
    assert partial


def test_each_entry_has_its_own_columns(overrides: list[str]) -> None:
    """`by_entry` separates values that don't stack: arrays, images, dicts by part or by agent."""
    with sync.build_env_group(rl.load_config(ZOO, overrides), mixed_actions=True) as group:
        parts = group.reset(seed=0)[0].by_entry()
    assert list(parts) == NAMES
    shapes = {
        name: [np.shape(array) for array in leaves(parts[name].observation)] for name in NAMES
    }
    assert shapes["cheetah"] == [(4, 17)]
    assert shapes["pong"] == [(2, 4, 84, 84)]
    assert shapes["pick_cube"] == [(1, 42)]
    assert shapes["isaac_cartpole"] == [(1, 16, 4)]
    assert shapes["spread"] == [(2, 18)] * 3
    assert sorted(shapes["piper"]) == [(1, 1), (1, 6), (1, 6)]
    assert [np.shape(array) for array in leaves(parts["spread"].reward)] == [(2,)] * 3
    assert np.shape(parts["isaac_cartpole"].reward) == (1, 16)


def test_the_example_ends_with_its_table(overrides: list[str]) -> None:
    """The whole zoo runs from the command line, with a column for each entry at the end."""
    table = closing_table("zoo", *overrides, "--steps", "2000")
    assert set(NAMES) <= set(table["all"])
