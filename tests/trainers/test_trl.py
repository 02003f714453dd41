"""`rlightning_aio.trl` with the real TRL; skipped where it isn't installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

import rlightning_aio as rl
from rlightning_aio.trl import reward, rollouts

if TYPE_CHECKING:
    from pathlib import Path

# Warnings of other libraries are theirs.
pytestmark = [pytest.mark.simulators, pytest.mark.filterwarnings("ignore")]


def graded(text: str) -> float:
    return sum(map(ord, text)) % 7 / 7


class Graded:
    async def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return options["prompt"], {}

    async def step(self, action: str) -> Any:
        if not action:
            raise OSError("the sandbox is gone")
        return "", graded(action), True, False, {}


class Trained:
    """TRL's trainer, over two steps of two prompts, with what it generates by itself."""

    def __init__(self, folder: Path, **more: Any) -> None:
        pytest.importorskip("trl")
        from datasets import Dataset
        from trainers.tiny import tiny_model, tokenizer, trainer_args
        from trl import GRPOTrainer

        words = tokenizer()
        args = trainer_args(folder, **more.pop("args", {}))
        rows = Dataset.from_list([{"prompt": one} for one in ("ab", "cd", "ef", "gh")])
        trainer = GRPOTrainer(
            tiny_model(words), args=args, train_dataset=rows, processing_class=words, **more
        )
        name = "_generate_single_turn"  # Whatever generates, comes through it.
        generate, self.generated = getattr(trainer, name), list[Any]()

        def noted(prompt_ids: Any, *others: Any) -> Any:
            found, logprobs = generate(prompt_ids, *others)
            # Random weights never end by themselves.
            found = [ids[: k % 3 + 3] for k, ids in enumerate(found)]
            self.generated.append((prompt_ids, found))
            return found, logprobs

        setattr(trainer, name, noted)
        self.trainer = trainer

    def train(self) -> list[dict[str, float]]:
        """What it logs of each step."""
        self.trainer.train()
        return [row for row in self.trainer.state.log_history if "loss" in row]


def of_env(generated: Any, folder: Path, failing: int | None = None, **args: Any) -> Any:
    """Train on the same tokens, with rewards of envs; attempt `failing` at the first task fails."""

    async def agent(episode: Any) -> Any:
        prompts, completions = generated[trained.trainer.state.global_step]
        words = trained.trainer.processing_class
        prompt = episode.last.observation
        first = prompts.index(words.encode(prompt))
        at = first + episode.index
        text = words.decode(completions[at], skip_special_tokens=True)
        await episode.step("" if first == 0 and episode.index == failing else text)
        return {
            "prompt_ids": prompts[at],
            "completion_ids": completions[at],
            "logprobs": [-1.0] * len(completions[at]),
        }

    group = rl.build_env_group(
        Graded, name="graded", num_workers=8, placement="loop", on_env_error="restart"
    )
    with rollouts(group, agent) as rollout_func:
        trained = Trained(folder, reward_funcs=reward, rollout_func=rollout_func, args=args)
        return trained.train(), trained


def test_two_steps_are_those_of_trl(tmp_path: Path) -> None:
    """Losses and gradients, where nothing fails; the second ones depend on the first ones."""

    def own(completions: list[str], **_: Any) -> list[float]:
        return [graded(text) for text in completions]

    alone = Trained(tmp_path, reward_funcs=own)
    expected = alone.train()
    found, _ = of_env(alone.generated, tmp_path)
    assert len(found) == len(expected) == 2
    assert all(abs(row["loss"]) > 1e-3 for row in expected)
    same = ("loss", "grad_norm", "reward", "reward_std", "completions/mean_length", "num_tokens")
    for one, other in zip(found, expected, strict=True):
        assert [one[name] for name in same] == pytest.approx([other[name] for name in same], 1e-4)


def test_a_rollout_that_fails_is_left_out_of_the_update(tmp_path: Path) -> None:
    """Losses and gradients are those of the seven others, whose mean and normaliser are theirs."""
    import torch

    def own(completions: list[str], **_: Any) -> list[float]:
        return [graded(text) for text in completions]

    alone = Trained(tmp_path, reward_funcs=own)
    alone.train()
    found, ours = of_env(alone.generated, tmp_path, failing=1)
    _, completions = alone.generated[0]
    kept = [k for k in range(8) if k != 1]
    words = ours.trainer.processing_class
    rewards = torch.tensor([graded(words.decode(completions[k])) for k in range(8)])
    advantages = torch.zeros(8)
    for rows in ([0, 2, 3], [4, 5, 6, 7]):
        advantages[rows] = (rewards[rows] - rewards[rows].mean()) / (rewards[rows].std() + 1e-4)
    lengths = torch.tensor([len(completions[k]) for k in range(8)])
    loss = -(advantages * lengths)[kept].sum() / lengths[kept].sum()
    assert found[0]["loss"] == pytest.approx(loss.item(), rel=1e-4)
    assert found[0]["reward"] == pytest.approx(rewards[kept].mean().item())
    assert [row["grad_norm"] > 0 for row in found] == [True, True]
