"""TRL's `rollout_func`, over `play`: the rollouts of a batch are attempts on the envs of a group.

Rule: a rollout that fails trains nothing, and neither does one whose agent was cut before it has
returned. Its only token is masked and its reward is None, so it counts neither for the loss, nor
for its normaliser, nor for the mean of its group.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import zlib
from collections import Counter, defaultdict
from itertools import chain, groupby
from typing import TYPE_CHECKING, Any, Final, cast

from rlightning_aio.attempts import Attempt, EpisodeSpec, play
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.attempts import Rules
    from rlightning_aio.attempts.tries import Agent

__all__ = ["reward", "rollouts"]

_BY_TOKEN: Final = ("completion_ids", "logprobs", "env_mask")
_NEEDED: Final = ("prompt_ids", "completion_ids")


def reward(reward: list[float | None], **columns: Any) -> list[float | None]:
    """Return the rewards of the envs: one of the `reward_funcs` of the trainer."""
    del columns
    return reward


@contextlib.contextmanager
def rollouts(
    group: EnvGroup, agent: Agent, *, rules: Rules | None = None
) -> Generator[Callable[[list[Any], Any], dict[str, Any]]]:
    """Make the `rollout_func` of a `GRPOTrainer`; initialise the group, and close it at the end::

        with rollouts(group, agent, rules=Rules(attempt_timeout=900)) as rollout_func:
            trainer = GRPOTrainer(model, reward_funcs=reward, rollout_func=rollout_func, ...)
            trainer.train()

    Args:
        group: an asynchronous one, for this alone.
        agent: a coroutine function, which gets an `AttemptEpisode`, and returns what TRL asks for
            of one rollout: lists ``prompt_ids`` and ``completion_ids``; ``logprobs`` if the trainer
            needs them, and ``env_mask`` (1 for tokens of the model, 0 for those of the env), of
            the length of ``completion_ids``. Reward functions get everything else, and ``reward``
            and ``outcome`` (of a rollout that has failed: None, and its `Outcome`).
        rules: see `Rules`; those with ``first`` lack the rollouts that are cancelled.

    A reset has the options ``{"prompt": prompt}``, and the same prompt has the same seed, in every
    process.

    The function raises `RLightningError` if all rollouts of a batch have failed, and `ValueError`
    if an agent returns something else.
    """
    with asyncio.Runner() as runner:

        def rollout_func(prompts: list[Any], trainer: Any) -> dict[str, Any]:
            attempts = runner.run(_played(group, agent, rules, prompts))
            return _columns(attempts, trainer.processing_class)

        runner.run(group.init())
        try:
            yield rollout_func
        finally:
            runner.run(group.close())


async def _played(
    group: EnvGroup, agent: Agent, rules: Rules | None, prompts: list[Any]
) -> list[Attempt]:
    """Play attempts at prompts, which follow one another if they are the same; return these.

    Where a batch is cut for several processes, a process has fewer of one prompt than of others.
    """
    specs = [_task_of(prompt) for prompt in prompts]
    runs = [list(run) for _, run in groupby(specs, lambda spec: spec.key)]
    size = math.gcd(*map(len, runs))
    tasks = [spec for run in runs for spec in run[::size]]
    # By seed and options: `play` adds an entry and the name of its task.
    found = defaultdict[Any, list[Attempt]](list)
    async with contextlib.aclosing(play(group, tasks, agent, size, rules)) as groups:
        async for attempts in groups:
            found[attempts.spec.key[2:]] += attempts
    return [found[spec.key[2:]].pop(0) for spec in specs]


def _task_of(prompt: Any) -> EpisodeSpec:
    text = json.dumps(prompt, sort_keys=True)
    return EpisodeSpec("", zlib.crc32(text.encode()), {"prompt": prompt})


def _columns(attempts: list[Attempt], tokenizer: Any) -> dict[str, Any]:
    """Return what TRL takes: lists with one element for each attempt."""
    results = _results(attempts)
    ends = [tokenizer.eos_token_id]
    masked = {"prompt_ids": ends, "completion_ids": ends, "logprobs": [0.0], "env_mask": [0]}
    rows = [result or masked for result in results]
    names = dict.fromkeys(chain.from_iterable(filter(None, results)))
    found: dict[str, Any] = {name: [row.get(name) for row in rows] for name in names}
    found["env_mask"] = [row.get("env_mask", [1] * len(row["completion_ids"])) for row in rows]
    return {
        "logprobs": None,
        **found,
        "reward": [one and attempt.reward for one, attempt in zip(results, attempts, strict=True)],
        "outcome": [one.outcome for one in attempts],
    }


def _results(attempts: list[Attempt]) -> list[dict[str, Any] | None]:
    """Return what the agents have returned; None for attempts that have failed or were cut."""
    found = [None if one.result is None else _checked(one.result) for one in attempts]
    if not any(found):
        if any(one.reward is not None for one in attempts):
            _checked(None)
        kinds = Counter(f"{one.outcome.kind} ({one.outcome.cause})" for one in attempts)
        raise RLightningError(f"all rollouts of a batch have failed: {dict(kinds)}")
    return found


def _checked(result: Any) -> dict[str, Any]:
    lists = cast("dict[str, Any]", result if isinstance(result, dict) else {})
    if not all(lists.get(name) for name in _NEEDED):
        raise ValueError(
            f"the agent returned {result!r}; for TRL it returns a dict with the lists "
            f"{' and '.join(_NEEDED)}, which are not empty"
        )
    lengths = {name: len(lists[name]) for name in _BY_TOKEN if name in lists}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the agent returned lists of different lengths: {lengths}")
    return lists
