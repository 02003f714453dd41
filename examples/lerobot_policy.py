"""Evaluate a policy of LeRobot on several tasks or seeds at the same time."""

from lerobot.envs.configs import PushtEnv
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors

from rlightning_aio import sync
from rlightning_aio.evaluation import EpisodeSpec, evaluate
from rlightning_aio.plugins.lerobot import LeRobotPolicy

# A small one with random weights. For yours: LeRobotPolicy.from_pretrained("…/pretrained_model").
seen_as = PushtEnv(observation_width=96, observation_height=96)
small = {
    "dim_model": 64,
    "n_heads": 4,
    "dim_feedforward": 128,
    "chunk_size": 8,
    "n_action_steps": 8,
}
config = make_policy_config("act", device="cpu", pretrained_backbone_weights=None, **small)
policy = LeRobotPolicy(make_policy(config, env_cfg=seen_as), *make_pre_post_processors(config))

entry = {
    "name": "pusht",
    "backend": "gymnasium",
    "task": "gym_pusht:gym_pusht/PushT-v0",
    "num_workers": 3,
    "max_episode_steps": 40,
}
size = {"obs_type": "pixels_agent_pos", "observation_width": 96, "observation_height": 96}
with sync.build_env_group({**entry, "env_kwargs": size}) as group:
    found = evaluate(group, policy, [EpisodeSpec("", seed) for seed in range(4)])
print(found.success, [round(one.reward, 2) for one in found.played])
