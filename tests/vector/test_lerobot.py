"""LeRobot's own `lerobot-eval` and `rollout`: the same numbers with our envs as with its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from patience import HANG

from rlightning_aio import sync
from rlightning_aio.evaluation import EpisodeSpec, evaluate
from rlightning_aio.plugins.lerobot import LeRobotPolicy

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
