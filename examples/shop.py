"""The environment of agent.py: questions that need two tools; not an example itself.

An observation is the list of messages so far, an action the assistant's message, both in the form
of OpenAI's chat completions. Tool calls are run; a message without one is the answer, for which
the reward is 1 or 0.
"""

from __future__ import annotations

import asyncio
import json
import operator
import random
import re
from typing import Any

import rlightning_aio as rl
from rlightning_aio.spaces import Anything

__all__ = ["TASKS", "TOOLS", "Shop"]

TASKS = {
    "total": ("What do {} apples and {} pears cost together, in cents?", operator.add),
    "difference": ("How many cents more do {} apples cost than {} pears?", operator.sub),
}
OPERATIONS = {"+": operator.add, "-": operator.sub, "*": operator.mul}


def tool(name: str, description: str, **types: str) -> dict[str, Any]:
    """A tool as OpenAI's API, chat templates and TRL want it described."""
    properties = {key: {"type": kind} for key, kind in types.items()}
    schema = {"type": "object", "properties": properties, "required": list(properties)}
    function = {"name": name, "description": description, "parameters": schema}
    return {"type": "function", "function": function}


TOOLS = [
    tool("price", "Price of one 'apple' or 'pear', in cents", fruit="string"),
    tool("calculate", "a + b, a - b or a * b", a="integer", operation="string", b="integer"),
]


@rl.ENVS.register("shop")
class Shop(rl.BaseEnv):
    def get_observation_space(self) -> Anything:
        return Anything()

    def get_action_space(self) -> Anything:
        return Anything()

    async def reset(self, *, seed: Any = None, options: Any = None) -> rl.EnvRet:
        """A question of ``options["task"]`` about a shop that the seed furnishes."""
        rng = random.Random(seed)
        question, combine = TASKS[(options or {}).get("task", "total")]
        self.prices = {"apple": rng.randint(50, 99), "pear": rng.randint(10, 49)}
        apples, pears = rng.randint(20, 99), rng.randint(2, 19)
        self.answer = combine(apples * self.prices["apple"], pears * self.prices["pear"])
        self.messages = [
            {"role": "system", "content": "Use the tools, then answer with one number."},
            {"role": "user", "content": question.format(apples, pears)},
        ]
        return rl.EnvRet(env_id=self.env_id, observation=self.messages)

    async def step(self, policy_resp: rl.PolicyResponse) -> rl.EnvRet:
        message = policy_resp.action
        calls = message.get("tool_calls", [])
        self.messages.append(message)
        for call in calls:
            result = await self.use(**call["function"])
            self.messages.append({"role": "tool", "tool_call_id": call["id"], "content": result})
        numbers = re.findall(r"-?\d+", message.get("content", ""))
        return rl.EnvRet(
            env_id=self.env_id,
            observation=self.messages,
            last_reward=float(not calls and numbers[-1:] == [str(self.answer)]),
            last_terminated=not calls,
            last_truncated=bool(calls) and len(self.messages) > 20,
        )

    async def use(self, name: str, arguments: str) -> str:
        """The result of a tool; a model that calls it wrongly reads its mistake."""
        await asyncio.sleep(0.01)  # Most tools are behind a network.
        try:
            given = json.loads(arguments)
            if name == "price":
                return str(self.prices[given["fruit"]])
            return str(OPERATIONS[given["operation"]](given["a"], given["b"]))
        except (LookupError, TypeError, ValueError) as error:
            return f"error: {error!r}"
