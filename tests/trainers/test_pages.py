"""Examples for trainers of language models, with the real trainer."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

import rlightning_aio as rl

pytestmark = [pytest.mark.simulators, pytest.mark.filterwarnings("ignore")]

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_trl(tmp_path: Path) -> None:
    """Half of the rollouts reach their sum; what the env says is masked."""
    pytest.importorskip("trl")
    names = runpy.run_path(str(EXAMPLES / "trl_grpo.py"))
    from datasets import Dataset
    from trainers.tiny import tiny_model, tokenizer, trainer_args

    words = tokenizer()
    asked: list[int] = []

    async def generate(ids: list[int]) -> tuple[list[int], list[float]]:
        asked.append(len(ids))
        text = "x1y" if len(asked) % 2 else "xy"
        return words.encode(text), [-1.0] * len(text)

    trainer = names["train"](
        generate,
        words,
        model=tiny_model(words),
        args=trainer_args(tmp_path),
        train_dataset=Dataset.from_list([{"prompt": f"Pay 1, {one}"} for one in "abcd"]),
    )
    first, second = [row for row in trainer.state.log_history if "loss" in row]
    assert {*asked} == {8, 8 + 3 + 3, 8 + 2 + 3}
    assert 0 < first["reward"] < 2
    assert first["num_tokens"] < second["num_tokens"]
    assert first["grad_norm"] > 0


async def test_tinker_cookbook() -> None:
    """Half of the attempts at each question are right; one at the second question has failed."""
    pytest.importorskip("tinker_cookbook")
    names = runpy.run_path(str(EXAMPLES / "tinker_groups.py"))
    import tinker
    from tinker_cookbook.completers import TokensWithLogprobs

    asked: list[str] = []

    async def policy(seen: Any, stop: Any) -> Any:
        assert stop == ["\n"]
        asked.append(bytes(seen.to_ints()).decode())
        if asked.count("Is 3 odd?") == 4:
            asked.append("")
            raise rl.EnvError("no model", blame="policy")
        text = b"Yes" if asked.count(asked[-1]) % 2 else b"No."
        return TokensWithLogprobs(tokens=[*text], maybe_logprobs=[-1.0] * 3)

    data, groups = await names["data_of_update"](
        policy,
        lambda text: tinker.ModelInput.from_ints([*text.encode()]),
        lambda tokens: bytes(tokens).decode(),
        ["\n"],
        seeds=[1, 3],
    )
    assert len(data) == len(groups) == 7
    advantages = [datum.loss_fn_inputs["advantages"].data for datum in data]
    last = sorted(round(row[-1], 2) for row in advantages)
    assert last == [-0.67, -0.5, -0.5, 0.33, 0.33, 0.5, 0.5]
    assert all(row[:-3] == [0.0] * (len(row) - 3) for row in advantages)
