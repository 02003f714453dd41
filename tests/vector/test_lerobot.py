"""LeRobot's own `lerobot-eval` and `rollout`: the same numbers with our envs as with its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from kit.scripted import Counts
from patience import HANG

from rlightning_aio import sync
from rlightning_aio.collecting import Collector
from rlightning_aio.evaluation import EpisodeSpec, evaluate
from rlightning_aio.plugins.lerobot import LeRobotPolicy
from rlightning_aio.plugins.lerobot_dataset import LeRobotWriter

pytestmark = [pytest.mark.simulators, pytest.mark.filterwarnings("ignore")]

STEPS = 20
SIZE = {"observation_height": 96, "observation_width": 96}
SMALL = {
    "act": {
        "dim_model": 64, "n_heads": 4, "dim_feedforward": 128, "chunk_size": 8,
        "n_action_steps": 8,
    },
    "act, averaged": {
        "dim_model": 64, "n_heads": 4, "dim_feedforward": 128, "chunk_size": 8,
        "n_action_steps": 1, "temporal_ensemble_coeff": 0.1,
    },
    "diffusion": {
        "down_dims": (32, 64), "horizon": 16, "n_action_steps": 8, "num_inference_steps": 2,
        "crop_shape": (84, 84),
    },
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def lerobot() -> Any:
    """LeRobot, with what it keeps for as long as the process lives."""
    pytest.importorskip("lerobot")
    pytest.importorskip("tqdm").tqdm.get_lock()


def module_of(name: str) -> Any:
    return import_module(f"lerobot.{name}")


def evaluated(folder: Path, *arguments: str) -> Any:
    """Run the command with a policy of the same random weights, on seeds 1000 to 1003."""
    small = [f"--policy.{name}={value}" for name, value in SMALL["act"].items()]
    size = [f"--env.{name}={value}" for name, value in SIZE.items()]
    done = subprocess.run(
        [
            Path(sys.executable).with_name("lerobot-eval"), "--policy.type=act", *small, *size,
            "--policy.pretrained_backbone_weights=null", "--policy.device=cpu",
            "--policy.push_to_hub=false", "--env.type=pusht", f"--env.episode_length={STEPS}",
            "--eval.batch_size=2", "--eval.n_episodes=4", f"--output_dir={folder}", *arguments,
        ],
        capture_output=True, text=True, timeout=HANG, check=False,
        env={name: of for name, of in os.environ.items() if name != "PYTHONASYNCIODEBUG"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (task,) = json.loads((folder / "eval_info.json").read_text())["per_task"]
    return {name: task["metrics"][name] for name in ("sum_rewards", "max_rewards", "successes")}


def test_lerobot_eval_counts_the_same(tmp_path: Path) -> None:
    """The plug-in makes asynchronous envs ours; LeRobot's own can't run `gym_pusht`."""
    own = evaluated(tmp_path / "own", "--eval.use_async_envs=false")
    ours = evaluated(tmp_path / "ours", "--eval.use_async_envs=true")
    assert len(own["sum_rewards"]) == 4
    assert any(own["sum_rewards"])
    assert ours == own


@pytest.mark.parametrize("kind", SMALL)
def test_a_policy_plays_as_in_lerobots_rollout(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each episode, though its envs are at different steps. Saved and loaded, without noise."""
    torch = pytest.importorskip("torch")
    envs_of, policies = module_of("envs.factory"), module_of("policies.factory")
    draw = torch.randn
    monkeypatch.setattr(torch, "randn", lambda *shape, **kwargs: draw(*shape, **kwargs) * 0)
    torch.manual_seed(0)
    seen_as = module_of("envs.configs").PushtEnv(episode_length=STEPS, **SIZE)
    config = policies.make_policy_config(
        kind.partition(",")[0],
        device="cpu",
        push_to_hub=False,
        pretrained_backbone_weights=None,
        **SMALL[kind],
    )
    policy = policies.make_policy(config, env_cfg=seen_as).eval()
    processors = policies.make_pre_post_processors(config)
    for part in (policy, *processors):
        part.save_pretrained(tmp_path)

    (envs,) = envs_of.make_env(seen_as, n_envs=1)["pusht"].values()
    rollout = module_of("scripts.lerobot_eval").rollout
    alone = [
        rollout(envs, policy, *seen_as.get_env_processors(), *processors, seeds=[seed])
        for seed in range(4)
    ]
    envs.close()
    entry = {
        "name": "pusht", "backend": "gymnasium", "task": "gym_pusht:gym_pusht/PushT-v0",
        "num_workers": 3, "max_episode_steps": STEPS,
        "env_kwargs": {"obs_type": "pixels_agent_pos", **SIZE},
    }  # fmt: skip
    with sync.build_env_group(entry) as group, group.auto_reset():
        loaded = LeRobotPolicy.from_pretrained(tmp_path)
        found = evaluate(group, loaded, [EpisodeSpec("", seed) for seed in range(4)])
    for one in found.attempts:
        assert one.reward == pytest.approx(float(alone[one.spec.seed]["reward"].sum()), rel=1e-4)
        assert one.success == bool(alone[one.spec.seed]["success"].any())


