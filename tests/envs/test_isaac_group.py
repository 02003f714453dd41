"""Isaac Lab in a group with simulators that conflict with its dependencies.

Its workers run under the Python in the variable ISAAC_PYTHON; these tests run under one that has
MuJoCo 4 and no Isaac Lab.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from envs.closing_table import closing_table, steps

from rlightning_aio import BatchedData, PolicyResponse, sync
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from rlightning_aio.types import EnvRet

PYTHON = os.environ.get("ISAAC_PYTHON", "")
MANAGER_BASED, MARL = "Isaac-Cartpole", "Isaac-Pendulum-MARL-Direct"
SEED, LENGTH = 3, 60

pytestmark = [
    pytest.mark.simulators,
    pytest.mark.timeout(600),  # The first run compiles kernels.
    pytest.mark.skipif(not PYTHON, reason="ISAAC_PYTHON names no Python with Isaac Lab"),
]


def actions(num_steps: int, num_envs: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(num_steps, num_envs, 1)).astype(np.float32)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return the folder of the assets, and the bare simulator's results for each task."""
    folder = tmp_path_factory.mktemp("bare")
    np.save(folder / "actions.npy", actions(200, 4))
    script = Path(__file__).with_name("isaac_bare.py")
    runs = {}
    for task, seed in ((MANAGER_BASED, SEED + 1), (MARL, SEED + 5)):
        out = folder / f"{task}.npz"
        command = [PYTHON, script, task, "4", str(LENGTH), str(seed)]
        command += [folder / "actions.npy", folder / "assets", out]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        runs[task] = dict(np.load(out))
    return folder / "assets", runs


def entry(backend: str, task: str, assets: Path, **fields: Any) -> dict[str, Any]:
    return {
        "name": backend,
        "backend": backend,
        "task": task,
        "num_envs": 4,
        "max_episode_steps": LENGTH,
        "interpreter": PYTHON,
        "start_timeout": 300.0,
        "close_timeout": 30.0,
        "env_vars": {"ISAACSIM_ASSET_ROOT": str(assets)},
        "env_kwargs": {"device": "cpu"},
        **fields,
    }


def test_isaac_lab_and_mujoco_4_share_a_group(bare: tuple[Path, dict[str, Any]]) -> None:
    """200 steps next to MuJoCo envs equal those of each bare simulator, bit for bit."""
    assets, expected = bare
    cheetah = {"name": "cheetah", "backend": "mujoco", "task": "HalfCheetah-v5"}
    entries = [
        cheetah,
        entry("isaac_manager_based", MANAGER_BASED, assets),
        entry("isaac_marl", MARL, assets),
    ]
    rets: dict[str, list[EnvRet]] = {}
    with sync.build_env_group(entries, mixed_actions=True) as group:
        assert group.env_ids == ["cheetah-0", "isaac_manager_based-0", "isaac_marl-0"]
        pole, pendulum = group.get_action_spaces()[1:]
        assert pole.shape == (4, 1)
        assert pendulum["pendulum"].shape == (4, 1)
        batch, _ = group.reset(seed=SEED)
        for action in actions(200, 4):
            for env_id, ret in batch:
                rets.setdefault(env_id, []).append(ret)
            chosen = {
                "cheetah-0": np.zeros(6, np.float32),
                "isaac_manager_based-0": action,
                "isaac_marl-0": {"cart": action, "pendulum": -action},
            }
            batch, _ = group.step(
                BatchedData.from_dict({k: PolicyResponse(k, v) for k, v in chosen.items()})
            )
        for env_id, ret in batch:
            rets.setdefault(env_id, []).append(ret)
        episodes = group.get_env_stats()["isaac_manager_based-0"]["episodes"]
    ours, theirs = rets["isaac_manager_based-0"], expected[MANAGER_BASED]
    np.testing.assert_array_equal(
        [ret.observation["policy"] for ret in ours], theirs["observation.policy"]
    )
    np.testing.assert_array_equal([ret.last_reward for ret in ours[1:]], theirs["reward"])
    np.testing.assert_array_equal([ret.last_terminated for ret in ours[1:]], theirs["terminated"])
    np.testing.assert_array_equal([ret.last_truncated for ret in ours[1:]], theirs["truncated"])
    assert episodes == (theirs["terminated"] | theirs["truncated"]).sum() >= 12
    ended = [ret for ret in ours if "final_obs" in ret.info]
    assert ended
    assert all(ret.info["final_obs"]["policy"].shape == (4, 4) for ret in ended)
    ours, theirs = rets["isaac_marl-0"], expected[MARL]
    for agent in ("cart", "pendulum"):
        np.testing.assert_array_equal(
            [ret.observation[agent] for ret in ours], theirs[f"observation.{agent}"]
        )
        np.testing.assert_array_equal(
            [ret.last_reward[agent] for ret in ours[1:]], theirs["reward"]
        )
    assert len(rets["cheetah-0"]) == 201


def test_errors_of_the_other_python_are_reported(bare: tuple[Path, dict[str, Any]]) -> None:
    """An error in it arrives with its message, and so does a missing Python."""
    assets, _ = bare
    with (
        pytest.raises(ConfigError, match="task 'Isaac-Cartpol' is not registered; did you mean"),
        sync.build_env_group(entry("isaac_manager_based", "Isaac-Cartpol", assets)),
    ):
        pass
    here = entry("isaac_manager_based", MANAGER_BASED, assets, interpreter=sys.executable)
    with (
        pytest.raises(ConfigError, match=r"has no Isaac Lab; .*interpreter"),
        sync.build_env_group(here),
    ):
        pass


@pytest.mark.parametrize("name", ["isaac_cartpole", "isaac_marl"])
def test_the_examples_end_with_their_tables(
    bare: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Each example config runs unchanged except for the Python of its workers."""
    assets, _ = bare
    monkeypatch.setenv("ISAACSIM_ASSET_ROOT", str(assets))
    table = closing_table(name, f"envs.0.interpreter={PYTHON}", "--steps", "128")
    assert steps(table["steps"]) == 128


def test_six_simulators_share_a_group(
    bare: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The config of all runs unchanged, too, with a column for each entry at the end."""
    for simulator in ("ale_py", "mani_skill", "mpe2", "piper_sdk"):
        pytest.importorskip(simulator)
    assets, _ = bare
    monkeypatch.setenv("ISAACSIM_ASSET_ROOT", str(assets))
    table = closing_table("zoo", f"envs.3.interpreter={PYTHON}", "--steps", "2000")
    names = {"cheetah", "pong", "pick_cube", "isaac_cartpole", "spread", "piper"}
    assert names <= {*table["all"]}
