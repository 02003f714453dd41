"""GRPO by TRL: rollouts of an env in a group become the batch of a `GRPOTrainer`."""

from trl import GRPOTrainer

import rlightning_aio as rl
from rlightning_aio.attempts import Rules
from rlightning_aio.trl import reward, rollouts


class Till:
    """It adds up prices; the model is to reach a sum."""

    async def reset(self, *, options, **_):
        self.total, self.turns = 0, 0
        return options["prompt"], {}

    async def step(self, text):
        self.total += sum(map(str.isdigit, text))
        self.turns += 1
        return f" {self.total}.", float(self.total == 1), self.turns == 2, False, {}


def train(generate, tokenizer, **arguments):
    async def agent(episode):
        prompt, said = tokenizer.encode(episode.first), []
        ids, logprobs, mask = [], [], []
        while not episode.is_over:
            ids, logprobs, mask = ids + said, logprobs + [0.0] * len(said), mask + [0] * len(said)
            new, their_logprobs = await generate(prompt + ids)
            ids, logprobs, mask = ids + new, logprobs + their_logprobs, mask + [1] * len(new)
            result = await episode.step(tokenizer.decode(new, skip_special_tokens=True))
            said = tokenizer.encode(result.observation)
        lists = {"completion_ids": ids, "logprobs": logprobs, "env_mask": mask}
        return {"prompt_ids": prompt, **lists}

    group = rl.build_env_group(Till, num_workers=8, placement="loop", step_timeout=60)
    with rollouts(group, agent, rules=Rules(attempt_timeout=900)) as rollout_func:
        trainer = GRPOTrainer(
            reward_funcs=reward, rollout_func=rollout_func, processing_class=tokenizer, **arguments
        )
        trainer.train()
    return trainer
