"""verl's rollouts on the envs of a group, which each of verl's workers has for itself."""

import asyncio
import functools
from uuid import uuid4

from verl.experimental.agent_loop import AgentLoopBase, AgentLoopOutput
from verl.experimental.agent_loop.agent_loop import register

import rlightning_aio as rl
from rlightning_aio.errors import EnvFault, EpisodeLost


class Till:
    """It adds up prices; the model is to reach a sum."""

    async def reset(self, *, seed, **_):
        self.asked, self.total, self.turns = 1 + seed % 9, 0, 0
        return f"Reach {self.asked}.", {}

    async def step(self, text):
        self.total += sum(map(str.isdigit, text))
        self.turns += 1
        return f"{self.total}", float(self.total == self.asked), self.turns == 2, False, {}


@functools.cache
def envs():
    """A task that starts the group, and queues its idle envs."""

    async def start():
        group = rl.build_env_group(Till, num_workers=64, placement="loop", step_timeout=60)
        await group.init()
        idle = asyncio.Queue()
        for env_id in group.env_ids:
            idle.put_nowait(env_id)
        return group, idle

    return asyncio.ensure_future(start())


@register("till")
class TillLoop(AgentLoopBase):
    async def run(self, sampling_params, *, raw_prompt, index, **_):
        (group, idle), tries_left = await envs(), 2
        while True:
            env_id = await idle.get()
            try:
                async with group.episode(env_id, seed=int(index)) as episode:
                    return await self.play(episode, sampling_params, list(raw_prompt))
            except (EnvFault, EpisodeLost):
                if not tries_left:
                    raise
                tries_left -= 1
            finally:
                idle.put_nowait(env_id)

    async def play(self, episode, sampling_params, messages):
        messages = [*messages, {"role": "user", "content": episode.last.observation}]
        ids, mask, logprobs = await self.ct_build_initial_tokens(messages), [], []
        request, reward, longest = uuid4().hex, 0.0, self.rollout_config.response_length
        while True:
            said = await self.server_manager.generate(
                request_id=request, prompt_ids=ids, sampling_params=sampling_params
            )
            merged, mask, logprobs = await self.ct_merge_assistant_token(
                ids, said.token_ids, mask, logprobs if said.log_probs else None, said.log_probs
            )
            ids, text = merged.token_ids, self.tokenizer.decode(said.token_ids)
            result = await episode.step(text)
            reward += result.last_reward
            if episode.is_over or len(mask) >= longest:
                break
            before = [*messages, {"role": "assistant", "content": text}]
            messages = [*before, {"role": "user", "content": result.observation}]
            merged, mask, logprobs = await self.ct_merge_context_msg(
                before, messages, ids, mask, logprobs
            )
            ids = merged.token_ids
        return AgentLoopOutput(
            prompt_ids=ids[: len(ids) - len(mask)],
            response_ids=ids[len(ids) - len(mask) :][:longest],
            response_mask=mask[:longest],
            response_logprobs=logprobs and logprobs[:longest],
            reward_score=reward,
            metrics={},
        )
