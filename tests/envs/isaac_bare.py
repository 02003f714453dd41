"""Isaac Lab without this package: the reference for its backends.

Run by the Python that has Isaac Lab, which may differ from that of the tests: ``python
isaac_bare.py TASK NUM_ENVS MAX_EPISODE_LENGTH SEED ACTIONS.npy ASSETS OUT.npz``.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np


def bare_simulator(task: str, num_envs: int, max_episode_length: int) -> Any:
    """Yield the task's environment; one at a time in a process."""
    import gymnasium as gym
    from isaaclab.app import launch_simulation
    from isaaclab_tasks.utils import parse_env_cfg

    cfg = parse_env_cfg(task, device="cpu", num_envs=num_envs)
    cfg.compute_final_obs = True
    cfg.episode_length_s = (max_episode_length - 0.5) * cfg.decimation * cfg.sim.dt
    with launch_simulation(cfg):
        return gym.make(task, cfg=cfg).unwrapped


def by_agent(action: Any) -> dict[str, Any]:
    """Split one action into those of the double pendulum's two agents."""
    return {"cart": action, "pendulum": -action}


def trajectory(env: Any, seed: int, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Return observations, rewards and flags of a reset and of 200 steps, stacked over time."""
    import torch

    env.reset(seed=seed)
    # The velocities after the first reset are from before it.
    steps: list[tuple[Any, ...]] = [(env.reset(seed=seed)[0],)]
    for action in torch.tensor(actions):
        given = by_agent(action) if hasattr(env, "possible_agents") else action
        observation, reward, terminated, truncated, _ = env.step(given)
        steps.append((observation, _copy(reward), _copy(terminated), _copy(truncated)))
    columns: dict[str, np.ndarray] = {}
    for key in steps[0][0]:
        columns[f"observation.{key}"] = np.array([step[0][key].numpy() for step in steps])
    for index, name in enumerate(("reward", "terminated", "truncated"), start=1):
        # Both agents of the pendulum share these.
        values = [step[index] for step in steps[1:]]
        columns[name] = np.array([v["cart"] if isinstance(v, dict) else v for v in values])
    return columns


def _copy(value: Any) -> Any:
    # The simulator changes these in place.
    return {k: v.clone() for k, v in value.items()} if isinstance(value, dict) else value.clone()


def main(task: str, num_envs: str, length: str, seed: str, actions: str, root: str, out: str):
    os.environ["ISAACSIM_ASSET_ROOT"] = root
    sys.path.insert(0, str(Path(__file__).parent))
    from isaac_assets import write_assets

    write_assets(Path(root))
    env = bare_simulator(task, int(num_envs), int(length))
    np.savez(out, **trajectory(env, int(seed), np.load(actions)))
    env.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
