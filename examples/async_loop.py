"""Collect 20,000 steps from CartPoles as they get ready, with random actions."""

import numpy as np

import rlightning_aio as rl


async def main() -> None:
    rng = np.random.default_rng(0)
    async with rl.build_env_group(rl.load_config("configs/cartpole.yaml")) as group:
        batch, _ = await group.reset(seed=0)
        with group.auto_reset(max_episode_steps=500):
            group.step_async(batch.respond(action=rng.integers(2, size=len(batch))))
            for _ in range(20_000 // 32):
                batch, _ = await group.collect_async(min_results=32, max_results=32)
                group.step_async(batch.respond(action=rng.integers(2, size=len(batch))))
        group.print_timing_summary()


rl.run(main())
