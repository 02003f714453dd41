"""The loop of CleanRL's ppo_continuous_action.py with Gymnasium 1; only `VectorEnv` is ours."""

import gymnasium as gym
import numpy as np

from rlightning_aio.vector import VectorEnv


def make_env(env_id):
    def thunk():
        env = gym.wrappers.RecordEpisodeStatistics(gym.make(env_id))
        env = gym.wrappers.NormalizeObservation(gym.wrappers.ClipAction(env))
        return gym.wrappers.TransformObservation(
            env, lambda obs: np.clip(obs, -10, 10), env.observation_space
        )

    return thunk


envs = VectorEnv([make_env("Pendulum-v1") for _ in range(4)], autoreset_mode="SameStep")
obs, _ = envs.reset(seed=1)
for global_step in range(0, 1000, 4):
    actions = envs.action_space.sample()
    next_obs, rewards, terminations, truncations, infos = envs.step(actions)
    final = infos.get("final_info", {})
    if "episode" in final:
        for episodic_return in final["episode"]["r"][final["_episode"]]:
            print(f"global_step={global_step}, episodic_return={episodic_return}")
    real_next_obs = next_obs.copy()
    for idx in np.flatnonzero(truncations):
        real_next_obs[idx] = infos["final_obs"][idx]
    obs = next_obs
envs.close()
