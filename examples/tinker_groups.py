"""Groups of attempts as data of an update of tinker-cookbook."""

from tinker_cookbook.rl.data_processing import assemble_training_data, compute_advantages
from tinker_cookbook.rl.types import RolloutError, Trajectory, TrajectoryGroup, Transition

import rlightning_aio as rl
from rlightning_aio.attempts import EpisodeSpec, play


class Guess:
    async def reset(self, *, seed, **_):
        self.answer = "yes" if seed % 2 else "no"
        return f"Is {seed} odd?", {}

    async def step(self, text):
        return f"You said {text}", float(self.answer in text.lower()), True, False, {}


async def data_of_update(policy, encode, decode, stop, seeds, size=4):
    """Play a group for each seed; `policy` is the cookbook's `TokenCompleter`."""

    async def agent(episode):
        seen, transitions = encode(episode.first), []
        while not episode.is_over:
            said = await policy(seen, stop)
            result = await episode.step(decode(said.tokens))
            reward, done = float(result.last_reward), episode.is_over
            transitions.append(Transition(ob=seen, ac=said, reward=reward, episode_done=done))
            seen = encode(result.observation)
        return Trajectory(transitions, final_ob=seen)

    groups = []
    tasks = [EpisodeSpec("", seed) for seed in seeds]
    async with rl.build_env_group(Guess, num_workers=8, placement="loop", step_timeout=60) as envs:
        async for attempts in play(envs, tasks, agent, size):
            whole = [one.result for one in attempts if one.reward is not None]
            failed = [one.outcome for one in attempts if one.reward is None]
            errors = [RolloutError(outcome.kind, outcome.cause) for outcome in failed]
            if whole:
                nothing = [0.0] * len(whole), [{} for _ in whole]  # No rewards of the group.
                groups.append(TrajectoryGroup(whole, *nothing, rollout_errors=errors))
    return assemble_training_data(groups, compute_advantages(groups))
