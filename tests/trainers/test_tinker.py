"""`rlightning_aio.tinker` with the real tinker-cookbook; skipped where it isn't installed."""

from __future__ import annotations

import asyncio
import os
from typing import Any

import pytest

import rlightning_aio as rl
from rlightning_aio.tinker import EnvGroups

pytestmark = [pytest.mark.simulators, pytest.mark.filterwarnings("ignore")]


class Digits:
    """Three digits end it; a step with 7 hangs, one with 8 ends the process, one with 9 raises."""

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.left = 3
        return f"{seed} {os.getpid()}", {}

    async def step(self, action: str) -> Any:
        if action == "7":
            await asyncio.sleep(3600)
        if action == "8":
            os._exit(3)
        if action == "9":
            raise ValueError("no 9")
        self.left -= 1
        return f"{self.left} left", float(action), self.left == 0, False, {}


class Policy:
    """Says what a script says, one digit a call; then 1."""

    def __init__(self, digits: str) -> None:
        self.digits = list(digits)

    async def __call__(self, model_input: Any, stop: Any, **_: Any) -> Any:
        from tinker_cookbook.completers import TokensWithLogprobs

        assert model_input.length > 0
        assert stop == ["\n"]
        digit = self.digits.pop(0) if self.digits else "1"
        await asyncio.sleep(0)
        return TokensWithLogprobs(tokens=[ord(digit)], maybe_logprobs=[0.0])


def encode(observation: str) -> Any:
    import tinker

    return tinker.ModelInput.from_ints(list(observation.encode())), ["\n"]


def decode(tokens: list[int]) -> str:
    return bytes(tokens).decode()


async def rollouts(
    digits: str, strategy: str, *, num_workers: int = 2, **more: Any
) -> tuple[Any, dict[str, float]]:
    pytest.importorskip("tinker_cookbook")
    from tinker_cookbook.rl import rollout_strategy
    from tinker_cookbook.rl.rollouts import do_group_rollout

    kind = getattr(rollout_strategy, strategy)
    entry: dict[str, Any] = {"envs_per_process": 1, "step_timeout": 10, "num_workers": num_workers}
    async with rl.build_env_group(Digits, name="digits", **entry) as group:
        groups = EnvGroups(group, encode, decode)
        builder = groups.builder(seed=5, size=4)
        try:
            found: Any = await do_group_rollout(builder, Policy(digits), kind(**more))
        except rl.EnvFault as error:
            found = error
        assert group.pending == []
        # Every env was returned.
        others = await do_group_rollout(groups.builder(seed=6, size=4), Policy(""))
        assert others.get_total_rewards() == [3.0] * 4
        return found, group.metrics()


async def test_a_group_of_rollouts() -> None:
    """Four share two envs, with the same seed."""
    found, _ = await rollouts("", "FailFast")
    assert found.get_total_rewards() == [3.0] * 4
    texts = [bytes(one.transitions[0].ob.to_ints()) for one in found.trajectories_G]
    assert all(text.startswith(b"5 ") for text in texts)
    assert all(one.transitions[-1].episode_done for one in found.trajectories_G)


@pytest.mark.parametrize(
    ("digit", "kind"), [("7", "env_hung"), ("8", "env_died"), ("9", "env_raised")]
)
async def test_failures_are_retried_and_counted(digit: str, kind: str) -> None:
    """None is a reward: the group is whole after a retry, and the error is in its list."""
    found, counts = await rollouts(digit, "RetryOnFailure", max_retries=1)
    assert found.get_total_rewards() == [3.0] * 4
    assert len(found.rollout_errors) == 1
    assert counts[f"envs/outcomes_{kind}"] == 1


async def test_without_retries_the_error_has_the_outcome() -> None:
    """The others are cancelled, and their envs are free."""
    found, _ = await rollouts("8", "FailFast")
    assert found.outcome.kind == "env_died"


async def test_a_time_limit_of_the_cookbook_reaches_the_env() -> None:
    """A step that hangs is cancelled with its rollout."""
    found, _ = await rollouts("7", "RetryOnFailure", max_retries=1, per_rollout_timeout=5)
    assert found.get_total_rewards() == [3.0] * 4
    assert [error.error_type for error in found.rollout_errors] == ["TimeoutError"]
