"""The programs of docs/trainers.md, each with the real trainer, if it is installed."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path
from typing import Any

import pytest

from rlightning_aio import EnvError

pytestmark = [pytest.mark.simulators, pytest.mark.filterwarnings("ignore")]

PAGE = Path(__file__).parents[2] / "docs" / "trainers.md"


def program(module: str) -> dict[str, Any]:
    """Run the program that imports a module; return its names."""
    pytest.importorskip(module)
    text = PAGE.read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    (code,) = [block for block in blocks if re.search(rf"^from {module}\b", block, re.MULTILINE)]
    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(code, str(PAGE), "exec"), names)  # Of this project.
    return names


def test_trl(tmp_path: Path) -> None:
    """Half of the rollouts reach their goal."""
    names = program("trl")
    from datasets import Dataset
    from trainers.tiny import ScriptedTrainer, tiny_model, trainer_args

    rows = Dataset.from_list([{"prompt": [{"role": "user", "content": "Go."}], "goal": 5}] * 4)
    script: Any = [[("add", {"price": price}), ("add", {"price": 2})] for price in (3, 4)] * 4
    model, words = tiny_model()
    names["GRPOTrainer"] = ScriptedTrainer
    args = trainer_args(tmp_path, len(script), steps=1)
    assert names["train"](model, args, rows, processing_class=words, script=script) == 0


async def test_tinker() -> None:
    """A policy that always says yes is right about odd numbers."""
    names = program("tinker_cookbook")
    import tinker
    from tinker_cookbook.completers import TokensWithLogprobs

    class Renderer:
        def build_generation_prompt(self, messages: Any) -> Any:
            return tinker.ModelInput.from_ints(list(messages[-1]["content"].encode()))

        def get_stop_sequences(self) -> list[str]:
            return ["\n"]

        def parse_response(self, tokens: list[int]) -> Any:
            return {"role": "assistant", "content": bytes(tokens).decode()}, None

    async def policy(*_: Any, **__: Any) -> Any:
        return TokensWithLogprobs(tokens=list(b"Yes."), maybe_logprobs=[0.0] * 4)

    rewards = [found.get_total_rewards() async for found in names["play"](Renderer(), policy)]
    assert rewards == [[0.0] * 4, [1.0] * 4]


def test_skyrl() -> None:
    """An episode, and a lost step, which raises."""
    names = program("skyrl_gym")
    env = names["ShellEnv"]()
    try:
        prompt, _ = env.init([{"role": "user", "content": "List the files."}])
        assert prompt[-1]["content"] == "$"
        first, second = env.step("ls"), env.step("cat")
        assert (first["reward"], first["done"], second["reward"], second["done"]) == (1, 0, 0, 1)
        assert first["observations"] == [{"role": "user", "content": "ls: done"}]
        os.kill(env.group.get_workers()[0]["pid"], signal.SIGKILL)
        with pytest.raises(EnvError, match="SIGKILL"):
            env.step("ls")
    finally:
        env.close()