class Following(Counts):
    """The action should be the joints' positions; a camera sees one, too."""

    observation_space = gym.spaces.Dict(
        joints=gym.spaces.Box(-1, 1, (2,), np.float64),
        wrist=gym.spaces.Box(0, 255, (64, 64, 3), np.uint8),
    )
    action_space = gym.spaces.Box(-2, 2, (2,), np.float32)
    length = 6

    def does(self, action: Any) -> float:
        return -float(np.abs(action - self.joints).mean())

    @property
    def joints(self) -> Any:
        return np.sin(self.resets + 1.3 * self.steps + np.arange(2))

    def observed(self) -> Any:
        color = int(128 + 100 * self.joints[0])
        return {"joints": self.joints, "wrist": np.full((64, 64, 3), color, np.uint8)}


def test_act_learns_from_an_export_and_plays_in_the_same_env(tmp_path: Path) -> None:
    """The mapping of names is the only thing that both are given."""
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    names = {"joints": "observation.state"}
    entry = {"name": "env", "task": Following, "num_workers": 2, "placement": "inline"}
    root = tmp_path / "data"

    def demonstrated(batch: Any) -> Any:
        return {"action": batch.observation["joints"].astype(np.float32)}

    with sync.build_env_group(entry) as group, group.auto_reset(9):
        collector = Collector(group, demonstrated, num_transitions=24)
        with LeRobotWriter("me/following", root, fps=10, names=names) as writer:
            for _ in range(3):
                writer.add(collector.collect())

    dataset = module_of("datasets.lerobot_dataset").LeRobotDataset(
        "me/following", root=root, delta_timestamps={"action": [0.0, 0.1]}
    )
    policies = module_of("policies.factory")
    config = policies.make_policy_config(
        "act", device="cpu", push_to_hub=False, pretrained_backbone_weights=None,
        **{**SMALL["act"], "chunk_size": 2, "n_action_steps": 1, "use_vae": False,
        "pre_norm": True, "dropout": 0.0},
    )  # fmt: skip
    policy = policies.make_policy(config, ds_meta=dataset.meta)
    assert set(config.input_features) == {"observation.state", "observation.images.wrist"}
    processors = policies.make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
    losses = []
    policy.train()
    for _ in range(14):
        for rows in torch.utils.data.DataLoader(dataset, batch_size=24, shuffle=True):
            loss, _ = policy.forward(processors[0](rows))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    assert losses[-1] < losses[0] / 4
    for part in (policy, *processors):
        part.save_pretrained(tmp_path)

    with sync.build_env_group(entry) as group, group.auto_reset(9):
        loaded = LeRobotPolicy.from_pretrained(tmp_path, names=names)
        found = evaluate(group, loaded, 4)
    assert all(one.reward > -0.15 * one.length for one in found.played)
