"""Step eight HalfCheetahs together, without an event loop: in a script, thread or notebook."""

import numpy as np

import rlightning_aio as rl
from rlightning_aio import sync

rng = np.random.default_rng(0)
config = rl.EnvConfig(name="cheetah", backend="mujoco", task="HalfCheetah-v5", num_workers=8)
with sync.build_env_group(config) as group:
    batch, _ = group.reset(seed=0)
    with group.auto_reset(max_episode_steps=100):
        for _ in range(250):
            batch, _ = group.step(batch.respond(action=rng.uniform(-1, 1, (8, 6))))
            ended = batch.done & ~batch.restarted  # A lost episode has no return.
            if ended.any():
                print("returns:", batch.infos["episode"]["r"][ended].round(1))
