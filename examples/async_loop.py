"""Collect 20,000 transitions from CartPoles as they become ready, with random actions."""

import numpy as np

import rlightning_aio as rl


async def main() -> None:
    rng = np.random.default_rng(0)
    async with rl.build_env_group(rl.load_config("configs/cartpole.yaml")) as group:
        batch, _ = await group.reset(seed=0)
        transitions = 0
        with group.auto_reset():
            group.step_async(batch.respond(action=rng.integers(2, size=len(batch))))
            while transitions < 20_000:
                batch, _ = await group.collect_async(min_results=32, max_results=32)
                transitions += np.count_nonzero(~batch.is_reset)
                group.step_async(batch.respond(action=rng.integers(2, size=len(batch))))
        print(group.metrics())


rl.run(main())
