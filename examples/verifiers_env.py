"""An env of verifiers whose episodes are played on the envs of a group."""

import asyncio

import verifiers.v1 as vf

import rlightning_aio as rl

__all__ = ["TillEnv", "TillTaskset"]  # verifiers finds them by `--env.taskset.id verifiers_env`.


class Till:
    """It adds up prices; the model is to reach a sum."""

    async def reset(self, *, seed, **_):
        self.asked, self.total, self.turns = 1 + seed % 9, 0, 0
        return f"Reach {self.asked}.", {}

    async def step(self, text):
        self.total += sum(map(str.isdigit, text))
        self.turns += 1
        return f"{self.total}", float(self.total == self.asked), self.turns == 2, False, {}


class TillData(vf.TaskData):
    seed: int


class TillTask(vf.Task[TillData]):
    pass


class TillTaskset(vf.Taskset[TillTask, vf.TasksetConfig]):
    def load(self):
        for seed in range(1000):
            yield TillTask(TillData(seed=seed), self.config.task)


class TillConfig(vf.EnvConfig):
    player: vf.AgentConfig = vf.AgentConfig()


class TillEnv(vf.Env[TillConfig]):
    async def start(self):
        self.group = rl.build_env_group(Till, num_workers=64, placement="loop", step_timeout=60)
        self.idle = asyncio.Queue()
        await self.group.init()
        for env_id in self.group.env_ids:
            self.idle.put_nowait(env_id)

    async def stop(self):
        await self.group.close()

    async def run(self, task, agents):
        env_id, reward = await self.idle.get(), 0.0
        try:
            async with (
                self.group.episode(env_id, seed=task.data.seed) as episode,
                agents.player.interaction(task) as player,
            ):
                while not episode.is_over:
                    segment = await player.turn(episode.last.observation)
                    if segment.terminated:
                        break
                    result = await episode.step(segment.last_reply)
                    reward += result.last_reward
        finally:
            self.idle.put_nowait(env_id)
        if not player.trace.errors:  # Else the model has failed, or its server.
            player.trace.record_reward("reward", reward)
